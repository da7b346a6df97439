//! `trainer view`: what it answers, its page in a browser, and rows that come.

use std::path::Path;
use std::process::{Command, Stdio};

use risorius_tests::{Answer, Viewer, binary, succeed, text};
use serde_json::Value;

use super::{json, made, npm_package};

fn view(run_dir: &Path) -> Command {
    let mut view = Command::new(binary("trainer"));
    view.args(["view", text(run_dir)]).stdin(Stdio::null());
    view
}

#[test]
fn the_viewer_answers_its_own_page_only() {
    let made = made();
    let run_dir = made.own_run();
    let viewer = Viewer::start(&mut view(&run_dir));
    let visitor = &viewer.visitor;
    let home = format!("/{}/", visitor.token);
    let Answer { status, head, body: page } = visitor.request("GET", &home, &[], b"");
    assert_eq!(status, 200);
    assert!(head.contains("default-src 'self'") && String::from_utf8_lossy(&page).contains("Risorius"));
    // Without the token, with a wrong one, or around the folder: nothing.
    for path in ["/", "/info.json", "/0123/", "/../../etc/passwd"] {
        assert_eq!(visitor.ask("GET", path, b""), 404, "{path}");
    }
    for path in ["../Cargo.toml", "..%2f..%2fetc%2fpasswd", "/etc/passwd", "app.js/../../x", "%00", "paths/"] {
        assert_eq!(visitor.ask("GET", &format!("{home}{path}"), b""), 404, "{path}");
    }
    // Another host's name (DNS rebinding) or another page.
    assert_eq!(visitor.request("GET", &home, &["Host: evil.example"], b"").status, 403);
    assert_eq!(visitor.request("POST", &format!("{home}frame"), &["Origin: http://evil.example"], b"{}").status, 403);
    // Pictures: raw RGB of the asked size; nonsense is refused in words.
    let frame = format!("{home}frame");
    let info = json(&String::from_utf8(visitor.request("GET", &format!("{home}info.json"), &[], b"").body).unwrap());
    let (width, height) = (info["width"].as_u64().unwrap(), info["height"].as_u64().unwrap());
    assert_eq!(info["aus"].as_array().unwrap().len(), 17);
    let Answer { status, body: rest, .. } = visitor.request("POST", &frame, &[], br#"{"scale":1}"#);
    assert_eq!((status, rest.len() as u64), (200, 3 * width * height));
    let Answer { body: smile, .. } = visitor.request("POST", &frame, &[], br#"{"scale":1,"aus":{"AU12":5,"AU26":5}}"#);
    assert!(smile.len() == rest.len() && smile != rest);
    let Answer { body: again, .. } = visitor.request("POST", &frame, &[], br#"{"scale":1}"#);
    assert_eq!(again, rest, "an edit that is undone leaves no trace");
    let Answer { status, head, .. } =
        visitor.request("POST", &frame, &[], br#"{"scale":0.5,"overlay":"depth","jpeg":true}"#);
    assert!(status == 200 && head.contains("image/jpeg"), "{head}");
    for bad in [&b"{"[..], br#"{"scale":1,"slot":-1}"#, br#"{"aus":{"smile":1}}"#] {
        assert_eq!(visitor.ask("POST", &frame, bad), 400);
    }
    let wild = br#"{"scale":1e99,"slot":999,"orbit":{"yaw_deg":1e300,"zoom":0},"aus":{"AU12":1e30}}"#;
    assert_eq!(visitor.ask("POST", &frame, wild), 200, "numbers out of range are brought into it");
    let Answer { status, body, .. } = visitor.request("POST", &format!("{home}curves"), &[], b"secs,AU12\n0,0\n0,1\n");
    assert!(status == 400 && String::from_utf8_lossy(&body).contains("time stands still"));
    let keys = br#"{"fps":25,"key":[{"secs":0,"orbit":{}},{"secs":2,"orbit":{"yaw_deg":9},"aus":{"AU12":3}}]}"#;
    let Answer { status, body, .. } = visitor.request("POST", &format!("{home}path"), &[], keys);
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
    let result = browser_result(script, args)?;
    Some(result["checks"].as_u64().unwrap_or_else(|| panic!("{result}")))
}

/// Runs a script of `browser/` in a real browser and gives what it prints; `None` where there is no browser.
pub(super) fn browser_result(script: &str, args: &[&str]) -> Option<Value> {
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
    Some(json(&String::from_utf8_lossy(&output.stdout)))
}

#[test]
fn the_page_works_in_a_browser_with_mouse_and_keys() {
    let made = made();
    let viewer = Viewer::start(&mut view(&made.own_run()));
    let checks = in_a_browser("view.mjs", &[&viewer.visitor.url]);
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
    let mut viewer = Viewer::start(view(&run_dir).args(["--live", "-"]).stdin(Stdio::piped()));
    let frame = format!("/{}/frame", viewer.visitor.token);
    let ask = |viewer: &Viewer, body: &str| {
        let Answer { status, head, body: picture } = viewer.visitor.request("POST", &frame, &[], body.as_bytes());
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
