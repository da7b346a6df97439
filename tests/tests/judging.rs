//! Judging, driving and showing an avatar, command after command as a user types it, on the built-in capture.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]
#![allow(clippy::print_stderr, reason = "a test that is skipped has to say so")]

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use risorius_tests::{binary, linked_copy, run, shared_fixture, succeed};
use serde_json::Value;

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn json(output: &str) -> Value {
    serde_json::from_str(output).unwrap_or_else(|e| panic!("not one JSON document ({e}): {output}"))
}

/// A capture, its driver as a take, and an avatar, made once for all tests, and a folder for what one test writes.
struct Made {
    shared: PathBuf,
    own: tempfile::TempDir,
}

impl Made {
    /// What was made: `run`, `capture`, `driver`.
    fn given(&self, name: &str) -> PathBuf {
        self.shared.join(name)
    }

    /// A place for what the test writes.
    fn at(&self, name: &str) -> PathBuf {
        self.own.path().join(name)
    }

    /// The avatar in a folder that may be written to.
    fn own_run(&self) -> PathBuf {
        let run = self.at("run");
        linked_copy(&self.given("run"), &run);
        run
    }
}

fn made() -> Made {
    let shared = shared_fixture("judging", |dir| {
        let at = |name: &str| dir.join(name);
        let (capture, take, driver, dataset) = (at("capture"), at("take"), at("driver"), at("dataset"));
        let size = ["--frames", "90", "--fps", "30", "--size", "96x160", "--driver", "-q"];
        succeed("synth", &[&["--out", text(&capture)], &size[..]].concat());
        for (name, folder, table) in [("video", &take, "openface"), ("driver", &driver, "driver_openface")] {
            let video = capture.join(format!("{name}.mp4"));
            succeed("capture", &["record", "--input", text(&video), "--out", text(folder), "-q"]);
            let table = capture.join(format!("{table}.csv"));
            succeed("tracker", &["import", text(folder), "--openface", text(&table), "-q"]);
        }
        succeed("tracker", &["poses", text(&take), "--colmap-model", text(&capture.join("truth_colmap")), "-q"]);
        let out = ["--frames", "40", "--scale", "2", "--out", text(&dataset), "-q"];
        succeed("dataset", &[&["build", text(&take), "--balance"], &out[..]].concat());
        succeed("trainer", &["fit", text(&dataset), "--out", text(&at("run")), "--steps", "300", "-q"]);
        // Nobody goes on with this fit, and its state is most of what it leaves.
        std::fs::remove_dir_all(at("run").join("checkpoints")).unwrap();
    });
    Made { shared, own: tempfile::tempdir().unwrap() }
}

#[test]
fn evaluation_writes_numbers_tables_and_a_page() {
    let made = made();
    let (run_dir, views) = (made.given("run"), made.given("capture").join("test/views.json"));
    let out = made.at("judged");
    let args = ["eval", text(&run_dir), "--views", text(&views), "--decoupling", "--out", text(&out), "--json"];
    let document = json(&succeed("trainer", &[&args[..], &["--lpips", "none"]].concat()));
    let all = &document["means"]["all"];
    assert!(all["psnr_db"].as_f64().unwrap() > 14.0, "{all}");
    assert!((0.1..1.0).contains(&all["ms_ssim"].as_f64().unwrap()), "{all}");
    assert!(document["mean_parts"]["head"]["ssim"].is_number(), "{document}");
    // Outside a region's mask an AU changes nothing to speak of.
    let decoupling = &document["decoupling"];
    assert!(decoupling["outside_999"].as_u64().unwrap() <= 4, "{decoupling}");
    let csv = std::fs::read_to_string(out.join("views.csv")).unwrap();
    let count = document["views"].as_array().unwrap().len();
    assert_eq!(csv.lines().count(), count + 1);
    let page = std::fs::read_to_string(out.join("report.html")).unwrap();
    assert!(page.contains("Worst views") && page.contains("Decoupling") && !page.contains("http"));
    // The same document lies in the folder.
    assert_eq!(json(&std::fs::read_to_string(out.join("eval.json")).unwrap()), document);
    // Rendered before or now: the same scores.
    let renders = out.join("renders");
    let again = ["eval", text(&run_dir), "--views", text(&views), "--renders", text(&renders), "--lpips", "none"];
    let again = json(&succeed("trainer", &[&again[..], &["--out", text(&made.at("again")), "--json"]].concat()));
    assert_eq!(again["mean_psnr_db"], document["mean_psnr_db"]);
}

