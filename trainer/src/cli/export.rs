//! `trainer export`.

use std::path::PathBuf;

use risorius_console::{Console, Failure};
use risorius_formats::ActionUnit;

use super::{DeviceArgs, need, parse_au};
use crate::avatar::Avatar;
use crate::expression::{Expression, Unseen};
use crate::jobs::export::{
    ExportKind, ExportSettings, PageSettings, SplatFormat, export, export_gaussians, export_page,
};
use crate::jobs::transfer::Driver;
use crate::presets::Preset;

/// Options of `trainer export`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  trainer export runs/ada --out ada.html\n  trainer export runs/ada --out ada.html --curves takes/bob/track/openface.csv\n  trainer export runs/ada --out ada.ply\n  trainer export runs/ada --out smile.spz --au AU12=3 --au AU06=2 --head-only\n  trainer export runs/ada --out ada.glb --curves takes/bob/track/openface.csv\n  trainer export runs/ada --kind points --views 7 --out ada_points.glb\n\n`.html` is a page that draws the avatar with every AU, without a network. `.ply`, `.splat` and `.spz` hold the Gaussians of one expression for other viewers of splats. `.glb` is a mesh with a morph target per AU for other engines. `docs/sharing.md` compares them."
)]
pub(super) struct ExportArgs {
    /// The run's folder
    run: PathBuf,
    /// The file to write; its ending says what: .html, .ply, .splat, .spz or .glb
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// An AU's intensity 0-5; may be repeated, the others stay neutral (.ply, .splat, .spz; what .html begins with)
    #[arg(long, value_name = "AU12=3.5", value_parser = parse_au)]
    au: Vec<(ActionUnit, f32)>,
    /// An expression by its name, as `trainer render` takes them (.ply, .splat, .spz; what .html begins with)
    #[arg(long, value_name = "NAME", value_parser = super::render::parse_preset)]
    preset: Option<&'static Preset>,
    /// Leave out what does not follow the head (.ply, .splat, .spz)
    #[arg(long)]
    head_only: bool,
    /// A mesh or points (.glb) [default: mesh]
    #[arg(long, value_enum)]
    kind: Option<ExportKind>,
    /// Vertices across the picture (.glb) [default: half the fitted width]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(8..=2048))]
    columns: Option<u32>,
    /// Views that are baked: the avatar's own, then to its sides, each with what it sees best (.glb) [default: 5]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=32))]
    views: Option<u32>,
    /// AU curves to add as an animation (.glb) or to play (.html)
    #[arg(long, value_name = "FILE.csv")]
    curves: Option<PathBuf>,
    #[command(flatten)]
    curve_options: super::curves::CurvesArgs,
    #[command(flatten)]
    device: DeviceArgs,
}

/// What the file's ending asks for.
#[derive(Clone, Copy, PartialEq)]
enum Target {
    Mesh,
    Page,
    Gaussians(SplatFormat),
}

impl ExportArgs {
    fn target(&self) -> Result<Target, Failure> {
        let ending = self.out.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
        match ending.as_str() {
            "glb" => Ok(Target::Mesh),
            "html" => Ok(Target::Page),
            "ply" => Ok(Target::Gaussians(SplatFormat::Ply)),
            "splat" => Ok(Target::Gaussians(SplatFormat::Splat)),
            "spz" => Ok(Target::Gaussians(SplatFormat::Spz)),
            _ => Err(Failure::usage("the file's name has to end in `.html`, `.ply`, `.splat`, `.spz` or `.glb`")),
        }
    }

    /// Refuses options that this target has no place for, rather than leaving them out in silence.
    fn check(&self, target: Target) -> Result<(), Failure> {
        let (mesh, page) = (target == Target::Mesh, target == Target::Page);
        let given = [
            ("--kind", self.kind.is_some(), mesh, ".glb"),
            ("--columns", self.columns.is_some(), mesh, ".glb"),
            ("--views", self.views.is_some(), mesh, ".glb"),
            ("--curves", self.curves.is_some(), mesh || page, ".glb and .html"),
            ("--au", !self.au.is_empty(), !mesh, ".html, .ply, .splat and .spz"),
            ("--preset", self.preset.is_some(), !mesh, ".html, .ply, .splat and .spz"),
            ("--head-only", self.head_only, !mesh && !page, ".ply, .splat and .spz"),
        ];
        match given.iter().find(|(_, is_given, fits, _)| *is_given && !fits) {
            Some((option, .., with)) => Err(Failure::usage(format!("`{option}` goes with {with} only"))),
            None => Ok(()),
        }
    }

    fn intensities(&self) -> std::collections::BTreeMap<ActionUnit, f32> {
        let mut aus = self.preset.map(Preset::intensities).unwrap_or_default();
        aus.extend(self.au.iter().copied());
        aus
    }

    /// The expression that the options ask for, with a warning where the avatar cannot show it.
    fn expression(&self, avatar: &Avatar, console: &Console) -> Expression {
        let mut unseen = Unseen::default();
        let expression = unseen.expression(&avatar.saved.table, &self.intensities());
        unseen.warn(console);
        expression
    }
}

pub(super) fn run(args: &ExportArgs, console: &Console) -> Result<(), Failure> {
    need(&args.run, "a run made by `trainer fit`")?;
    let target = args.target()?;
    args.check(target)?;
    match target {
        Target::Mesh => mesh(args, console),
        Target::Page => page(args, console),
        Target::Gaussians(format) => gaussians(args, format, console),
    }
}

fn gaussians(args: &ExportArgs, format: SplatFormat, console: &Console) -> Result<(), Failure> {
    let avatar = Avatar::open(&args.run, &args.device.device()?)?;
    let expression = args.expression(&avatar, console);
    let summary = export_gaussians(&avatar, format, &expression, args.head_only, &args.out)?;
    let human =
        format!("{}: {} Gaussians, {:.2} MB", summary.file.display(), summary.gaussians, summary.bytes as f64 / 1e6);
    console.finish(&summary, &human);
    Ok(())
}

fn page(args: &ExportArgs, console: &Console) -> Result<(), Failure> {
    let curve_options = args.curve_options.options()?;
    let avatar = Avatar::open(&args.run, &args.device.device()?)?;
    // The page makes its expressions itself; what they cannot show is said here.
    args.expression(&avatar, console);
    let settings = PageSettings::new(&args.run, args.intensities(), args.curves.as_deref(), &curve_options, console)?;
    let summary = export_page(&avatar, &settings, &args.out)?;
    let human = format!(
        "{}: {} Gaussians, {} AUs, {:.2} MB; deltas are within {:.3} mm and {:.2} levels of the avatar's",
        summary.file.display(),
        summary.gaussians,
        summary.aus.len(),
        summary.bytes as f64 / 1e6,
        summary.most_mm,
        summary.most_levels
    );
    console.finish(&summary, &human);
    Ok(())
}

fn mesh(args: &ExportArgs, console: &Console) -> Result<(), Failure> {
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
