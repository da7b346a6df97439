//! `risorius avatar`, `doctor` and the four programs as commands, on the built-in capture at a small size.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]
#![allow(clippy::print_stderr, reason = "a test that is skipped has to say so")]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant, SystemTime};

use risorius_tests::{binary, shared_fixture, succeed, text};
use serde_json::Value;

/// A small capture with a driver, made once.
fn capture() -> PathBuf {
    shared_fixture("one-command", |dir| {
        let args = ["--frames", "48", "--fps", "30", "--size", "64x96", "--driver", "-q"];
        succeed("synth", &[&["--out", text(&dir.join("capture"))], &args[..]].concat());
    })
    .join("capture")
}

/// A folder to work in, with settings that make the stages short.
fn workplace(steps: u32) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    settings(dir.path(), steps);
    dir
}

fn settings(dir: &Path, steps: u32) {
    fs::write(dir.join("risorius.toml"), format!("[dataset]\nframes = 24\n[trainer.fit]\nsteps = {steps}\n")).unwrap();
}

fn risorius(dir: &Path, args: &[&str]) -> Command {
    let mut command = Command::new(binary("risorius"));
    command.current_dir(dir).args(args).stdin(Stdio::null());
    command
}

fn run(dir: &Path, args: &[&str]) -> Output {
    risorius(dir, args).output().unwrap()
}

