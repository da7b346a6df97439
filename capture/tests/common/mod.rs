//! Videos made for the tests, and the binary.
#![allow(dead_code, reason = "each test file uses its own part")]
#![expect(clippy::unwrap_used, clippy::print_stderr, reason = "helpers of tests")]

use std::path::Path;
use std::process::{Command, Output};

use image::{Rgb, RgbImage};
use risorius_video::Writer;

/// A textured picture that moves with `i`.
pub(crate) fn picture(width: u32, height: u32, i: u32) -> RgbImage {
    RgbImage::from_fn(width, height, |x, y| {
        let v = ((x + 3 * i) / 8 + y / 8) % 2 * 90 + 60 + (x * 7 + y * 13 + i * 5) % 11;
        Rgb([v as u8, (v + 10) as u8, (v / 2) as u8])
    })
}

/// A moving video of `count` frames.
pub(crate) fn write_video(path: &Path, count: u32, fps: f64) {
    let mut writer = Writer::create(path, 96, 64, fps).unwrap();
    (0..count).for_each(|i| writer.push(&picture(96, 64, i)).unwrap());
    writer.finish().unwrap();
}

/// Runs `capture` in an empty place of its own settings.
pub(crate) fn capture(dir: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_capture")).args(args).current_dir(dir).output().unwrap()
}

pub(crate) fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

pub(crate) fn stdout(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// The names in a folder, hidden ones too.
pub(crate) fn names(dir: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        std::fs::read_dir(dir).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

/// Whether the `ffmpeg` program is there; says so when it is not.
pub(crate) fn has_ffmpeg() -> bool {
    let found = Command::new("ffmpeg").arg("-version").output().is_ok_and(|o| o.status.success());
    if !found {
        eprintln!("SKIPPED: `ffmpeg` not found");
    }
    found
}

/// Runs `ffmpeg` with options separated by blanks.
pub(crate) fn ffmpeg(args: &str, out: &Path) {
    let output =
        Command::new("ffmpeg").args(["-v", "error", "-y"]).args(args.split_whitespace()).arg(out).output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
}
