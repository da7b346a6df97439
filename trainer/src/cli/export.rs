//! `trainer export`.

use std::path::PathBuf;

use risorius_console::{Console, Failure};

use super::{DeviceArgs, need};
use crate::avatar::Avatar;
use crate::jobs::export::{ExportKind, ExportSettings, export};
use crate::jobs::transfer::Driver;

/// Options of `trainer export`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  trainer export runs/ada --out ada.glb\n  trainer export runs/ada --kind points --views 7 --out ada_points.glb\n  trainer export runs/ada --out ada.glb --curves takes/bob/track/openface.csv"
)]
pub(super) struct ExportArgs {
    /// The run's folder
    run: PathBuf,
    /// The file to write: binary glTF
    #[arg(long, value_name = "FILE.glb")]
    out: PathBuf,
    /// A mesh or points [default: mesh]
    #[arg(long, value_enum)]
    kind: Option<ExportKind>,
    /// Vertices across the picture [default: half the fitted width]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(8..=2048))]
    columns: Option<u32>,
    /// Views that are baked: the avatar's own, then to its sides, each with what it sees best [default: 5]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=32))]
    views: Option<u32>,
    /// AU curves to add as an animation
    #[arg(long, value_name = "FILE.csv")]
    curves: Option<PathBuf>,
    #[command(flatten)]
    curve_options: super::curves::CurvesArgs,
    #[command(flatten)]
    device: DeviceArgs,
}

pub(super) fn run(args: &ExportArgs, console: &Console) -> Result<(), Failure> {
    need(&args.run, "a run made by `trainer fit`")?;
    if !args.out.extension().is_some_and(|e| e.eq_ignore_ascii_case("glb")) {
        return Err(Failure::usage("the file's name has to end in `.glb`"));
    }
    let curve_options = args.curve_options.options()?;
    let driver = args
        .curves
        .as_ref()
        .map(|path| Driver::of_table(path, &curve_options, risorius_formats::smooth::WINDOW_SECS, console))
        .transpose()?;
    let avatar = Avatar::open(&args.run, &args.device.device()?)?;
    let settings = ExportSettings {
        kind: args.kind.unwrap_or_default(),
        columns: args.columns.unwrap_or((avatar.saved.default_camera.width / 2).max(8)),
        views: args.views.unwrap_or(5) as usize,
    };
    let summary = export(&avatar, &settings, driver.as_ref(), &args.out, console)?;
    let human = format!(
        "{}: {} vertices, {} triangles, {} AUs, {:.1} MB; half way, targets are {:.1} levels and {:.2} mm from the avatar",
        summary.file.display(),
        summary.vertices,
        summary.triangles,
        summary.targets.len(),
        summary.bytes as f64 / 1e6,
        summary.half_way_levels,
        summary.half_way_mm
    );
    console.finish(&summary, &human);
    Ok(())
}