fn said(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

fn document(output: &Output) -> Value {
    assert!(output.status.success(), "{}", said(output));
    serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {}", said(output)))
}

/// The command with a table and given cameras, which needs neither networks nor COLMAP.
fn avatar_args(capture: &Path) -> Vec<String> {
    let at = |name: &str| capture.join(name).display().to_string();
    let mut args = vec!["avatar".to_owned(), at("video.mp4"), "--out".to_owned(), "ada".to_owned()];
    args.extend(["--openface".to_owned(), at("openface.csv"), "--colmap-model".to_owned(), at("truth_colmap")]);
    args
}

fn strs(args: &[String]) -> Vec<&str> {
    args.iter().map(String::as_str).collect()
}

/// When the files of the stages were written, by their paths.
fn times(dir: &Path) -> BTreeMap<PathBuf, SystemTime> {
    let mut found = BTreeMap::new();
    let mut folders = vec![dir.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap().flatten() {
            let (path, meta) = (entry.path(), entry.metadata().unwrap());
            if meta.is_dir() {
                folders.push(path);
            } else if !path.file_name().unwrap().to_string_lossy().starts_with("card.") {
                found.insert(path, meta.modified().unwrap());
            }
        }
    }
    found
}

fn was_there(card: &Value) -> BTreeMap<String, bool> {
    let stages = card["stages"].as_array().unwrap();
    stages.iter().map(|s| (s["stage"].as_str().unwrap().to_owned(), s["was_there"].as_bool().unwrap())).collect()
}

#[test]
fn a_video_becomes_an_avatar_once() {
    let (capture, dir) = (capture(), workplace(40));
    let driver = capture.join("driver_openface.csv");
    let mut args = avatar_args(&capture);
    args.extend(["--from".to_owned(), driver.display().to_string(), "--json".to_owned()]);
    let first = run(dir.path(), &strs(&args));
    let card = document(&first);
    // Off a terminal: a line per stage and per 5 %.
    let talk = String::from_utf8_lossy(&first.stderr).into_owned();
    for word in ["record", "track", "cameras", "dataset", "fit", "score", "transfer", " %, about"] {
        assert!(talk.contains(word), "{word} is missing in\n{talk}");
    }
    let out = dir.path().join("ada");
    for file in
        ["takes/video/track/openface.csv", "takes/video/poses/report.json", "dataset/dataset.json", "run/model.json"]
    {
        assert!(out.join(file).is_file(), "{file}");
    }
    for file in ["run/eval/report.html", "driver_openface.mp4", "card.json", "card.txt"] {
        assert!(out.join(file).is_file(), "{file}");
    }

    // What the card says.
    assert_eq!(card["finished"], true);
    assert!(card["held_out"]["whole_db"].as_f64().unwrap() > 8.0, "{card:#}");
    assert!(card["held_out"]["frames"].as_u64().unwrap() > 0);
    let face = &card["face"];
    assert_eq!(face["frames"], 48);
    assert!(face["units"].as_array().unwrap().iter().any(|u| u["unit"] == "AU12" && u["is_covered"] == true), "{face}");
    assert!(card["stages"].as_array().unwrap().iter().all(|s| s["wall_secs"].as_f64().unwrap() > 0.0));
    assert!(card["avatar_bytes"].as_u64().unwrap() > 1000 && card["folder_bytes"].as_u64().unwrap() > 10_000);
    assert!(was_there(&card).values().all(|there| !there));
    let written: Value = serde_json::from_slice(&fs::read(out.join("card.json")).unwrap()).unwrap();
    assert_eq!(written, card);
    let words = fs::read_to_string(out.join("card.txt")).unwrap();
    assert!(words.contains("held out") && words.contains("risorius trainer view ada/run"), "{words}");

    // The same command again makes nothing.
    let before = times(&out);
    let again = document(&run(dir.path(), &strs(&args)));
    assert!(was_there(&again).values().all(|there| *there), "{again:#}");
    assert_eq!(times(&out), before);
    assert_eq!(again["wall_secs"], card["wall_secs"], "times are those of the work");

    // Another length of the fit: what comes before it stays.
    settings(dir.path(), 60);
    let longer = was_there(&document(&run(dir.path(), &strs(&args))));
    for (stage, there) in longer {
        assert_eq!(there, !["fit", "score", "transfer"].contains(&stage.as_str()), "{stage}");
    }

    // And what a result by hand is worth: cameras that were found with other options are kept.
    let take = out.join("takes/video");
    let model = capture.join("truth_colmap");
    succeed("tracker", &["poses", text(&take), "--colmap-model", text(&model), "--no-refine", "-q"]);
    let without: Vec<String> =
        args.iter().filter(|a| *a != "--colmap-model" && !a.ends_with("truth_colmap")).cloned().collect();
    let kept = document(&run(dir.path(), &strs(&without)));
    let cameras = kept["stages"].as_array().unwrap().iter().find(|s| s["stage"] == "cameras").unwrap();
    assert_eq!((&cameras["was_there"], &cameras["wall_secs"]), (&Value::Bool(true), &Value::Null), "{kept:#}");
}

#[test]
fn a_killed_command_goes_on() {
    let (capture, dir) = (capture(), workplace(300));
    let args = avatar_args(&capture);
    let out = dir.path().join("ada");
    // Killed as soon as the result of a stage, or its beginning, is there.
    for file in ["takes/video/take.toml", "takes/video/track/openface.csv", "dataset/dataset.json", "run/stage.json"] {
        let mut child = risorius(dir.path(), &strs(&args)).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        let begun = Instant::now();
        while !out.join(file).exists() && begun.elapsed() < Duration::from_mins(1) {
            std::thread::sleep(Duration::from_millis(5));
        }
        assert!(out.join(file).exists(), "{file}");
        child.kill().unwrap();
        child.wait().unwrap();
    }
    let kept = ["takes/video/take.toml", "takes/video/track/openface.csv", "dataset/dataset.json"];
    let before = kept.map(|f| fs::metadata(out.join(f)).unwrap().modified().unwrap());
    let mut args = args;
    args.extend(["--json".to_owned(), "-q".to_owned()]);
    let card = document(&run(dir.path(), &strs(&args)));
    assert_eq!(card["finished"], true);
    assert_eq!(kept.map(|f| fs::metadata(out.join(f)).unwrap().modified().unwrap()), before, "made twice");
    let hidden = times(&out).into_keys().filter(|p| {
        let is_hidden = p.file_name().unwrap().to_string_lossy().starts_with('.');
        is_hidden && p.extension().is_some_and(|e| e == "lock")
    });
    assert_eq!(hidden.count(), 0, "locks stay behind");
}

/// The message and hint of a command that has to fail with exit code 1.
fn failure(dir: &Path, args: &[&str]) -> (String, String) {
    let output = run(dir, &[args, &["--json", "-q"]].concat());
    assert_eq!(output.status.code(), Some(1), "{args:?}: {}", said(&output));
    let document: Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {}", said(&output)));
    let word = |key: &str| document["error"][key].as_str().unwrap_or_default().to_owned();
    (word("message"), word("hint"))
}

#[test]
fn what_cannot_become_an_avatar_says_why() {
    let (capture, dir) = (capture(), workplace(20));
    let video = capture.join("video.mp4");
    let at = |name: &str| dir.path().join(name);
    fs::write(at("text.mp4"), "these are words").unwrap();
    fs::write(at("empty.mp4"), "").unwrap();
    let whole = fs::read(&video).unwrap();
    fs::write(at("cut.mp4"), &whole[..whole.len() / 2]).unwrap();
    for (name, words) in [
        ("none.mp4", "does not exist"),
        ("text.mp4", "is not a video"),
        ("empty.mp4", "is empty"),
        ("cut.mp4", "is truncated"),
    ] {
        let (message, hint) = failure(dir.path(), &["avatar", name, "--out", "new"]);
        assert!(message.contains(name) && message.contains(words) && !hint.is_empty(), "{name}: {message}; {hint}");
    }
    assert!(!at("new").exists(), "a folder was left behind");

    // No face, no expression: tables that say so.
    let table = fs::read_to_string(capture.join("openface.csv")).unwrap();
    let header: Vec<&str> = table.lines().next().unwrap().split(',').map(str::trim).collect();
    let with = |name: &str, change: &dyn Fn(&str) -> Option<&'static str>| {
        let rows = table.lines().skip(1).map(|row| {
            let cells = row.split(',').zip(&header).map(|(cell, column)| change(column).unwrap_or(cell));
            cells.collect::<Vec<_>>().join(",")
        });
        let all: Vec<String> = std::iter::once(header.join(",")).chain(rows).collect();
        fs::write(at(name), all.join("\n") + "\n").unwrap();
    };
    with("lost.csv", &|column| (column == "success").then_some("0"));
    with("still.csv", &|column| (column.starts_with("AU")).then_some("0.5"));
    for (name, words) in [("lost.csv", "no frame has `success`"), ("still.csv", "does not move")] {
        let (message, hint) = failure(dir.path(), &["avatar", text(&video), "--out", "bad", "--openface", name]);
        assert!(message.contains(words) && hint.contains("video"), "{name}: {message}; {hint}");
    }
    // A folder that holds another video's take.
    fs::create_dir_all(at("other")).unwrap();
    fs::copy(capture.join("driver.mp4"), at("other/video.mp4")).unwrap();
    let (message, hint) =
        failure(dir.path(), &["avatar", "other/video.mp4", "--out", "bad", "--openface", "still.csv"]);
    assert!(message.contains("another video") && hint.contains("--out"), "{message}; {hint}");

    // Without networks, before anything is made.
    let output = risorius(dir.path(), &["avatar", text(&video), "--out", "new"])
        .env("RISORIUS_MODELS", at("nowhere"))
        .env_remove("ORT_DYLIB_PATH")
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(said(&output).contains("`risorius models`") && !at("new").exists(), "{}", said(&output));

    // Wrong usage.
    assert_eq!(run(dir.path(), &["avatar", "a.mp4"]).status.code(), Some(2));
    assert_eq!(run(dir.path(), &["avatar", "a.mp4", "--out", "x", "--fast", "--best"]).status.code(), Some(2));
}

