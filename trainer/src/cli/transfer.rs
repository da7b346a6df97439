//! `trainer transfer`.

use std::path::PathBuf;

use risorius_console::{Console, Failure};
use risorius_formats::Take;

use super::{DeviceArgs, need};
use crate::avatar::Avatar;
use crate::jobs::render::Sink;
use crate::jobs::transfer::{Range, TransferSettings, transfer};
use crate::studio::Look;

/// Options of `trainer transfer`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  trainer transfer runs/ada --from takes/bob --video bob_as_ada.mp4\n  trainer transfer runs/ada --from takes/bob --out frames --range avatar --fps 24"
)]
pub(super) struct TransferArgs {
    /// The run's folder
    run: PathBuf,
    /// The driver: a tracked take
    #[arg(long, value_name = "TAKE")]
    from: PathBuf,
    /// A video of the result
    #[arg(long, value_name = "OUT.mp4")]
    video: Option<PathBuf>,
    /// A folder for the pictures, named by the driver's frame
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Whose range turns the driver's intensities into expressions [default: driver]
    #[arg(long, value_enum)]
    range: Option<Range>,
    /// Pictures per second of the driver's video [default: 12]
    #[arg(long, value_name = "FPS")]
    fps: Option<f64>,
    /// Leave the driver out of the picture
    #[arg(long)]
    alone: bool,
    /// Driver frames below this confidence hold the expression before them [default: 0.8]
    #[arg(long, value_name = "0-1")]
    min_confidence: Option<f32>,
    #[command(flatten)]
    device: DeviceArgs,
}

pub(super) fn run(args: &TransferArgs, console: &Console) -> Result<(), Failure> {
    if args.out.is_none() && args.video.is_none() {
        return Err(Failure::usage("nothing to write: give `--video OUT.mp4`, `--out DIR` or both"));
    }
    let fps = args.fps.unwrap_or(12.0);
    if !(fps.is_finite() && fps > 0.0) {
        return Err(Failure::usage("`--fps` must be above 0"));
    }
    need(&args.run, "a run made by `trainer fit`")?;
    let take = Take::open(&args.from)?;
    let avatar = Avatar::open(&args.run, &args.device.device()?)?;
    let settings = TransferSettings {
        range: args.range.unwrap_or_default(),
        fps,
        side_by_side: !args.alone,
        min_confidence: args.min_confidence.unwrap_or(0.8),
    };
    let sink = Sink {
        folder: args.out.clone(),
        video: args.video.clone().map(|path| (path, fps.min(take.fps()))),
        look: Look::default(),
        maps: false,
    };
    let summary = transfer(&avatar, &take, &settings, &sink, console)?;
    let human = format!(
        "{} pictures driven by {} AUs of {} frames, {:.2} s each",
        summary.render.rendered,
        summary.driven.len(),
        summary.driver_frames,
        summary.render.seconds_per_picture
    );
    console.finish(&summary, &human);
    Ok(())
}