#[test]
fn missing_networks_and_trackers_are_told() {
    let made = made();
    let (run_dir, empty) = (made.given("run"), made.at("empty"));
    std::fs::create_dir_all(&empty).unwrap();
    let views = made.given("capture").join("test/views.json");
    let out = made.at("nothing");
    let args = ["eval", text(&run_dir), "--views", text(&views), "--lpips", "alex", "--models", text(&empty)];
    let output = run("trainer", &[&args[..], &["--out", text(&out)]].concat());
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(1) && said.contains("tools/models --metrics"), "{said}");
    let args = ["eval", text(&run_dir), "--no-views", "--control", "--control-steps", "2", "--out", text(&out)];
    let output = run("trainer", &[&args[..], &["--tracker", "/nowhere/tracker"]].concat());
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(
        output.status.code() == Some(1) && said.contains("/nowhere/tracker") && said.contains("--tracker"),
        "{said}"
    );
}

#[test]
fn a_path_renders_resumes_and_refuses_another_list() {
    let made = made();
    let (run_dir, out, path) = (made.given("run"), made.at("path"), made.at("path.toml"));
    std::fs::write(
        &path,
        "fps = 4\n[[key]]\nsecs = 0\norbit = { yaw_deg = -8 }\n[[key]]\nsecs = 1\norbit = { yaw_deg = 8, zoom = 1.3 }\npreset = \"smile\"\n",
    )
    .unwrap();
    let (path, out) = (text(&path), text(&out));
    let args = ["render", text(&run_dir), "--path", path, "--out", out, "--depth", "--masks", "--alpha", "--json"];
    let first = json(&succeed("trainer", &args));
    assert_eq!((first["rendered"].as_u64(), first["kept"].as_u64()), (Some(5), Some(0)));
    let picture = image::open(Path::new(out).join("002.png")).unwrap();
    assert_eq!(picture.color(), image::ColorType::Rgba8);
    let alpha: Vec<u8> = picture.into_rgba8().pixels().map(|p| p.0[3]).collect();
    assert!(alpha.contains(&0) && alpha.contains(&255), "head and background");
    assert!(alpha.iter().any(|a| (20..235).contains(a)), "the edge is soft");
    let before = std::fs::read(Path::new(out).join("003.png")).unwrap();
    std::fs::remove_file(Path::new(out).join("003.png")).unwrap();
    let again = json(&succeed("trainer", &[&args[..], &["--resume"]].concat()));
    assert_eq!((again["rendered"].as_u64(), again["kept"].as_u64()), (Some(1), Some(4)));
    assert_eq!(std::fs::read(Path::new(out).join("003.png")).unwrap(), before, "the same bytes");
    let other = ["render", text(&run_dir), "--spiral", "5", "--out", out, "--resume"];
    let output = run("trainer", &other);
    assert!(output.status.code() == Some(1) && String::from_utf8_lossy(&output.stderr).contains("another list"));
    let curves = made.at("curves.csv");
    std::fs::write(&curves, "secs,AU12,AU26\n0,0,0\n1,4,2\n").unwrap();
    let folder = made.at("by-curve");
    let args = ["render", text(&run_dir), "--curves", text(&curves), "--fps", "3", "--out", text(&folder)];
    assert_eq!(json(&succeed("trainer", &[&args[..], &["--json"]].concat()))["rendered"].as_u64(), Some(4));
    // A mistake in a table names its place.
    std::fs::write(&curves, "secs,AU12\n0,0\n1,much\n").unwrap();
    let output = run("trainer", &args);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(1) && said.contains("curves.csv:3") && said.contains("AU12"), "{said}");
}