#[test]
fn a_video_without_a_face_is_told_by_the_networks() {
    let dir = workplace(20);
    let doctor = document_or_failure(&run(dir.path(), &["doctor", "--json"]));
    if doctor["findings"].as_array().unwrap().iter().any(|f| f["state"] == "missing") {
        eprintln!("SKIPPED: the networks are not there; `risorius models` fetches them");
        return;
    }
    let pictures = dir.path().join("wall");
    fs::create_dir_all(&pictures).unwrap();
    for i in 0..12u8 {
        let picture = image::RgbImage::from_fn(96, 96, |x, y| image::Rgb([(x * 2) as u8, (y * 2) as u8, i * 9]));
        picture.save(pictures.join(format!("{i:03}.png"))).unwrap();
    }
    let (message, hint) = failure(dir.path(), &["avatar", "wall", "--out", "wall-avatar"]);
    assert!(message.contains("no face was found in any of its 12 frames") && !hint.is_empty(), "{message}; {hint}");
    // The same again says the same without tracking again.
    let track = dir.path().join("wall-avatar/takes/wall/track/openface.csv");
    let before = fs::metadata(&track).unwrap().modified().unwrap();
    assert_eq!(failure(dir.path(), &["avatar", "wall", "--out", "wall-avatar"]).0, message);
    assert_eq!(fs::metadata(&track).unwrap().modified().unwrap(), before);
}

