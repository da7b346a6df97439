//! `dataset build`.

use std::path::{Path, PathBuf};

use risorius_console::{AgainArgs, Console, Failure, Inputs, Stage};
use risorius_formats::RegionTable;
use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::balance::{Bins, Quota};
use crate::build::Built;
use crate::entropy::EntropyOptions;
use crate::split::SplitKind;
use crate::{BuildOptions, Report, Sampling};

/// The objectives by the names of the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Objective {
    /// The paper's balance over (AU, intensity) blocks
    Paper,
    /// Most entropy over AU levels, camera directions and time, sharp frames first
    Entropy,
    /// Evenly over time
    Uniform,
}

impl From<Objective> for Sampling {
    fn from(objective: Objective) -> Self {
        match objective {
            Objective::Paper => Self::Balanced,
            Objective::Entropy => Self::Entropy,
            Objective::Uniform => Self::Uniform,
        }
    }
}

/// What intensity levels span.
#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum BinsArg {
    /// The 0–5 scale, the same for every AU
    Scale,
    /// Each AU's own range in the capture
    Range,
}

/// How many frames a block may take.
#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum QuotaArg {
    /// The rest of the budget over the rest of the blocks
    Running,
    /// The budget over all blocks, the rest filled evenly over time
    Fixed,
    /// One ceiling for all blocks
    Ceiling,
}

/// Which frames are held out.
#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum SplitArg {
    /// Every 20th chosen frame
    Periodic,
    /// The paper's interpolation test: every second chosen frame
    EveryOther,
    /// Stretches of about a second, with a guard around each
    TimeBlocks,
    /// Cells of camera directions
    Views,
    /// Combinations of raised AUs
    AuCombinations,
    /// None
    None,
}

impl From<SplitArg> for SplitKind {
    fn from(arg: SplitArg) -> Self {
        match arg {
            SplitArg::Periodic => Self::Periodic,
            SplitArg::EveryOther => Self::EveryOther,
            SplitArg::TimeBlocks => Self::TimeBlocks,
            SplitArg::Views => Self::Views,
            SplitArg::AuCombinations => Self::AuCombinations,
            SplitArg::None => Self::None,
        }
    }
}

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
    /// How frames are chosen [default: paper]
    #[arg(long, value_enum, conflicts_with_all = ["balance", "uniform"])]
    objective: Option<Objective>,
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
    /// What the levels span [default: scale]
    #[arg(long, value_enum)]
    bins: Option<BinsArg>,
    /// How many frames a block may take [default: running]
    #[arg(long, value_enum)]
    quota: Option<QuotaArg>,
    /// Count frames that other blocks took against a block's quota: flatter, with fewer neutral frames
    #[arg(long)]
    count_existing: bool,
    /// Leave out rows below this tracking confidence [default: 0.8]
    #[arg(long, value_name = "0..1")]
    min_confidence: Option<f32>,
    /// Hold no frames out
    #[arg(long)]
    no_val: bool,
    /// Which frames are held out; time-blocks, views and au-combinations keep their distance [default: periodic]
    #[arg(long, value_enum, conflicts_with = "no_val")]
    split: Option<SplitArg>,
    /// The share of frames held out by time-blocks, views and au-combinations [default: 0.1]
    #[arg(long, value_name = "0..0.5")]
    val_share: Option<f64>,
    /// Seconds around held-out stretches and combinations that are in neither part [default: 0.25]
    #[arg(long, value_name = "SECS")]
    guard_secs: Option<f64>,
    /// Take all takes for one person, whatever they state and however their faces differ
    #[arg(long)]
    same_subject: bool,
    /// Leave out AUs that some takes lack instead of refusing
    #[arg(long)]
    common_aus: bool,
    /// Write no masks of the head
    #[arg(long)]
    no_head_masks: bool,
    /// Weight of even camera directions in the entropy objective; all AUs together weigh 1 [default: 0.25]
    #[arg(long, value_name = "W")]
    view_weight: Option<f64>,
    /// Weight of evenness in time in the entropy objective [default: 0.25]
    #[arg(long, value_name = "W")]
    time_weight: Option<f64>,
    /// Weight of sharpness in the entropy objective [default: 0.1]
    #[arg(long, value_name = "W")]
    sharp_weight: Option<f64>,
    /// A TOML file that says which AU belongs to which region [default: the paper's table]
    #[arg(long, value_name = "FILE.toml")]
    regions: Option<PathBuf>,
    #[command(flatten)]
    again: AgainArgs,
}

/// `[dataset]` of risorius.toml.
#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields, rename_all = "kebab-case")]
struct Settings {
    objective: Option<Objective>,
    sampling: Option<Sampling>,
    frames: Option<usize>,
    scale: Option<u32>,
    scales: Option<Vec<u32>>,
    levels: Option<usize>,
    count_existing: Option<bool>,
    min_confidence: Option<f32>,
    no_val: Option<bool>,
    bins: Option<Bins>,
    quota: Option<Quota>,
    split: Option<SplitKind>,
    val_share: Option<f64>,
    guard_secs: Option<f64>,
    same_subject: Option<bool>,
    common_aus: Option<bool>,
    no_head_masks: Option<bool>,
    view_weight: Option<f64>,
    time_weight: Option<f64>,
    sharp_weight: Option<f64>,
    regions: Option<PathBuf>,
}

