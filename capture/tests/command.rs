//! The `capture` command: messages, exit codes, and what stands on stdout.

mod common;

use common::{capture, names, picture, stderr, stdout, write_video};
use std::fs;
use std::path::Path;

/// Runs `record` on bad input; the message has to be one line that names the input, with a hint, and nothing is left.
fn refuses(dir: &Path, input: &str, words: &str) {
    let before = names(dir);
    let output = capture(dir, &["record", "--input", input, "--out", "take", "--no-progress"]);
    let text = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    let lines: Vec<&str> = text.lines().collect();
    assert!(lines[0].starts_with(&format!("error: {input}")) && lines[0].contains(words), "{text}");
    assert!(lines.len() == 3 && lines[1].is_empty() && lines[2].starts_with("hint: "), "{text}");
    assert!(output.stdout.is_empty());
    assert_eq!(names(dir), before, "something was left behind");
}

#[test]
fn bad_input_is_named_and_leaves_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name);
    write_video(&path("whole.mp4"), 20, 30.0);
    let bytes = fs::read(path("whole.mp4")).unwrap();
    fs::write(path("cut.mp4"), &bytes[..bytes.len() / 2]).unwrap();
    fs::write(path("empty.mp4"), "").unwrap();
    fs::write(path("text.mp4"), "a letter to my aunt\n".repeat(50)).unwrap();
    fs::create_dir(path("nothing")).unwrap();
    fs::create_dir(path("odd")).unwrap();
    picture(40, 30, 0).save(path("odd/a1.png")).unwrap();
    picture(40, 31, 0).save(path("odd/a2.png")).unwrap();
    refuses(dir.path(), "missing.mp4", "does not exist");
    refuses(dir.path(), "empty.mp4", "is empty");
    refuses(dir.path(), "text.mp4", "is not a video");
    refuses(dir.path(), "cut.mp4", "is truncated");
    refuses(dir.path(), "nothing", "has no PNG or JPEG images");
    refuses(dir.path(), "odd", "a2.png: is 40×31 pixels");
}

#[test]
fn a_take_is_made_checked_and_kept() {
    let dir = tempfile::tempdir().unwrap();
    write_video(&dir.path().join("v.mp4"), 30, 60.0);
    let made = capture(dir.path(), &["record", "--input", "v.mp4", "--out", "take"]);
    assert_eq!(made.status.code(), Some(0), "{}", stderr(&made));
    assert!(stdout(&made).starts_with("take: 30 frames, 96×64, 60.00 frames/s"), "{}", stdout(&made));
    assert!(stderr(&made).contains("reading frames: 100 % (30 of 30"), "{}", stderr(&made));
    let again = capture(dir.path(), &["record", "--input", "v.mp4", "--out", "take"]);
    assert_eq!(again.status.code(), Some(1));
    assert!(stderr(&again).starts_with("error: take: already exists\n\nhint: ") && stderr(&again).contains("--force"));
    let forced = capture(dir.path(), &["record", "--input", "v.mp4", "--out", "take", "--force", "-q"]);
    assert_eq!((forced.status.code(), stderr(&forced).as_str()), (Some(0), ""));
    let checked = capture(dir.path(), &["check", "take", "--sheet", "sheet.png", "--no-progress"]);
    assert_eq!((checked.status.code(), stderr(&checked).as_str()), (Some(0), ""));
    assert!(stdout(&checked).contains("good  dropped      no frames are missing\n"), "{}", stdout(&checked));
    assert_eq!(names(dir.path()), ["sheet.png", "take", "v.mp4"]);
    // For scripts: half a second is too short to be good, and good enough to be fair.
    let strict = capture(dir.path(), &["check", "take", "--require", "good", "--report", "report.html", "-q"]);
    assert_eq!(strict.status.code(), Some(1));
    assert!(stderr(&strict).starts_with("error: take: is fair: length\n\nhint: "), "{}", stderr(&strict));
    assert!(stdout(&strict).contains("overall: fair") && path_exists(dir.path(), "report.html"));
    assert!(capture(dir.path(), &["check", "take", "--require", "fair"]).status.success());
}