#[test]
fn transfer_to_two_avatars_with_a_turning_head_tells_what_did_not_fit() {
    let made = made();
    let (run_dir, driver, out) = (made.given("run"), made.given("driver"), made.at("two"));
    let video = made.at("two.mp4");
    let args = ["transfer", text(&run_dir), text(&run_dir), "--from", text(&driver), "--fps", "3", "--head", "copy"];
    let more = ["--out", text(&out), "--video", text(&video), "--range", "avatar", "--json", "-q"];
    let summary = json(&succeed("trainer", &[&args[..], &more[..]].concat()));
    let avatars = summary["avatars"].as_array().unwrap();
    assert_eq!(avatars.len(), 2);
    assert!(avatars[0]["units"][0]["beyond_share"].is_number());
    let count = summary["pictures"].as_u64().unwrap() as usize;
    for name in ["run_1", "run_2"] {
        assert_eq!(std::fs::read_dir(out.join(name)).unwrap().count(), count);
    }
    assert!(video.is_file());
    // A phone's recording drives as well, faster than it was recorded.
    let phone = made.at("phone.csv");
    std::fs::write(
        &phone,
        "Timecode,BlendShapeCount,MouthSmileLeft,MouthSmileRight,JawOpen,HeadYaw,HeadPitch,HeadRoll\n\
         10:00:00:00.0,61,0,0,0,0,0,0\n10:00:00:30.0,61,0.9,0.8,0.5,0.1,0,0\n10:00:01:00.0,61,0.1,0,0,0,0,0\n",
    )
    .unwrap();
    let folder = made.at("phone");
    let args = ["transfer", text(&run_dir), "--curves", text(&phone), "--fps", "10", "--out", text(&folder)];
    let summary = json(&succeed("trainer", &[&args[..], &["--json", "-q"]].concat()));
    assert_eq!(summary["pictures"].as_u64(), Some(11));
    assert_eq!(summary["driven"], serde_json::json!(["AU12", "AU26"]));
}

#[test]
fn exports_hold_a_target_per_au() {
    let made = made();
    for (kind, mode) in [("mesh", 4), ("points", 0)] {
        let file = made.at(&format!("{kind}.glb"));
        let args = ["export", text(&made.given("run")), "--out", text(&file), "--kind", kind, "--columns", "24"]
            .map(str::to_owned);
        let args: Vec<&str> = args.iter().map(String::as_str).collect();
        let summary = json(&succeed("trainer", &[&args[..], &["--views", "2", "--json"]].concat()));
        let targets = summary["targets"].as_array().unwrap().len();
        assert!(targets >= 10, "{summary}");
        let bytes = std::fs::read(&file).unwrap();
        assert_eq!(u32::from_le_bytes(bytes[8..12].try_into().unwrap()) as usize, bytes.len());
        // The crate checks every index and accessor against the specification.
        let gltf = gltf::Gltf::from_slice(&bytes).unwrap();
        let mesh = gltf.meshes().next().unwrap();
        let primitive = mesh.primitives().next().unwrap();
        assert_eq!((primitive.morph_targets().count(), primitive.mode().as_gl_enum()), (targets, mode));
        let reader = primitive.reader(|_| gltf.blob.as_deref());
        let positions: Vec<[f32; 3]> = reader.read_positions().unwrap().collect();
        assert_eq!(positions.len() as u64, summary["vertices"].as_u64().unwrap());
        // The jaw falls: some vertex moves.
        let most = reader
            .read_morph_targets()
            .flat_map(|(moves, _, _)| moves.unwrap().map(|m| m.iter().fold(0.0f32, |a, v| a.max(v.abs()))))
            .fold(0.0f32, f32::max);
        assert!(most > 1e-4, "{most}");
        if let Some(validate) = validator() {
            let output = Command::new("node").arg(validate).arg(&file).output().unwrap();
            assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        }
    }
}

