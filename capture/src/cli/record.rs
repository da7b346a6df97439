//! `capture record`.

use std::path::PathBuf;

use clap::Args;
use risorius_console::{AgainArgs, Console, Failure, Inputs, Stage, settings};
use serde::Deserialize;
use serde_json::json;

use crate::record::{RecordOptions, RecordSummary, record_with, rehearse};

/// Options of `capture record`.
#[derive(Args, Debug)]
#[command(
    after_help = "Examples:\n  capture record --device /dev/video0 --size 1280x720 --fps 120 --script au --out takes/face\n  \
    capture record --input face.mp4 --out takes/face --subject Ada\n  capture record --input frames/ --fps 120 --out takes/face\n  \
    capture record --input sideways.mp4 --rotate 90 --out takes/face\n\n\
    A recording ends with --duration, with the script, or with Ctrl-C; it can be played however it ends, and\n\
    `capture recover` makes a take of what was killed.\n\
    A frame counts as dropped where the time since the one before exceeds 1.5 times what is usual around it.\n\
    Defaults for --link, --subject, --consent and --fps can stand in the table [capture] of risorius.toml."
)]
pub(super) struct RecordArgs {
    /// A video file, or a folder of PNG or JPEG images in the order of their names.
    #[arg(long, value_name = "VIDEO|IMAGE_DIR", required_unless_present = "device", conflicts_with = "device")]
    input: Option<PathBuf>,
    /// The take's folder; of a file it appears whole or not at all, of a camera it grows and is playable at any time.
    #[arg(long, value_name = "TAKE")]
    pub(super) out: PathBuf,
    /// Refer to the input by its absolute path instead of copying it.
    #[arg(long)]
    link: bool,
    /// Replace the take at --out, with its tracks and poses.
    #[arg(long)]
    pub(super) force: bool,
    /// Who is seen.
    #[arg(long, value_name = "TEXT")]
    pub(super) subject: Option<String>,
    /// Under which consent it was recorded.
    #[arg(long, value_name = "TEXT")]
    pub(super) consent: Option<String>,
    /// Frames per second: of a camera [default: its highest], of an image folder [default: 30], or of a stream without times.
    #[arg(long, value_name = "N", value_parser = parse_fps)]
    pub(super) fps: Option<f64>,
    /// Frames per second at which a slow-motion clip was filmed, if its metadata do not tell.
    #[arg(long, value_name = "N", value_parser = parse_fps, conflicts_with = "device")]
    true_fps: Option<f64>,
    /// Turn the pictures clockwise, where a clip lies on its side although its file says nothing.
    #[arg(long, value_name = "DEGREES", value_parser = parse_turn, conflicts_with = "device")]
    rotate: Option<u32>,
    #[command(flatten)]
    again: AgainArgs,
    /// Say what would be recorded, and record nothing.
    #[arg(long)]
    pub(super) dry_run: bool,
    /// A camera of `capture devices`, such as /dev/video0; `synthetic:1280x720@120` is one that is not there.
    #[arg(long, value_name = "ID", help_heading = "Camera")]
    device: Option<String>,
    #[command(flatten)]
    pub(super) live: super::live::LiveArgs,
}

/// `[capture]` of `risorius.toml`.
#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(super) struct Settings {
    link: bool,
    pub(super) subject: Option<String>,
    pub(super) consent: Option<String>,
    fps: Option<f64>,
}

fn parse_fps(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(fps) if fps.is_finite() && (0.01..=10_000.0).contains(&fps) => Ok(fps),
        _ => Err("expected a number of frames per second, such as 30 or 119.88".to_owned()),
    }
}

fn parse_turn(text: &str) -> Result<u32, String> {
    match text.parse() {
        Ok(degrees @ (0 | 90 | 180 | 270)) => Ok(degrees),
        _ => Err("expected 90, 180 or 270".to_owned()),
    }
}

pub(super) fn run(args: &RecordArgs, console: &Console) -> Result<(), Failure> {
    let settings: Settings = settings("capture")?;
    let input = match (&args.input, &args.device) {
        (Some(input), _) => input.clone(),
        (None, Some(device)) => return super::live::run(device, args, settings, console),
        (None, None) => return Err(Failure::usage("give `--input` or `--device`")),
    };
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
        true_fps: args.true_fps,
        turn_degrees: args.rotate.unwrap_or(0),
    };
    if args.dry_run {
        let planned = rehearse(&options)?;
        let count = planned.frame_count_estimate.map_or_else(|| "?".to_owned(), |n| n.to_string());
        let text = format!(
            "would make {} of {}: {count} frames, {}×{}, {:.2} frames/s{}{}",
            options.out.display(),
            options.input.display(),
            planned.width,
            planned.height,
            planned.fps,
            if planned.coding.is_empty() { String::new() } else { format!(", {}", planned.coding) },
            planned.remarks.iter().fold(String::new(), |text, remark| text + "\n  " + remark)
        );
        console.finish(&planned, &text);
        return Ok(());
    }
    let asked = json!({
        "link": options.link,
        "subject": options.subject,
        "consent": options.consent,
        "image_fps": options.image_fps,
        "true_fps": options.true_fps,
        "rotate": options.turn_degrees,
    });
    let stage = Stage::new("capture record", &options.out, &asked)?;
    // Of a folder, the pictures in it and nothing below it.
    let inputs = Inputs::default().folder("input", &options.input, |name| !name.contains('/'));
    let Some(mut running) = stage.begin(args.again, inputs, console)? else { return Ok(()) };
    // A take is not made again over one that is there: it has to come with its record, or a kill in between would leave
    // one that no command knows.
    let summary = record_with(&options, console, |take| running.finish_in(take, &["take.toml", "frames.csv"]))?;
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
    if let Some(factor) = summary.slow_motion {
        lines
            .push(format!("slow motion: filmed {factor:.2} times as fast as it plays; the times are those of filming"));
    }
    lines.push(format!("dropped {}, repeated {}", m.dropped_frames, m.repeated_frames));
    lines.push(format!("next: capture check {}", summary.take.display()));
    lines.join("\n")
}
