//! `capture recover`.

use std::path::PathBuf;

use clap::Args;
use risorius_console::{Console, Failure};
use serde::Serialize;

use crate::controls;
use crate::live::journal::Recording;
use crate::live::{measure_take, recover};
use crate::source;

/// Options of `capture recover`.
#[derive(Args, Debug)]
#[command(
    after_help = "Example:\n  capture recover takes/face\n\nA recording that was killed can be played up to its last half second; this writes the tables that make it a take."
)]
pub(super) struct RecoverArgs {
    /// The take's folder.
    #[arg(value_name = "TAKE")]
    take: PathBuf,
    /// Also put the camera's controls back to what they were before the recording.
    #[arg(long)]
    restore_controls: bool,
    /// Leave sharpness and exposure of the frames out.
    #[arg(long)]
    no_measure: bool,
}

#[derive(Serialize)]
struct Document {
    take: PathBuf,
    was_whole: bool,
    frames: u32,
    duration_secs: f64,
    dropped_frames: u32,
    cut_bytes: u64,
    rows_restored: usize,
    controls_restored: Option<bool>,
}

pub(super) fn run(args: &RecoverArgs, console: &Console) -> Result<(), Failure> {
    let found = recover(&args.take, console)?;
    let was_whole = found.is_none();
    let (cut_bytes, rows_restored) = found.map_or((0, 0), |f| (f.cut_bytes, f.rows_restored));
    let take = if was_whole || args.no_measure {
        risorius_formats::Take::open(&args.take)?
    } else {
        measure_take(&args.take, console)?
    };
    let controls_restored = if args.restore_controls {
        let recording = Recording::read(&args.take)?;
        let mut camera = source::open(&recording.device)?;
        Some(controls::restore(camera.as_mut(), &recording.controls).is_empty())
    } else {
        None
    };
    let document = Document {
        take: args.take.clone(),
        was_whole,
        frames: take.manifest.frame_count,
        duration_secs: take.frames.last().map_or(0.0, |f| f.timestamp_nanos as f64 * 1e-9),
        dropped_frames: take.manifest.dropped_frames,
        cut_bytes,
        rows_restored,
        controls_restored,
    };
    let mut lines = Vec::new();
    if was_whole {
        lines.push(format!("{}: is whole, nothing to repair", args.take.display()));
    } else {
        let d = &document;
        lines.push(format!(
            "{}: {} frames, {:.1} s, dropped {}",
            d.take.display(),
            d.frames,
            d.duration_secs,
            d.dropped_frames
        ));
        if d.cut_bytes > 0 {
            lines.push(format!("cut off a torn end of {} bytes", d.cut_bytes));
        }
        if d.rows_restored > 0 {
            lines.push(format!("{} frames have their times from the video alone", d.rows_restored));
        }
    }
    match controls_restored {
        Some(true) => lines.push("the camera's controls are back".to_owned()),
        Some(false) => lines.push("some of the camera's controls could not be put back".to_owned()),
        None => {}
    }
    console.finish(&document, &lines.join("\n"));
    Ok(())
}