/// A script of Khronos' validator, if its npm package is installed.
fn validator() -> Option<PathBuf> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("browser/validate.cjs");
    npm_package("gltf-validator").map(|_| script)
}

/// The folder of npm packages for tests, if it has one of this name: `tools/test` installs them.
fn npm_package(name: &str) -> Option<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/tools/npm");
    let there = folder.join("node_modules").join(name).is_dir() && Command::new("node").arg("-v").output().is_ok();
    if !there {
        eprintln!("SKIPPED: node or its package `{name}` is not there; `tools/test` installs it into target/tools/npm");
    }
    there.then_some(folder)
}

/// `trainer view` at work; ends with the value.
struct Viewer {
    child: Child,
    url: String,
}

impl Viewer {
    fn start(run_dir: &Path) -> Self {
        Self::with(run_dir, &[], Stdio::null())
    }

    /// Driven by the rows that [`Self::tell`] gives it.
    fn with_rows(run_dir: &Path) -> Self {
        Self::with(run_dir, &["--live", "-"], Stdio::piped())
    }

    fn with(run_dir: &Path, more: &[&str], stdin: Stdio) -> Self {
        let mut child = Command::new(binary("trainer"))
            .args([&["view", text(run_dir)], more].concat())
            .stdin(stdin)
            .stderr(Stdio::piped())
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stderr.take().unwrap()).read_line(&mut line).unwrap();
        let url =
            line.split_whitespace().find(|w| w.starts_with("http")).unwrap_or_else(|| panic!("{line}")).to_owned();
        Self { child, url }
    }

    fn port(&self) -> u16 {
        self.url.split(':').nth(2).unwrap().split('/').next().unwrap().parse().unwrap()
    }

    fn tell(&mut self, rows: &str) {
        self.child.stdin.as_mut().unwrap().write_all(rows.as_bytes()).unwrap();
    }

    fn stop_telling(&mut self) {
        self.child.stdin = None;
    }

    fn token(&self) -> &str {
        self.url.trim_end_matches('/').rsplit('/').next().unwrap()
    }

    /// Status, head and body of a request as it is written.
    fn ask(&self, method: &str, path: &str, headers: &[&str], body: &[u8]) -> (u16, String, Vec<u8>) {
        let mut stream = TcpStream::connect(("127.0.0.1", self.port())).unwrap();
        let mut lines = vec![
            format!("{method} {path} HTTP/1.1"),
            "Connection: close".to_owned(),
            format!("Content-Length: {}", body.len()),
        ];
        if !headers.iter().any(|h| h.starts_with("Host:")) {
            lines.push(format!("Host: 127.0.0.1:{}", self.port()));
        }
        lines.extend(headers.iter().map(|h| (*h).to_owned()));
        let head = lines.join("\r\n");
        stream.write_all(format!("{head}\r\n\r\n").as_bytes()).unwrap();
        stream.write_all(body).unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        let split = answer.windows(4).position(|w| w == b"\r\n\r\n").unwrap();
        let head = String::from_utf8_lossy(&answer[..split]).into_owned();
        let status = head.split(' ').nth(1).unwrap().parse().unwrap();
        (status, head, answer[split + 4..].to_vec())
    }
}

