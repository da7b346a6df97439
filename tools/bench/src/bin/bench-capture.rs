//! Whether `capture record` keeps up: a minute of 1280×720 at 120 fps from the timed synthetic camera, compressed and raw,
//! with its drops, CPU share and peak memory; and the time to make a take of a video file of 14,400 frames.
//!
//! Each run is a process of the release build, as a user runs it. The CPU time includes what the synthetic camera needs to
//! paint and hand out its frames. The disk's floor is measured in the same run: plain writing of as many bytes.

use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

use clap::Parser;
use image::{Rgb, RgbImage};
use risorius_bench::child;
use risorius_console::{Common, CommonArgs, Console, Failure};
use risorius_formats::{FormatError, Reporter as _};
use risorius_video::Writer;
use serde::Serialize;
use serde_json::Value;

/// Drops, CPU share and memory of `capture record`
#[derive(Debug, Parser)]
#[command(
    name = "bench-capture",
    version,
    about,
    after_help = "Example:\n  bench-capture --work work/bench-capture --secs 60"
)]
struct Cli {
    #[command(flatten)]
    common: CommonArgs,
    /// Length of each live recording, seconds
    #[arg(long, default_value_t = 60)]
    secs: u32,
    /// The live sources
    #[arg(long, value_delimiter = ';', default_values_t = ["1280x720@120,mjpeg".to_owned(), "1280x720@120,yuyv".to_owned(), "1280x720@120,nv12".to_owned()])]
    sources: Vec<String>,
    /// Frames of the video file
    #[arg(long, default_value_t = 14_400)]
    frames: u32,
    /// A video file to use instead of one that is made
    #[arg(long, value_name = "FILE")]
    video: Option<PathBuf>,
    /// Where takes and the video go; a video that is there is used again, takes are removed
    #[arg(long, value_name = "DIR")]
    work: PathBuf,
}

impl Common for Cli {
    fn common(&self) -> &CommonArgs {
        &self.common
    }
}

#[derive(Debug, Serialize)]
struct Live {
    source: String,
    frames: u64,
    lost_by_driver: u64,
    discarded: u64,
    corrupt: u64,
    fps_measured: f64,
    jitter_ms: f64,
    wall_secs: f64,
    cpu_secs: f64,
    /// CPU seconds per second of recording, 1 for a whole core.
    cores: f64,
    peak_mib: f64,
    waiting_peak_mib: f64,
    video_mib: f64,
    /// What the recording writes a second, as a share of what the disk takes when nothing else is done.
    disk_share: f64,
}

#[derive(Debug, Serialize)]
struct FromFile {
    frames: u64,
    /// How long the clip takes to play.
    clip_secs: f64,
    wall_secs: f64,
    cpu_secs: f64,
    /// Clip time over wall time: above 1 is faster than real time.
    speed: f64,
    peak_mib: f64,
}

#[derive(Debug, Serialize)]
struct Document {
    disk_mib_per_sec: f64,
    live: Vec<Live>,
    file: FromFile,
}

fn main() -> ExitCode {
    risorius_console::run(run)
}

fn run(cli: &Cli, console: &Console) -> Result<(), Failure> {
    fs::create_dir_all(&cli.work).map_err(|e| FormatError::io(&cli.work, "create", &e))?;
    let disk = disk_speed(&cli.work)?;
    let mut live = Vec::new();
    for source in &cli.sources {
        console.say(&format!("recording {source} for {} s", cli.secs));
        live.push(record_live(cli, source, disk)?);
    }
    let video = match &cli.video {
        Some(video) => video.clone(),
        None => make_video(&cli.work.join(format!("{}.mp4", cli.frames)), cli.frames, console)?,
    };
    console.say("making a take of the video file");
    let file = record_file(cli, &video)?;
    let document = Document { disk_mib_per_sec: disk, live, file };
    console.finish(&document, &text(&document));
    Ok(())
}

/// MiB per second of plain writing and syncing, over 512 MiB.
fn disk_speed(work: &Path) -> Result<f64, Failure> {
    let path = work.join("floor");
    let fail = |e: std::io::Error| FormatError::io(&path, "write", &e);
    let block: Vec<u8> = (0..1u32 << 20).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    let begun = Instant::now();
    let mut file = fs::File::create(&path).map_err(fail)?;
    for _ in 0..512 {
        file.write_all(&block).map_err(fail)?;
    }
    file.sync_all().map_err(fail)?;
    let secs = begun.elapsed().as_secs_f64();
    fs::remove_file(&path).map_err(fail)?;
    Ok(512.0 / secs)
}

