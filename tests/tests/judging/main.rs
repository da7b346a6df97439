//! Judging, driving and showing an avatar, command after command as a user types it, on the built-in capture.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]
#![allow(clippy::print_stderr, reason = "a test that is skipped has to say so")]

mod readers;
mod sharing;
mod viewing;

use std::path::{Path, PathBuf};
use std::process::Command;

use risorius_tests::{linked_copy, run, shared_fixture, succeed, text};
use serde_json::Value;

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
