//! `dataset build`.

use std::path::{Path, PathBuf};

use risorius_console::{Console, Failure};
use risorius_formats::RegionTable;
use serde::Deserialize;

use crate::{BuildOptions, Report, Sampling};

/// Build a dataset from tracked and posed takes.
///
/// Scales: a loader reads rgb/<s>x for the one scale it is set to. Written are the chosen scale and everything coarser
/// up to 8; ask for more with --scales.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  dataset build takes/ada --balance --out datasets/ada\n  dataset build takes/a takes/b --balance --frames 1000 --scales 2,4,8 --scale 2 --out datasets/ab"
)]
pub(super) struct Args {
    /// Folders of takes of one person, tracked and posed
    #[arg(required = true, value_name = "TAKE")]
    takes: Vec<PathBuf>,
    /// Where the dataset goes; an older one there is replaced
    #[arg(long, value_name = "DATASET")]
    out: PathBuf,
    /// Choose frames so that every AU appears at every intensity about equally often (the default)
    #[arg(long, conflicts_with = "uniform")]
    balance: bool,
    /// Choose frames evenly over time: the baseline
    #[arg(long)]
    uniform: bool,
    /// How many frames [default: 750]
    #[arg(long, value_name = "N")]
    frames: Option<usize>,
    /// Image scale for fitting: 1, 2, 4 or 8 [default: 4]
    #[arg(long, value_name = "S")]
    scale: Option<u32>,
    /// Image scales to write [default: the chosen one and all coarser ones]
    #[arg(long, value_name = "S,S,…", value_delimiter = ',')]
    scales: Option<Vec<u32>>,
    /// Intensity levels per AU when balancing [default: 6]
    #[arg(long, value_name = "N")]
    levels: Option<usize>,
    /// Count frames that other blocks took against a block's quota: flatter, with fewer neutral frames
    #[arg(long)]
    count_existing: bool,
    /// Leave out rows below this tracking confidence [default: 0.8]
    #[arg(long, value_name = "0..1")]
    min_confidence: Option<f32>,
    /// Hold no frames out
    #[arg(long)]
    no_val: bool,
    /// A TOML file that says which AU belongs to which region [default: the paper's table]
    #[arg(long, value_name = "FILE.toml")]
    regions: Option<PathBuf>,
}

/// `[dataset]` of risorius.toml.
#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
struct Settings {
    sampling: Option<Sampling>,
    frames: Option<usize>,
    scale: Option<u32>,
    scales: Option<Vec<u32>>,
    levels: Option<usize>,
    count_existing: Option<bool>,
    min_confidence: Option<f32>,
    no_val: Option<bool>,
    regions: Option<PathBuf>,
}

pub(super) fn run(args: &Args, console: &Console) -> Result<(), Failure> {
    let settings: Settings = risorius_console::settings("dataset")?;
    let options = resolve(args, settings)?;
    let report = crate::build(&args.takes, &args.out, &options, console)?;
    console.finish(&report, &summary(&report, &args.out));
    Ok(())
}

/// Command line, then risorius.toml, then defaults.
fn resolve(args: &Args, settings: Settings) -> Result<BuildOptions, Failure> {
    let default = BuildOptions::default();
    let sampling = match (args.uniform, args.balance) {
        (true, _) => Sampling::Uniform,
        (_, true) => Sampling::Balanced,
        _ => settings.sampling.unwrap_or_default(),
    };
    let scale = args.scale.or(settings.scale).unwrap_or(default.scale);
    let mut scales = args.scales.clone().or(settings.scales).unwrap_or_else(|| BuildOptions::scales_from(scale));
    scales.sort_unstable();
    scales.dedup();
    let regions = match args.regions.clone().or(settings.regions) {
        Some(path) => RegionTable::read(&path)?,
        None => default.regions,
    };
    Ok(BuildOptions {
        sampling,
        frames: args.frames.or(settings.frames).unwrap_or(default.frames),
        scale,
        scales,
        levels: args.levels.or(settings.levels).unwrap_or(default.levels),
        count_existing: args.count_existing || settings.count_existing.unwrap_or(default.count_existing),
        min_confidence: args.min_confidence.or(settings.min_confidence).unwrap_or(default.min_confidence),
        no_val: args.no_val || settings.no_val.unwrap_or(default.no_val),
        regions,
    })
}

fn summary(report: &Report, out: &Path) -> String {
    let inactive = report.attributes.iter().filter(|a| !a.active).count();
    let more = if inactive > 0 { format!(" ({inactive} more hardly move)") } else { String::new() };
    [
        format!(
            "{}: {} frames of {} usable ones, {} AUs{more}",
            out.display(),
            report.chosen,
            report.candidates,
            report.attributes.len() - inactive
        ),
        format!(
            "variation of (AU, intensity) block sizes above rest: {:.2} before, {:.2} evenly over time, {:.2} now",
            report.evenness_before.raised_variation,
            report.evenness_uniform.raised_variation,
            report.evenness_after.raised_variation
        ),
        format!("look at {}", out.join("report").join("contact_sheet.png").display()),
    ]
    .join("\n")
}
