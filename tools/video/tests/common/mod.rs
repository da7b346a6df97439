//! Shared by the tests that compare with the `ffmpeg` and `ffprobe` programs.
#![allow(dead_code, reason = "every test uses a part of it")]
#![expect(clippy::unwrap_used, clippy::print_stderr, reason = "helpers of tests")]

use std::path::Path;
use std::process::Command;

use risorius_video::Reader;

/// Whether both programs are there; says so if not.
pub(crate) fn has_ffmpeg() -> bool {
    let found = ["ffmpeg", "ffprobe"]
        .iter()
        .all(|p| Command::new(p).arg("-version").output().is_ok_and(|o| o.status.success()));
    if !found {
        eprintln!("SKIPPED: `ffmpeg` and `ffprobe` not found");
    }
    found
}

/// Whether this FFmpeg has a filter or an encoder.
pub(crate) fn ffmpeg_has(kind: &str, name: &str) -> bool {
    let output = Command::new("ffmpeg").args(["-v", "error", kind]).output().unwrap();
    String::from_utf8_lossy(&output.stdout).split_whitespace().any(|word| word == name)
}

pub(crate) fn try_ffmpeg(args: &str, out: &Path) -> Result<(), String> {
    let output =
        Command::new("ffmpeg").args(["-v", "error", "-y"]).args(args.split_whitespace()).arg(out).output().unwrap();
    if output.status.success() { Ok(()) } else { Err(String::from_utf8_lossy(&output.stderr).into_owned()) }
}

pub(crate) fn ffmpeg(args: &str, out: &Path) {
    try_ffmpeg(args, out).unwrap_or_else(|message| panic!("{}: {message}", out.display()));
}

/// Seconds since the first frame, by ffprobe; of the first stream that is no attached picture.
pub(crate) fn true_times(path: &Path) -> Vec<f64> {
    let args = ["-v", "error", "-select_streams", "V:0", "-show_entries", "frame=best_effort_timestamp_time"];
    let output = Command::new("ffprobe").args(args).args(["-of", "csv=p=0"]).arg(path).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    let times: Vec<f64> = text.lines().filter_map(|l| l.split(',').next()?.parse().ok()).collect();
    times.iter().map(|t| t - times[0]).collect()
}

pub(crate) fn our_times(path: &Path) -> Vec<f64> {
    let mut reader = Reader::open(path).unwrap();
    let mut times = Vec::new();
    while let Some(frame) = reader.next_frame().unwrap() {
        times.push(frame.timestamp_nanos as f64 * 1e-9);
    }
    times
}

/// Mean difference of two pictures, levels.
pub(crate) fn mean_difference(a: &[u8], b: &[u8]) -> f64 {
    assert_eq!(a.len(), b.len(), "the pictures have different sizes");
    a.iter().zip(b).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / a.len() as f64
}
