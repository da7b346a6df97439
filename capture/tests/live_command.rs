//! `capture record --device` as users run it: scripts, Ctrl-C, `kill -9`, full disks.
#![cfg(unix)]
#![expect(clippy::unwrap_used, reason = "helpers of tests")]

mod common;

use std::fs;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use common::{capture, names, stderr, stdout};
use risorius_formats::Take;
use risorius_video::Reader;

fn start(dir: &Path, args: &[&str]) -> Child {
    Command::new(env!("CARGO_BIN_EXE_capture"))
        .args(args)
        .current_dir(dir)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap()
}

/// Waits until the video has grown to `bytes`.
fn wait_for(child: &mut Child, video: &Path, bytes: u64) {
    while fs::metadata(video).map_or(0, |m| m.len()) < bytes {
        assert!(child.try_wait().unwrap().is_none(), "the recording ended by itself");
        std::thread::sleep(Duration::from_millis(20));
    }
}

fn signal(child: &Child, name: &str) {
    let status = Command::new("kill").args([name, &child.id().to_string()]).status().unwrap();
    assert!(status.success());
}

fn decoded(video: &Path) -> usize {
    let mut reader = Reader::open(video).unwrap();
    std::iter::from_fn(|| reader.next_frame().unwrap()).count()
}

#[test]
fn a_killed_recording_is_playable_and_recovered() {
    let dir = tempfile::tempdir().unwrap();
    let (take, video) = (dir.path().join("take"), dir.path().join("take/video.mp4"));
    let mut child = start(
        dir.path(),
        &[
            "record",
            "--device",
            "synthetic:160x120@100",
            "--warm-up",
            "0s",
            "--script",
            "au",
            "--buffers",
            "64",
            "--out",
            "take",
        ],
    );
    wait_for(&mut child, &video, 1_000_000);
    signal(&child, "-KILL");
    child.wait().unwrap();
    let size = fs::metadata(&video).unwrap().len();
    // As it lies there, before anything is repaired.
    let playable = decoded(&video);
    assert!(playable >= 100, "{playable}");
    let checked = capture(dir.path(), &["check", "take"]);
    let text = stderr(&checked);
    assert!(
        checked.status.code() == Some(1) && text.contains("not finished") && text.contains("capture recover take"),
        "{text}"
    );
    let recovered = capture(dir.path(), &["recover", "take", "--json"]);
    assert!(recovered.status.success(), "{}", stderr(&recovered));
    let document: serde_json::Value = serde_json::from_str(&stdout(&recovered)).unwrap();
    assert_eq!((&document["was_whole"], &document["dropped_frames"]), (&false.into(), &0.into()));
    let whole = Take::open(&take).unwrap();
    assert_eq!(whole.frames.len(), playable);
    assert_eq!(fs::metadata(&video).unwrap().len(), size - document["cut_bytes"].as_u64().unwrap());
    assert!(whole.frames.iter().all(|f| f.sharpness.is_some()));
    let marks = fs::read_to_string(take.join("marks.csv")).unwrap();
    assert!(marks.lines().nth(1).unwrap().starts_with("neutral,,0,3000000000,0,"), "{marks}");
    assert!(!names(&take).contains(&".reserve".to_owned()));
    assert!(capture(dir.path(), &["check", "take"]).status.success());
    assert!(stdout(&capture(dir.path(), &["recover", "take"])).contains("nothing to repair"));
}

#[test]
fn ctrl_c_ends_a_recording_properly() {
    let dir = tempfile::tempdir().unwrap();
    let mut child = start(
        dir.path(),
        &[
            "record",
            "--device",
            "synthetic:160x120@100",
            "--out",
            "take",
            "--json",
            "--exposure",
            "5ms",
            "--buffers",
            "64",
        ],
    );
    wait_for(&mut child, &dir.path().join("take/video.mp4"), 500_000);
    signal(&child, "-INT");
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let document: serde_json::Value = serde_json::from_str(&stdout(&output)).unwrap();
    assert_eq!((&document["ended"], &document["lost_by_driver"]), (&"stopped".into(), &0.into()));
    let take = Take::open(dir.path().join("take")).unwrap();
    assert_eq!(take.frames.len() as u64, document["manifest"]["frame_count"].as_u64().unwrap());
    // Measured although Ctrl-C was pressed, and decodable to the last frame.
    assert!(take.frames.iter().all(|f| f.sharpness.is_some()));
    let recording = fs::read_to_string(dir.path().join("take/recording.toml")).unwrap();
    assert!(recording.contains("during = 50"), "{recording}");
}

