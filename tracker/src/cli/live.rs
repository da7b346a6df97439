//! `tracker live`.

use std::io::Write;
use std::path::{Path, PathBuf};

use risorius_console::{Console, Failure};
use risorius_formats::FormatError;
use serde::Deserialize;

use super::above_zero;
use super::run::FaceArg;
use crate::error::TrackerError;
use crate::run::live::{LiveOptions, LiveSource, live};

/// Track a camera live: rows of an OpenFace table as they come
///
/// Writes to standard output (or --out), a row as soon as it is known, for `trainer view RUN --live -` or a program of
/// your own. Pictures that come while the networks are busy are passed over. The person's rest is learned on the way:
/// the first seconds should show a resting face.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  tracker live | trainer view runs/ada --live -
  tracker live --device /dev/video2 --size 1280x720 --fps 60 > rows.csv
  tracker live --input takes/bob | trainer view runs/ada --live -")]
pub(super) struct LiveArgs {
    /// The camera, by number or as /dev/videoN [default: 0]
    #[arg(long, value_name = "DEVICE", conflicts_with = "input")]
    device: Option<String>,
    /// A take or a video in place of a camera, at its own pace
    #[arg(long, value_name = "TAKE|VIDEO")]
    input: Option<PathBuf>,
    /// With --input: every frame, however long that takes
    #[arg(long, requires = "input")]
    every_frame: bool,
    /// Size to ask the camera for [default: 640x480]
    #[arg(long, value_name = "WxH", value_parser = size)]
    size: Option<(u32, u32)>,
    /// Frames per second to ask the camera for [default: 30]
    #[arg(long, value_name = "N")]
    fps: Option<f64>,
    /// Folder with models.toml and the networks it names [default: where `tools/models` puts them]
    #[arg(long, value_name = "DIR")]
    models: Option<PathBuf>,
    /// Threads for the networks [default: 1]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    threads: Option<u32>,
    /// Which face to follow where there are several [default: largest]
    #[arg(long, value_name = "WHICH")]
    face: Option<FaceArg>,
    /// Focal length of the camera, pixels [default: 1.2 × the longer side]
    #[arg(long, value_name = "PX")]
    focal: Option<f64>,
    /// Stop after so many rows
    #[arg(long, value_name = "N")]
    frames: Option<u64>,
    /// Where the rows go; `-` is standard output [default: -; needed with --json]
    #[arg(long, value_name = "FILE.csv")]
    out: Option<PathBuf>,
}

/// Keys of `risorius.toml`, table `tracker-live`.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default, rename_all = "kebab-case")]
struct Settings {
    device: Option<String>,
    models: Option<PathBuf>,
    threads: Option<u32>,
    face: Option<FaceArg>,
    focal: Option<f64>,
    fps: Option<f64>,
}

fn size(text: &str) -> Result<(u32, u32), String> {
    let parsed = text.split_once(['x', 'X', '×']).and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    parsed.filter(|&(w, h)| w > 0 && h > 0).ok_or_else(|| format!("`{text}` is not a size such as 1280x720"))
}

/// The number of a camera: `2` or `/dev/video2`.
fn number(device: &str) -> Option<i32> {
    device.strip_prefix("/dev/video").unwrap_or(device).parse().ok().filter(|n| *n >= 0)
}

pub(super) fn run(args: &LiveArgs, console: &Console) -> Result<(), Failure> {
    let settings: Settings = risorius_console::settings("tracker-live")?;
    let source = if let Some(input) = &args.input {
        let video = input.clone();
        if args.every_frame { LiveSource::EveryFrame(video) } else { LiveSource::Video(video) }
    } else {
        let device = args.device.clone().or(settings.device).unwrap_or_else(|| "0".to_owned());
        let number = number(&device)
            .ok_or_else(|| Failure::usage(format!("`{device}` is no camera: give its number, or /dev/videoN")))?;
        let fps = above_zero("fps", "frames a second", args.fps.or(settings.fps))?.unwrap_or(30.0);
        LiveSource::Camera { number, size: args.size.unwrap_or((640, 480)), fps }
    };
    let options = LiveOptions {
        models: args.models.clone().or(settings.models),
        threads: args.threads.or(settings.threads).unwrap_or(1).max(1) as usize,
        face: args.face.or(settings.face).unwrap_or(FaceArg::Largest).first(),
        focal_px: above_zero("focal", "pixels", args.focal.or(settings.focal))?,
        frames: args.frames,
    };
    let file = args.out.as_deref().filter(|path| *path != Path::new("-"));
    if file.is_none() && console.is_json() {
        return Err(Failure::usage(
            "with `--json` standard output is the summary's: send the rows elsewhere with `--out FILE.csv`",
        ));
    }
    let summary = match file {
        Some(path) => {
            let create = || std::fs::File::create(path).map_err(|e| FormatError::io(path, "create", &e));
            let mut file = create().map_err(TrackerError::from)?;
            live(&source, &options, &mut file as &mut dyn Write, path, console)?
        }
        None => live(&source, &options, &mut std::io::stdout().lock(), Path::new("standard output"), console)?,
    };
    let human = format!(
        "{} rows, {:.1} a second, each {:.0} ms after its picture; {} without a face, {} pictures passed over",
        summary.frames, summary.fps, summary.latency_ms, summary.lost, summary.passed_over
    );
    if file.is_some() {
        console.finish(&summary, &human);
    } else {
        console.say(&human);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cameras_and_sizes_are_read() {
        assert_eq!(["2", "/dev/video13", "-1", "/dev/null", "cam"].map(number), [Some(2), Some(13), None, None, None]);
        assert_eq!(size("1280x720"), Ok((1280, 720)));
        assert!(size("1280").is_err() && size("0x720").is_err());
    }
}
