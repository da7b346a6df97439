//! `tracker check`.

use std::fmt::Write as _;
use std::path::PathBuf;

use risorius_console::{Console, Failure};

use crate::check::{self, PoseErrors, Reference};
use crate::poses::Numbering;
use crate::{preview, report};

/// How good the track and the poses are
///
/// With `--reference` the poses are compared with a COLMAP model of the same frames, after bringing the camera centres
/// together by a similarity.
#[derive(clap::Args, Debug)]
#[command(after_help = "Examples:
  tracker check takes/ada
  tracker check takes/ada --reference truth/sparse --json
  tracker check takes/ada --pictures out --count 12
  tracker check takes/ada --report
  tracker check takes/ada --overlay ada_tracked.mp4")]
pub(super) struct CheckArgs {
    /// The take
    take: PathBuf,
    /// A COLMAP model to compare the poses with
    #[arg(long, value_name = "DIR")]
    reference: Option<PathBuf>,
    /// Number of the take's first frame in the reference's image names [default: what fits the landmarks]
    #[arg(long, value_name = "N", requires = "reference")]
    reference_first: Option<u32>,
    /// Draw landmarks, mean face and head hull on a spread of frames into this folder
    #[arg(long, value_name = "DIR")]
    pictures: Option<PathBuf>,
    /// Draw landmarks, head axes and AUs on the whole video, into this file
    #[arg(long, value_name = "FILE.mp4")]
    overlay: Option<PathBuf>,
    /// Write a page with curves, peaks, confidence and gaze [default: TAKE/track/report.html]
    #[arg(long, value_name = "FILE.html", num_args = 0..=1)]
    report: Option<Vec<PathBuf>>,
    /// How many pictures
    #[arg(long, value_name = "N", default_value_t = 12, requires = "pictures")]
    count: usize,
}

pub(super) fn run(args: &CheckArgs, console: &Console) -> Result<(), Failure> {
    let numbering = Numbering { first: args.reference_first, ..Numbering::default() };
    let reference = args.reference.as_ref().map(|dir| Reference { dir: dir.clone(), numbering });
    let checked = check::check(&args.take, reference.as_ref(), console)?;
    if let Some(out) = &args.pictures {
        preview::draw(&args.take, out, args.count, console)?;
    }
    if let Some(out) = &args.overlay {
        crate::overlay::draw(&args.take, out, console)?;
    }
    let page =
        args.report.as_ref().map(|paths| paths.first().cloned().unwrap_or_else(|| report::default_path(&args.take)));
    if let Some(out) = &page {
        report::write(&args.take, &checked, out, console)?;
    }
    let mut text = super::quality_in_words(&checked.track);
    match &checked.poses {
        Some(poses) => {
            let _ = write!(text, "\n\n{}", super::poses::in_words(poses));
        }
        None => text += "\n\nno poses yet: `tracker poses TAKE`",
    }
    if let Some(r) = &checked.reference {
        let _ = write!(text, "\n\nagainst the reference (scale {:.4}, cameras spread {:.3})", r.scale, r.camera_spread);
        for (name, errors) in [("all", Some(r.all)), ("placed", r.registered), ("interpolated", r.interpolated)] {
            if let Some(e) = errors {
                let _ = write!(text, "\n{}", line(name, &e));
            }
        }
    }
    if let Some(out) = &page {
        let _ = write!(text, "\nwritten to   {}", out.display());
    }
    console.finish(&checked, &text);
    Ok(())
}

fn line(name: &str, e: &PoseErrors) -> String {
    format!(
        "  {name:<13}{:5} frames: rotation {:.4}° mean, {:.4}° median, {:.4}° max; position {:.6} mean, {:.6} median, {:.6} max; face shift {:.2} px mean, {:.2} max",
        e.frames,
        e.rotation_deg.mean,
        e.rotation_deg.median,
        e.rotation_deg.max,
        e.position.mean,
        e.position.median,
        e.position.max,
        e.face_shift_px.mean,
        e.face_shift_px.max
    )
}