#[test]
fn a_full_disk_leaves_a_whole_take_and_says_so() {
    let dir = tempfile::tempdir().unwrap();
    // The largest file may have 3 MB (in units of 512 bytes); without the trap the limit would kill.
    let script = format!(
        "trap '' XFSZ; ulimit -f 9000; exec {} record --device synthetic:320x240@100 --warm-up 0s --duration 60s --out take",
        env!("CARGO_BIN_EXE_capture")
    );
    let output = Command::new("sh").args(["-c", &script]).current_dir(dir.path()).output().unwrap();
    let text = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("take/video.mp4: cannot write") && text.contains("take holds the"), "{text}");
    let take = Take::open(dir.path().join("take")).unwrap();
    assert!(take.frames.len() > 50);
    assert_eq!(decoded(&take.media_path()), take.frames.len());
    assert!(stdout(&capture(dir.path(), &["recover", "take"])).contains("nothing to repair"));
}

/// A small file system of its own, where that may be made.
struct SmallDisk(std::path::PathBuf);

impl SmallDisk {
    fn mount(at: &Path, size: &str) -> Option<Self> {
        fs::create_dir(at).unwrap();
        let mounted =
            Command::new("mount").args(["-t", "tmpfs", "-o", &format!("size={size}"), "tmpfs"]).arg(at).output();
        mounted.is_ok_and(|o| o.status.success()).then(|| Self(at.to_owned()))
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg(&self.0).status();
    }
}

#[test]
fn the_last_byte_of_the_disk_is_no_end_of_the_take() {
    let dir = tempfile::tempdir().unwrap();
    let Some(disk) = SmallDisk::mount(&dir.path().join("disk"), "12m") else {
        eprintln!("SKIPPED: no file system can be mounted here");
        return;
    };
    let output = capture(
        &disk.0,
        &["record", "--device", "synthetic:320x240@100", "--warm-up", "0s", "--duration", "60s", "--out", "take"],
    );
    let text = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("no space left") && text.contains("take holds the"), "{text}");
    let take = Take::open(disk.0.join("take")).unwrap();
    assert!(take.frames.len() > 100 && decoded(&take.media_path()) == take.frames.len());
}

#[test]
fn an_unplugged_camera_is_named_and_the_take_stays() {
    let dir = tempfile::tempdir().unwrap();
    let device = "synthetic:160x120@100,unplug=120";
    let output = capture(dir.path(), &["record", "--device", device, "--out", "take"]);
    let text = stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("the camera was unplugged") && text.contains("take holds the"), "{text}");
    assert!(Take::open(dir.path().join("take")).unwrap().frames.len() > 30);
}

#[test]
fn what_the_camera_cannot_do_is_refused_with_what_it_can() {
    let dir = tempfile::tempdir().unwrap();
    let refused = |args: &[&str], words: &str, hint: &str| {
        let all = [&["record", "--out", "take", "--device"], args].concat();
        let output = capture(dir.path(), &all);
        let text = stderr(&output);
        assert_eq!(output.status.code(), Some(1), "{text}");
        assert!(text.starts_with("error: ") && text.contains(words) && text.contains(hint), "{text}");
        assert!(names(dir.path()).is_empty());
    };
    refused(&["synthetic:640x480@60", "--fps", "120"], "does not reach 120 frames/s", "`--fps 60`");
    refused(&["synthetic:640x480@60", "--size", "1280x720"], "has no size of 1280×720", "`--size 640x480`");
    refused(&["synthetic:640x480@60", "--format", "yuyv"], "does not give yuyv", "`mjpeg`");
    refused(&["synthetic:640x480@60", "--exposure", "20ms"], "is longer than a frame", "add light");
    refused(&["synthetic:640x480@60", "--set", "zoom=3"], "no control", "Gain");
    refused(&["synthetic:640x480@sixty"], "cannot use", "such as");
    refused(&["/dev/video987"], "no such camera", "capture devices");
    refused(&["/dev/null"], "is not a camera", "capture devices");
    refused(&["quantum:7"], "was built without", "synthetic");
    for wrong in [&["--size", "big"][..], &["--duration", "soon"], &["--buffers", "2"]] {
        let all = [&["record", "--out", "take", "--device", "synthetic"], wrong].concat();
        assert_eq!(capture(dir.path(), &all).status.code(), Some(2), "{wrong:?}");
    }
}

