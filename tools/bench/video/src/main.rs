//! How fast a video's frames are read as RGB, and how far the first ones are from FFmpeg's own exact conversion (`zscale`).
//!
//! With the feature `opencv` the reader through OpenCV that was there before runs in turn with the present one, in the same
//! process on the same file. Of several rounds the fastest counts.

#[cfg(feature = "opencv")]
mod before;

use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use std::time::Instant;

use clap::Parser;
use image::RgbImage;
use risorius_console::{Common, CommonArgs, Console, Failure};
use risorius_formats::Reporter as _;
use risorius_video::Reader;
use serde::Serialize;

/// Speed and colours of the video reader
#[derive(Debug, Parser)]
#[command(name = "bench-video", version, about, after_help = "Example:\n  bench-video --video captures/ada/video.mp4")]
struct Cli {
    #[command(flatten)]
    common: CommonArgs,
    /// The video
    #[arg(long, value_name = "FILE")]
    video: PathBuf,
    /// Rounds of each reader
    #[arg(long, default_value_t = 3)]
    rounds: u32,
    /// Frames whose colours are compared
    #[arg(long, default_value_t = 20)]
    compared: usize,
}

impl Common for Cli {
    fn common(&self) -> &CommonArgs {
        &self.common
    }
}

#[derive(Debug, Serialize)]
struct Row {
    reader: &'static str,
    frames: u32,
    wall_secs: f64,
    cpu_secs: f64,
    frames_per_sec: f64,
    /// Mean difference from FFmpeg's exact conversion, levels.
    error_levels: Option<f64>,
}

/// Gives every frame of a video to a function, until that says no.
type ReadAll = fn(&Path, &mut dyn FnMut(&RgbImage) -> bool) -> Result<(), String>;

fn ours(path: &Path, each: &mut dyn FnMut(&RgbImage) -> bool) -> Result<(), String> {
    let mut reader = Reader::open(path).map_err(|e| e.to_string())?;
    while let Some(frame) = reader.next_frame().map_err(|e| e.to_string())? {
        if !each(&frame.image) {
            break;
        }
    }
    Ok(())
}

/// CPU time of this process, all threads, seconds.
fn cpu_secs() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // After the name in brackets: user and system time are the 12th and 13th, in hundredths.
    let fields = stat.rsplit(')').next().unwrap_or_default().split_whitespace().skip(11).take(2);
    fields.filter_map(|f| f.parse::<f64>().ok()).sum::<f64>() / 100.0
}

/// The first frames as FFmpeg converts them; `None` without the program or its filter.
fn reference(video: &Path, frames: usize) -> Option<Vec<u8>> {
    let filter = "zscale=matrix=gbr:range=full:filter=bilinear,format=gbrp";
    let output = Command::new("ffmpeg")
        .args(["-v", "error", "-i"])
        .arg(video)
        .args(["-vsync", "passthrough", "-frames:v", &frames.to_string(), "-vf", filter])
        .args(["-f", "rawvideo", "-pix_fmt", "rgb24", "-"])
        .output()
        .ok()?;
    (output.status.success() && !output.stdout.is_empty()).then_some(output.stdout)
}

fn difference(read: ReadAll, video: &Path, expected: &[u8]) -> Option<f64> {
    let mut found = Vec::with_capacity(expected.len());
    let mut take = |image: &RgbImage| {
        found.extend_from_slice(image.as_raw());
        found.len() < expected.len()
    };
    read(video, &mut take).ok()?;
    let sum: f64 = found.iter().zip(expected).map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
    (found.len() >= expected.len()).then(|| sum / expected.len() as f64)
}

fn run(cli: &Cli, console: &Console) -> Result<(), Failure> {
    #[cfg(feature = "opencv")]
    let readers: &[(&'static str, ReadAll)] = &[("FFmpeg", ours), ("OpenCV, before", before::read)];
    #[cfg(not(feature = "opencv"))]
    let readers: &[(&'static str, ReadAll)] = &[("FFmpeg", ours)];
    let expected = reference(&cli.video, cli.compared);
    if expected.is_none() {
        console.note("the `ffmpeg` program or its filter `zscale` is not there: colours are not compared");
    }
    let mut rows: Vec<Row> = Vec::new();
    for round in 0..cli.rounds.max(1) {
        for (i, &(reader, read)) in readers.iter().enumerate() {
            let (began, cpu) = (Instant::now(), cpu_secs());
            let mut frames = 0;
            let mut count = |_: &RgbImage| {
                frames += 1;
                true
            };
            read(&cli.video, &mut count).map_err(Failure::input)?;
            let (wall_secs, cpu_secs) = (began.elapsed().as_secs_f64(), cpu_secs() - cpu);
            let frames_per_sec = f64::from(frames) / wall_secs;
            console.note(&format!("round {}, {reader}: {wall_secs:.2} s, {cpu_secs:.2} s of CPU", round + 1));
            if round == 0 {
                let error_levels = expected.as_deref().and_then(|e| difference(read, &cli.video, e));
                rows.push(Row { reader, frames, wall_secs, cpu_secs, frames_per_sec, error_levels });
            } else {
                let row = &mut rows[i];
                row.wall_secs = row.wall_secs.min(wall_secs);
                row.cpu_secs = row.cpu_secs.min(cpu_secs);
                row.frames_per_sec = row.frames_per_sec.max(frames_per_sec);
            }
        }
    }
    let mut lines = vec!["reader          frames   wall s    CPU s  frames/s  error, levels".to_owned()];
    lines.extend(rows.iter().map(|r| {
        let error = r.error_levels.map_or_else(|| "–".to_owned(), |e| format!("{e:.3}"));
        let Row { reader, frames, wall_secs, cpu_secs, frames_per_sec, .. } = r;
        format!("{reader:<14} {frames:>7} {wall_secs:>8.2} {cpu_secs:>8.2} {frames_per_sec:>9.0} {error:>14}")
    }));
    console.finish(&rows, &lines.join("\n"));
    Ok(())
}

fn main() -> ExitCode {
    risorius_console::run(run)
}