fn remove(take: &Path) -> Result<(), Failure> {
    if take.exists() {
        fs::remove_dir_all(take).map_err(|e| FormatError::io(take, "remove", &e))?;
    }
    Ok(())
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or(f64::NAN)
}

fn record_live(cli: &Cli, source: &str, disk: f64) -> Result<Live, Failure> {
    let take = cli.work.join("live");
    remove(&take)?;
    let (device, duration) = (format!("synthetic:{source}"), format!("{}s", cli.secs));
    let out = take.to_string_lossy();
    let args = ["record", "--device", &device, "--duration", &duration, "--no-measure", "--out", &out];
    let run = child::run("capture", &args, &cli.work)?;
    let d = &run.document;
    let count = |key: &str| d[key].as_u64().unwrap_or(u64::MAX);
    let secs = number(&d["duration_secs"]);
    let mib = |key: &str| number(&d[key]) / f64::from(1 << 20);
    let live = Live {
        source: source.to_owned(),
        frames: d["manifest"]["frame_count"].as_u64().unwrap_or(0),
        lost_by_driver: count("lost_by_driver"),
        discarded: count("discarded"),
        corrupt: count("corrupt"),
        fps_measured: number(&d["manifest"]["fps_measured"]),
        jitter_ms: number(&d["jitter_ms"]),
        wall_secs: run.wall_secs,
        cpu_secs: run.cpu_secs,
        cores: run.cpu_secs / run.wall_secs,
        peak_mib: run.peak_mib,
        waiting_peak_mib: mib("waiting_peak_bytes"),
        video_mib: mib("video_bytes"),
        disk_share: mib("video_bytes") / secs / disk,
    };
    remove(&take)?;
    Ok(live)
}

/// A textured picture that moves, so that the encoder and the decoder have work.
fn picture(i: u32) -> RgbImage {
    RgbImage::from_fn(1280, 720, |x, y| {
        let level = ((x + 3 * i) / 40 + y / 40) % 2 * 80 + 60 + (x.wrapping_mul(7) ^ y.wrapping_mul(13)) % 11;
        Rgb([level as u8, (level + 15) as u8, (level / 2 + 30) as u8])
    })
}

fn make_video(path: &Path, frames: u32, console: &Console) -> Result<PathBuf, Failure> {
    if !path.is_file() {
        console.stage("making the video", Some(frames.into()));
        let pictures: Vec<RgbImage> = (0..27).map(picture).collect();
        let mut writer = Writer::create(path, 1280, 720, 120.0)?;
        for i in 0..frames {
            writer.push(&pictures[i as usize % pictures.len()])?;
            console.advance(1);
        }
        writer.finish()?;
    }
    Ok(path.to_owned())
}

fn record_file(cli: &Cli, video: &Path) -> Result<FromFile, Failure> {
    let take = cli.work.join("file");
    remove(&take)?;
    let (input, out) = (video.to_string_lossy(), take.to_string_lossy());
    let run = child::run("capture", &["record", "--input", &input, "--out", &out], &cli.work)?;
    let clip_secs = number(&run.document["duration_secs"]);
    remove(&take)?;
    Ok(FromFile {
        frames: run.document["manifest"]["frame_count"].as_u64().unwrap_or(0),
        clip_secs,
        wall_secs: run.wall_secs,
        cpu_secs: run.cpu_secs,
        speed: clip_secs / run.wall_secs,
        peak_mib: run.peak_mib,
    })
}

fn text(d: &Document) -> String {
    let mut lines = vec![format!("disk: {:.0} MiB/s", d.disk_mib_per_sec)];
    for l in &d.live {
        lines.push(format!(
            "{}: {} frames at {:.2}/s, lost {}, discarded {}, broken {}; {:.2} cores, peak {:.0} MiB, {:.1} MiB waited at most, {:.0} MiB written ({:.0} % of the disk)",
            l.source,
            l.frames,
            l.fps_measured,
            l.lost_by_driver,
            l.discarded,
            l.corrupt,
            l.cores,
            l.peak_mib,
            l.waiting_peak_mib,
            l.video_mib,
            100.0 * l.disk_share
        ));
    }
    let f = &d.file;
    lines.push(format!(
        "file: {} frames, {:.0} s of video in {:.1} s ({:.2} times real time), {:.1} CPU-s, peak {:.0} MiB",
        f.frames, f.clip_secs, f.wall_secs, f.speed, f.cpu_secs, f.peak_mib
    ));
    lines.join("\n")
}