#[test]
fn a_dry_run_says_the_mode_and_touches_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let run = |extra: &[&str]| {
        let args = [&["record", "--device", "synthetic:1280x720@119.88", "--out", "take", "--dry-run"], extra].concat();
        capture(dir.path(), &args)
    };
    let text = stdout(&run(&["--fps", "120", "--script", "au"]));
    assert!(text.contains("1280×720 at 119.88 mjpeg, for 120.0 s, into take"), "{text}");
    assert_eq!(run(&["--fps", "240"]).status.code(), Some(1));
    assert!(names(dir.path()).is_empty());
    common::write_video(&dir.path().join("v.mp4"), 20, 60.0);
    let file = capture(dir.path(), &["record", "--input", "v.mp4", "--out", "take", "--dry-run"]);
    assert!(stdout(&file).contains("would make take of v.mp4: 20 frames, 96×64, 60.00 frames/s"), "{}", stdout(&file));
    assert_eq!(names(dir.path()), ["v.mp4"]);
}

#[test]
fn devices_are_listed_with_modes_and_controls() {
    let dir = tempfile::tempdir().unwrap();
    let output = capture(dir.path(), &["devices", "--device", "synthetic:1280x720@120", "--json"]);
    let document: serde_json::Value = serde_json::from_str(&stdout(&output)).unwrap();
    let device = &document["devices"][0];
    assert_eq!((&device["modes"][0]["width"], &device["modes"][0]["format"]), (&1280.into(), &"mjpeg".into()));
    assert_eq!(device["modes"][0]["rates"]["exactly"][0]["frames"], 120);
    assert!(
        device["controls"].as_array().unwrap().iter().any(|c| c["role"] == "exposure-time" && c["highest"] == 5000)
    );
    assert!(document["backends"].as_array().unwrap().contains(&"synthetic".into()));
    let human = capture(dir.path(), &["devices", "--device", "synthetic"]);
    assert!(stdout(&human).contains("1280x720") && stdout(&human).contains("120 frames/s"), "{}", stdout(&human));
}

#[test]
fn a_script_of_ones_own_prompts_and_marks() {
    let dir = tempfile::tempdir().unwrap();
    let script = "name = \"mine\"\n[[step]]\nlabel = \"A\"\naus = [\"AU01\", \"AU02\"]\ntext = \"brows up\"\nsecs = 0.5\n\
        [[step]]\nlabel = \"B\"\ntext = \"rest\"\nrest_secs = 0.25\nsecs = 0.25\n";
    fs::write(dir.path().join("mine.toml"), script).unwrap();
    let args =
        ["record", "--device", "synthetic:160x120@100", "--script", "mine.toml", "--out", "take", "--no-progress"];
    let output = capture(dir.path(), &args);
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(
        stderr(&output).contains(">> brows up (0.5 s)") && stderr(&output).contains(">> relax; next: rest"),
        "{}",
        stderr(&output)
    );
    let marks = fs::read_to_string(dir.path().join("take/marks.csv")).unwrap();
    let lines: Vec<&str> = marks.lines().collect();
    assert_eq!(
        lines[1..],
        ["A,AU01+AU02,0,500000000,0,49", "neutral,,500000000,750000000,50,74", "B,,750000000,1000000000,75,99"]
    );
    fs::write(dir.path().join("bad.toml"), "name = \"x\"\n[[step]]\nlabel = 3\n").unwrap();
    let args = ["record", "--device", "synthetic", "--script", "bad.toml", "--out", "other"];
    let refused = capture(dir.path(), &args);
    assert!(refused.status.code() == Some(1) && stderr(&refused).contains("bad.toml:3"), "{}", stderr(&refused));
}