impl Drop for Viewer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn the_viewer_answers_its_own_page_only() {
    let made = made();
    let run_dir = made.own_run();
    let viewer = Viewer::start(&run_dir);
    let home = format!("/{}/", viewer.token());
    let (status, head, page) = viewer.ask("GET", &home, &[], b"");
    assert_eq!(status, 200);
    assert!(head.contains("default-src 'self'") && String::from_utf8_lossy(&page).contains("Risorius"));
    // Without the token, with a wrong one, or around the folder: nothing.
    for path in ["/", "/info.json", "/0123/", "/../../etc/passwd"] {
        assert_eq!(viewer.ask("GET", path, &[], b"").0, 404, "{path}");
    }
    for path in ["../Cargo.toml", "..%2f..%2fetc%2fpasswd", "/etc/passwd", "app.js/../../x", "%00", "paths/"] {
        assert_eq!(viewer.ask("GET", &format!("{home}{path}"), &[], b"").0, 404, "{path}");
    }
    // Another host's name (DNS rebinding) or another page.
    assert_eq!(viewer.ask("GET", &home, &["Host: evil.example"], b"").0, 403);
    assert_eq!(viewer.ask("POST", &format!("{home}frame"), &["Origin: http://evil.example"], b"{}").0, 403);
    // Pictures: raw RGB of the asked size; nonsense is refused in words.
    let frame = format!("{home}frame");
    let info = json(&String::from_utf8(viewer.ask("GET", &format!("{home}info.json"), &[], b"").2).unwrap());
    let (width, height) = (info["width"].as_u64().unwrap(), info["height"].as_u64().unwrap());
    assert_eq!(info["aus"].as_array().unwrap().len(), 17);
    let (status, _, rest) = viewer.ask("POST", &frame, &[], br#"{"scale":1}"#);
    assert_eq!((status, rest.len() as u64), (200, 3 * width * height));
    let (_, _, smile) = viewer.ask("POST", &frame, &[], br#"{"scale":1,"aus":{"AU12":5,"AU26":5}}"#);
    assert!(smile.len() == rest.len() && smile != rest);
    let (_, _, again) = viewer.ask("POST", &frame, &[], br#"{"scale":1}"#);
    assert_eq!(again, rest, "an edit that is undone leaves no trace");
    let (status, head, _) = viewer.ask("POST", &frame, &[], br#"{"scale":0.5,"overlay":"depth","jpeg":true}"#);
    assert!(status == 200 && head.contains("image/jpeg"), "{head}");
    for bad in [&b"{"[..], br#"{"scale":1,"slot":-1}"#, br#"{"aus":{"smile":1}}"#] {
        assert_eq!(viewer.ask("POST", &frame, &[], bad).0, 400);
    }
    let wild = br#"{"scale":1e99,"slot":999,"orbit":{"yaw_deg":1e300,"zoom":0},"aus":{"AU12":1e30}}"#;
    assert_eq!(viewer.ask("POST", &frame, &[], wild).0, 200, "numbers out of range are brought into it");
    let (status, _, body) = viewer.ask("POST", &format!("{home}curves"), &[], b"secs,AU12\n0,0\n0,1\n");
    assert!(status == 400 && String::from_utf8_lossy(&body).contains("time stands still"));
    let keys = br#"{"fps":25,"key":[{"secs":0,"orbit":{}},{"secs":2,"orbit":{"yaw_deg":9},"aus":{"AU12":3}}]}"#;
    let (status, _, body) = viewer.ask("POST", &format!("{home}path"), &[], keys);
    let file = json(&String::from_utf8(body).unwrap())["file"].as_str().unwrap().to_owned();
    assert!(
        status == 200
            && Path::new(&file).extension().is_some_and(|e| e == "toml")
            && Path::new(&file).starts_with(run_dir.join("paths"))
    );
    let out = made.at("saved");
    succeed("trainer", &["render", text(&run_dir), "--path", &file, "--fps", "1", "--out", text(&out), "-q"]);
    assert!(out.join("002.png").is_file());
}

/// Runs a script of `browser/` in a real browser and gives the number of its checks; `None` where there is no browser.
fn in_a_browser(script: &str, args: &[&str]) -> Option<u64> {
    let packages = npm_package("playwright-core")?;
    let chromium = std::env::var("CHROMIUM").unwrap_or_else(|_| "/usr/bin/chromium".to_owned());
    if !Path::new(&chromium).is_file() {
        eprintln!("SKIPPED: no browser at {chromium} (CHROMIUM names another)");
        return None;
    }
    let output = Command::new("node")
        .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("browser").join(script))
        .args(args)
        .env("CHROMIUM", chromium)
        .env("PLAYWRIGHT_FROM", packages.join("package.json"))
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let result = json(&String::from_utf8_lossy(&output.stdout));
    Some(result["checks"].as_u64().unwrap_or_else(|| panic!("{result}")))
}

#[test]
fn the_page_works_in_a_browser_with_mouse_and_keys() {
    let made = made();
    let viewer = Viewer::start(&made.own_run());
    let checks = in_a_browser("view.mjs", &[&viewer.url]);
    assert!(checks.is_none_or(|n| n > 25), "{checks:?}");
}

#[test]
fn the_page_follows_a_live_face_in_a_browser() {
    let made = made();
    let trainer = binary("trainer");
    let checks = in_a_browser("live.mjs", &[text(&trainer), text(&made.own_run())]);
    assert!(checks.is_none_or(|n| n > 25), "{checks:?}");
}

#[test]
fn rows_that_come_drive_the_avatar_while_it_is_looked_at() {
    let made = made();
    let run_dir = made.own_run();
    let mut viewer = Viewer::with_rows(&run_dir);
    let frame = format!("/{}/frame", viewer.token());
    let ask = |viewer: &Viewer, body: &str| {
        let (status, head, picture) = viewer.ask("POST", &frame, &[], body.as_bytes());
        assert_eq!(status, 200, "{head}");
        let live = head.lines().find_map(|l| l.strip_prefix("X-Live: ")).map(json);
        (live, picture)
    };
    let (live, rest) = ask(&viewer, r#"{"scale":0.5}"#);
    assert!(live.is_none(), "a page that does not follow hears nothing");
    let (live, waiting) = ask(&viewer, r#"{"scale":0.5,"live":true}"#);
    assert_eq!((live.unwrap()["status"]["rows"].as_u64(), waiting == rest), (Some(0), true));
    let until = |viewer: &Viewer, rows: u64| loop {
        let (live, picture) = ask(viewer, r#"{"scale":0.5,"live":true,"live_head":true}"#);
        let live = live.unwrap();
        if live["status"]["rows"].as_u64() == Some(rows) {
            return (live, picture);
        }
        std::thread::sleep(std::time::Duration::from_millis(20));
    };
    viewer.tell("secs,AU12,AU26\n0,0,0\n");
    let (_, asked) = ask(&viewer, r#"{"scale":0.5,"aus":{"AU12":0,"AU26":0}}"#);
    assert!(until(&viewer, 1).1 == asked);
    viewer.tell("5,4,3\n");
    let (live, smile) = until(&viewer, 2);
    assert_eq!((live["aus"]["AU12"].as_f64(), live["aus"]["AU26"].as_f64()), (Some(4.0), Some(3.0)));
    assert!(smile != rest);
    let (_, asked) = ask(&viewer, r#"{"scale":0.5,"aus":{"AU12":4,"AU26":3}}"#);
    assert!(asked == smile, "the same as asked for by sliders");
    // A row that cannot be read is told, in ASCII, and the face stays.
    viewer.tell("6,…,3\n");
    let problem = loop {
        let (live, picture) = ask(&viewer, r#"{"scale":0.5,"live":true}"#);
        assert!(picture == smile);
        if let Some(problem) = live.unwrap()["status"]["problem"].as_str() {
            break problem.to_owned();
        }
    };
    assert!(problem.contains('…'), "{problem}");
    viewer.stop_telling();
    while ask(&viewer, r#"{"scale":0.5,"live":true}"#).0.unwrap()["status"]["ended"] != Value::Bool(true) {}
}