pub(super) fn run(args: &Args, console: &Console) -> Result<(), Failure> {
    let settings: Settings = risorius_console::settings("dataset")?;
    let options = resolve(args, settings)?;
    let takes = takes_inputs(&args.takes);
    let names: Vec<_> = args.takes.iter().map(|take| take.file_name().unwrap_or_default().to_string_lossy()).collect();
    // The names stand in the tables; as a hash they say nothing about a take that is redacted later.
    let names = risorius_formats::hash::sha256_of_bytes(names.join("/").as_bytes());
    let asked = json!({ "options": &options, "takes": args.takes.len(), "names": names });
    let stage = Stage::new("dataset build", &args.out, &asked)?;
    let Some(running) = stage.begin(args.again, takes, console)? else { return Ok(()) };
    let built = crate::build_timed(&args.takes, &args.out, &options, console)?;
    let files = [
        "dataset.json",
        "metadata.json",
        "scene.json",
        "attributes.toml",
        "takes.toml",
        "intensities.csv",
        "landmarks.csv",
    ];
    running.finish(&files)?;
    console.finish(&Document::of(&built), &summary(&built.report, &args.out));
    Ok(())
}

/// What is read of the takes.
fn takes_inputs(takes: &[PathBuf]) -> Inputs {
    let is_read = |name: &str| {
        name.starts_with("poses/sparse/")
            || ["take.toml", "frames.csv", "track/openface.csv", "poses/report.json"].contains(&name)
    };
    takes.iter().zip(1..).fold(Inputs::default(), |all, (take, k)| all.folder(format!("take {k}"), take, is_read))
}

/// What `--json` says: the report, and how long the parts took, which no file of the dataset holds.
#[derive(Serialize)]
struct Document<'a> {
    #[serde(flatten)]
    report: &'a Report,
    seconds: Seconds,
}

#[derive(Serialize)]
struct Seconds {
    read_tracks: f64,
    attributes_masks_choice: f64,
    pictures: f64,
    documents: f64,
}

impl<'a> Document<'a> {
    fn of(built: &'a Built) -> Self {
        let seconds = Seconds {
            read_tracks: built.read.as_secs_f64(),
            attributes_masks_choice: built.choice.as_secs_f64(),
            pictures: built.pictures.as_secs_f64(),
            documents: built.documents.as_secs_f64(),
        };
        Self { report: &built.report, seconds }
    }
}

/// Command line, then risorius.toml, then defaults.
fn resolve(args: &Args, settings: Settings) -> Result<BuildOptions, Failure> {
    let default = BuildOptions::default();
    let sampling = match (args.uniform, args.balance, args.objective) {
        (true, ..) => Sampling::Uniform,
        (_, true, _) => Sampling::Balanced,
        (.., Some(objective)) => objective.into(),
        _ => settings.objective.map(Sampling::from).or(settings.sampling).unwrap_or_default(),
    };
    let bins = args.bins.map(|b| match b {
        BinsArg::Scale => Bins::Scale,
        BinsArg::Range => Bins::Range,
    });
    let quota = args.quota.map(|q| match q {
        QuotaArg::Running => Quota::Running,
        QuotaArg::Fixed => Quota::Fixed,
        QuotaArg::Ceiling => Quota::Ceiling,
    });
    let entropy = EntropyOptions {
        view_weight: args.view_weight.or(settings.view_weight).unwrap_or(default.entropy.view_weight),
        time_weight: args.time_weight.or(settings.time_weight).unwrap_or(default.entropy.time_weight),
        sharp_weight: args.sharp_weight.or(settings.sharp_weight).unwrap_or(default.entropy.sharp_weight),
        ..default.entropy
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
        no_val: args.no_val || (args.split.is_none() && settings.no_val.unwrap_or(default.no_val)),
        bins: bins.or(settings.bins).unwrap_or(default.bins),
        quota: quota.or(settings.quota).unwrap_or(default.quota),
        split: args.split.map(SplitKind::from).or(settings.split).unwrap_or(default.split),
        val_share: args.val_share.or(settings.val_share).unwrap_or(default.val_share),
        guard_secs: args.guard_secs.or(settings.guard_secs).unwrap_or(default.guard_secs),
        same_subject: args.same_subject || settings.same_subject.unwrap_or(default.same_subject),
        common_aus: args.common_aus || settings.common_aus.unwrap_or(default.common_aus),
        head_masks: !(args.no_head_masks || settings.no_head_masks.unwrap_or(!default.head_masks)),
        entropy,
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
        format!(
            "entropy of the blocks: {:.3} before, {:.3} evenly over time, {:.3} now; {} of {} cells of camera directions",
            report.evenness_before.block_entropy,
            report.evenness_uniform.block_entropy,
            report.evenness_after.block_entropy,
            report.coverage.cells_chosen,
            report.coverage.cells
        ),
        format!("look at {}", out.join("report").join("index.html").display()),
    ]
    .join("\n")
}