/// `doctor` exits with 1 where something is missing, with its document all the same.
fn document_or_failure(output: &Output) -> Value {
    serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {}", said(output)))
}

#[test]
fn doctor_lists_what_is_there_and_how_to_get_the_rest() {
    let dir = tempfile::tempdir().unwrap();
    let output = risorius(dir.path(), &["doctor", "--json"])
        .env("RISORIUS_MODELS", dir.path().join("nowhere"))
        .env_remove("ORT_DYLIB_PATH")
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", said(&output));
    let doctor = document_or_failure(&output);
    assert_eq!(doctor["ready"], false);
    let findings = doctor["findings"].as_array().unwrap();
    let of = |name: &str| findings.iter().find(|f| f["name"] == name).unwrap_or_else(|| panic!("{name}: {doctor:#}"));
    for name in
        ["lpips", "colmap", "ffmpeg", "h264", "hevc", "vp9", "av1", "cameras", "instructions", "cores", "cuda", "wgpu"]
    {
        assert!(of(name)["found"].is_string());
    }
    for name in ["networks", "onnx-runtime"] {
        assert_eq!((&of(name)["state"], &of(name)["fix"]), (&"missing".into(), &"`risorius models`".into()));
    }
    assert_eq!(of("h264")["state"], "ok");
    let gaps = findings.iter().filter(|f| f["state"] != "ok");
    assert!(gaps.into_iter().all(|f| f["fix"].is_string() && f["needed_for"].is_string()), "{doctor:#}");
}

#[test]
fn the_four_programs_are_commands() {
    let dir = tempfile::tempdir().unwrap();
    for (program, command) in [("capture", "record"), ("tracker", "run"), ("dataset", "build"), ("trainer", "fit")] {
        let output = run(dir.path(), &[program, command, "--help"]);
        let help = said(&output);
        assert!(output.status.success() && help.contains(&format!("Usage: risorius {program} {command}")), "{help}");
        assert!(help.contains(&format!("  risorius {program} {command}")), "the example of {help}");
        assert_eq!(run(dir.path(), &[program, command, "--no-such"]).status.code(), Some(2));
    }
    let output = run(dir.path(), &["tracker", "poses", "none"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(said(&output).contains("`risorius capture record"), "{}", said(&output));
    let capture = capture();
    succeed(
        "risorius",
        &[
            "capture",
            "record",
            "--input",
            text(&capture.join("video.mp4")),
            "--out",
            text(&dir.path().join("take")),
            "-q",
        ],
    );
    for shell in ["bash", "zsh", "fish"] {
        let script = said(&run(dir.path(), &["completions", shell]));
        assert!(script.contains("avatar") && script.contains("colmap-model"), "{shell}");
    }
    let pages = dir.path().join("man1");
    succeed("risorius", &["man-pages", text(&pages), "-q"]);
    assert!(pages.join("risorius-avatar.1").is_file());
}