fn path_exists(dir: &Path, name: &str) -> bool {
    dir.join(name).exists()
}

#[test]
fn with_json_stdout_is_one_document() {
    let dir = tempfile::tempdir().unwrap();
    write_video(&dir.path().join("v.mp4"), 10, 60.0);
    let document = |args: &[&str], code: i32| -> serde_json::Value {
        let output = capture(dir.path(), args);
        assert_eq!(output.status.code(), Some(code), "{}", stderr(&output));
        serde_json::from_slice(&output.stdout).unwrap()
    };
    let made = document(&["record", "--input", "v.mp4", "--out", "take", "--json"], 0);
    assert_eq!((&made["manifest"]["frame_count"], &made["manifest"]["source"]), (&10.into(), &"video".into()));
    let checked = document(&["--json", "check", "take"], 0);
    assert_eq!((&checked["frame_count"], &checked["media_intact"]), (&10.into(), &true.into()));
    assert!(document(&["devices", "--json"], 0)["devices"].is_array());
    let failed = document(&["check", "none", "--json"], 1);
    assert_eq!(
        (&failed["error"]["message"], &failed["error"]["exit_status"]),
        (&"none: does not exist".into(), &1.into())
    );
    let usage = document(&["check", "--json"], 2);
    assert_eq!(usage["error"]["exit_status"], 2);
}

#[test]
fn wrong_usage_is_2() {
    let dir = tempfile::tempdir().unwrap();
    for args in [
        &["record", "--out", "take"][..],
        &["record", "--input", "a", "--out", "b", "--fps", "many"],
        &["record", "--input", "a", "--out", "b", "--script", "au"],
        &["record", "--input", "a", "--device", "b", "--out", "c"],
        &["fly"],
        &[],
    ] {
        assert_eq!(capture(dir.path(), args).status.code(), Some(2), "{args:?}");
    }
    let help = capture(dir.path(), &["record", "--help"]);
    assert!(help.status.success() && stdout(&help).contains("Examples:") && !stdout(&help).contains("not built yet"));
    assert!(names(dir.path()).is_empty());
}

#[test]
fn settings_fill_in_what_the_command_line_leaves_out() {
    let dir = tempfile::tempdir().unwrap();
    write_video(&dir.path().join("v.mp4"), 5, 60.0);
    let settings = dir.path().join("risorius.toml");
    fs::write(&settings, "[tracker]\nx = 1\n\n[capture]\nsubject = \"Ada\"\nconsent = \"lab\"\nlink = true\n").unwrap();
    let made = capture(dir.path(), &["record", "--input", "v.mp4", "--out", "take", "--subject", "Bob", "-q"]);
    assert!(made.status.success(), "{}", stderr(&made));
    let manifest = fs::read_to_string(dir.path().join("take/take.toml")).unwrap();
    assert!(manifest.contains("subject = \"Bob\"") && manifest.contains("consent = \"lab\""), "{manifest}");
    assert_eq!(names(&dir.path().join("take")), ["frames.csv", "stage.json", "take.toml"]);
    fs::write(&settings, "[capture]\n\nsubjekt = \"Ada\"\n").unwrap();
    let refused = capture(dir.path(), &["record", "--input", "v.mp4", "--out", "other"]);
    assert_eq!(refused.status.code(), Some(1));
    assert!(stderr(&refused).contains("risorius.toml:3: unknown field `subjekt`"), "{}", stderr(&refused));
}

#[test]
fn a_closed_pipe_is_no_error() {
    use std::process::{Command, Stdio};
    let dir = tempfile::tempdir().unwrap();
    let mut child = Command::new(env!("CARGO_BIN_EXE_capture"))
        .args(["devices"])
        .current_dir(dir.path())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert_eq!((output.status.code(), stderr(&output).as_str()), (Some(0), ""));
}
