//! `capture record`.

use std::path::PathBuf;

use clap::Args;
use risorius_console::{Console, Failure, settings};
use serde::Deserialize;

use crate::record::{RecordOptions, RecordSummary, record};

/// Options of `capture record`.
#[derive(Args, Debug)]
#[command(
    after_help = "Examples:\n  capture record --input face.mp4 --out takes/face --subject Ada\n  capture record --input frames/ --fps 120 --out takes/face\n\n\
    A frame counts as dropped where the time since the one before exceeds 1.5 times what is usual around it.\n\
    Defaults for --link, --subject, --consent and --fps can stand in the table [capture] of risorius.toml."
)]
pub(super) struct RecordArgs {
    /// A video file, or a folder of PNG or JPEG images in the order of their names.
    #[arg(long, value_name = "VIDEO|IMAGE_DIR", required_unless_present = "device", conflicts_with = "device")]
    input: Option<PathBuf>,
    /// The take's folder; it appears whole or not at all.
    #[arg(long, value_name = "TAKE")]
    out: PathBuf,
    /// Refer to the input by its absolute path instead of copying it.
    #[arg(long)]
    link: bool,
    /// Replace the take at --out, with its tracks and poses.
    #[arg(long)]
    force: bool,
    /// Who is seen.
    #[arg(long, value_name = "TEXT")]
    subject: Option<String>,
    /// Under which consent it was recorded.
    #[arg(long, value_name = "TEXT")]
    consent: Option<String>,
    /// Frames per second of an image folder [default: 30].
    #[arg(long, value_name = "N", value_parser = parse_fps)]
    fps: Option<f64>,
    /// A camera (not built yet: only --input works).
    #[arg(long, value_name = "ID")]
    device: Option<String>,
    /// Picture size for --device (not built yet).
    #[arg(long, value_name = "WxH", requires = "device")]
    size: Option<String>,
    /// Length for --device, such as 120s (not built yet).
    #[arg(long, value_name = "TIME", requires = "device")]
    duration: Option<String>,
    /// Prompts for --device (not built yet).
    #[arg(long, value_name = "NAME", requires = "device")]
    script: Option<String>,
}

/// `[capture]` of `risorius.toml`.
#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Settings {
    link: bool,
    subject: Option<String>,
    consent: Option<String>,
    fps: Option<f64>,
}

fn parse_fps(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(fps) if fps.is_finite() && (0.01..=10_000.0).contains(&fps) => Ok(fps),
        _ => Err("expected a number of frames per second, such as 30 or 119.88".to_owned()),
    }
}

pub(super) fn run(args: &RecordArgs, console: &Console) -> Result<(), Failure> {
    let Some(input) = args.input.clone() else {
        return Err(Failure::input("not built yet: recording from a camera; only `--input` is available")
            .with_hint("record with the camera's own program, then `capture record --input VIDEO --out TAKE`"));
    };
    let settings: Settings = settings("capture")?;
    // A rate in the settings is for image folders, and no reason for a warning about a video.
    let settings_fps = settings.fps.filter(|_| input.is_dir());
    let options = RecordOptions {
        input,
        out: args.out.clone(),
        link: args.link || settings.link,
        force: args.force,
        subject: args.subject.clone().or(settings.subject).unwrap_or_default(),
        consent: args.consent.clone().or(settings.consent).unwrap_or_default(),
        image_fps: args.fps.or(settings_fps),
    };
    let summary = record(&options, console)?;
    console.finish(&summary, &text(&summary));
    Ok(())
}

fn text(summary: &RecordSummary) -> String {
    let m = &summary.manifest;
    let mut lines = vec![format!(
        "{}: {} frames, {}×{}, {:.2} frames/s, {:.1} s",
        summary.take.display(),
        m.frame_count,
        m.width,
        m.height,
        m.fps_measured,
        summary.duration_secs
    )];
    if m.rotation_degrees != 0 {
        lines.push(format!("turned upright by {}°", m.rotation_degrees));
    }
    lines.push(format!("dropped {}, repeated {}", m.dropped_frames, m.repeated_frames));
    lines.push(format!("next: capture check {}", summary.take.display()));
    lines.join("\n")
}
