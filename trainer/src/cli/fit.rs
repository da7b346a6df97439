//! `trainer fit`.

use std::path::PathBuf;

use risorius_console::{Console, Failure};
use risorius_formats::Reporter as _;
use serde::{Deserialize, Serialize};

use super::{DeviceArgs, need, parse_duration};
use crate::config::{FitSettings, PRESETS};
use crate::data::TrainData;
use crate::error::TrainerError;
use crate::fit::{self, Limits};
use crate::model::{ConfiesModel, region_groups};

/// Options of `trainer fit`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  trainer fit datasets/ada --out runs/ada\n  trainer fit datasets/ada --out runs/ada --budget 10m\n  trainer fit datasets/ada --out runs/ada --resume\n  trainer fit datasets/ada --out runs/paper --field confies --preset paper --dry-run --json"
)]
pub(super) struct FitArgs {
    /// The dataset's folder
    pub(super) dataset: PathBuf,
    /// The run's folder, which appears with the first checkpoint
    #[arg(long, value_name = "RUN")]
    pub(super) out: PathBuf,
    /// The field to fit: brick (fast) or confies (the paper's networks) [default: brick]
    #[arg(long, value_name = "NAME")]
    field: Option<String>,
    /// Sizes and schedules of confies: cpu, paper or tiny [default: cpu]
    #[arg(long, value_name = "NAME")]
    pub(super) preset: Option<String>,
    /// Wall time to spend, such as 60s or 10m; schedules are stretched to it [default for brick: 2m]
    #[arg(long, value_name = "TIME", value_parser = parse_duration, conflicts_with = "steps")]
    pub(super) budget: Option<f64>,
    /// Steps; schedules are stretched to them
    #[arg(long, value_name = "N")]
    pub(super) steps: Option<u64>,
    /// Seed of every random draw [default: 0]
    #[arg(long, value_name = "N")]
    pub(super) seed: Option<u64>,
    /// Rays per step of confies
    #[arg(long, value_name = "N")]
    pub(super) rays: Option<usize>,
    /// Image scale to fit, such as 4 [default: the dataset's]
    #[arg(long, value_name = "S")]
    pub(super) image_scale: Option<u32>,
    /// Steps between checkpoints
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub(super) checkpoint_every: Option<u64>,
    /// Change a setting of the brick field, as in its settings.toml, such as step.grid_rate=0.005; may be repeated
    #[arg(long, value_name = "KEY=VALUE")]
    pub(super) set: Vec<String>,
    #[command(flatten)]
    pub(super) skips: super::SkipArgs,
    /// Go on from the newest checkpoint in RUN
    #[arg(long)]
    pub(super) resume: bool,
    /// Replace an existing run
    #[arg(long, conflicts_with = "resume")]
    force: bool,
    /// Say what would be fitted, and its cost, without doing it
    #[arg(long)]
    pub(super) dry_run: bool,
    #[command(flatten)]
    pub(super) device: DeviceArgs,
}

/// `[trainer.fit]` of `risorius.toml`.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct FitFile {
    pub(super) preset: Option<String>,
    pub(super) steps: Option<u64>,
    pub(super) seed: Option<u64>,
    pub(super) rays: Option<usize>,
    pub(super) image_scale: Option<u32>,
}

/// `[trainer]` of `risorius.toml`.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct TrainerFile {
    pub(super) fit: FitFile,
}

#[derive(Serialize)]
struct Plan<'a> {
    parameters: usize,
    frames: usize,
    attributes: usize,
    regions: usize,
    image_scale: u32,
    settings: &'a FitSettings,
}

pub(super) fn run(args: &FitArgs, console: &Console) -> Result<(), Failure> {
    need(&args.dataset, "a dataset made by `dataset build`")?;
    match resolve_field(args)?.as_str() {
        "brick" => super::fit_brick::run(args, console),
        "confies" => run_confies(args, console),
        other => Err(Failure::usage(format!("there is no field `{other}`; fields: brick, confies"))),
    }
}

/// What `settings.toml` of a run says first.
#[derive(Deserialize)]
struct Begun {
    #[serde(default = "confies")]
    field: String,
}

/// Runs of before there were two fields do not say.
fn confies() -> String {
    "confies".to_owned()
}

/// The field of the run to resume, else what was asked for.
fn resolve_field(args: &FitArgs) -> Result<String, Failure> {
    if !args.resume {
        return Ok(args.field.clone().unwrap_or_else(|| "brick".to_owned()));
    }
    let Begun { field } = read_settings(&args.out)?;
    match &args.field {
        Some(asked) if *asked != field => {
            Err(Failure::input(format!("the run was begun with field `{field}`")).with_hint("leave out `--field`"))
        }
        _ => Ok(field),
    }
}

/// `settings.toml` of a run.
pub(super) fn read_settings<T: serde::de::DeserializeOwned>(run: &std::path::Path) -> Result<T, Failure> {
    let path = run.join("settings.toml");
    let text = std::fs::read_to_string(&path).map_err(|e| {
        risorius_formats::FormatError::io(&path, "read", &e)
            .with_hint("there is nothing to resume; leave out `--resume`")
    })?;
    Ok(toml::from_str(&text).map_err(|e| TrainerError::Run {
        path,
        message: e.message().to_owned(),
        hint: "the file is written by `trainer fit`; fit into a new folder".to_owned(),
    })?)
}

/// One line about a fit that ended.
pub(super) fn describe(summary: &fit::FitSummary) -> String {
    format!(
        "{}: {} steps in {:.0} s, {:.0} rays/s, {:.2} dB on the training rays",
        summary.run.display(),
        summary.steps,
        summary.seconds,
        summary.rays_per_sec,
        summary.train_psnr_db
    )
}

fn run_confies(args: &FitArgs, console: &Console) -> Result<(), Failure> {
    let settings = resolve(args)?;
    settings.validate()?;
    let device = args.device.device()?;
    if !args.dry_run {
        prepare_run(args)?;
    }
    let data = TrainData::load(&args.dataset, settings.image_scale, console)?;
    if args.dry_run {
        let model =
            ConfiesModel::new(&settings.model, &region_groups(&data.table), data.frames.len(), settings.seed, &device);
        let plan = Plan {
            parameters: burn::module::Module::num_params(&model),
            frames: data.frames.len(),
            attributes: data.table.attributes.len(),
            regions: data.table.regions.len(),
            image_scale: data.scale,
            settings: &settings,
        };
        let human = format!(
            "would fit {} parameters to {} frames (scale {}) in {} steps of {} rays",
            plan.parameters, plan.frames, plan.image_scale, settings.steps, settings.rays
        );
        console.finish(&plan, &human);
        return Ok(());
    }
    let limits = Limits { budget_secs: args.budget };
    let summary = fit::fit(&data, &settings, limits, &args.out, goes_on(args, console), &device, console)?;
    console.finish(&summary, &describe(&summary));
    Ok(())
}

/// Command line, then the settings of the run to resume, then `risorius.toml`, then the preset.
fn resolve(args: &FitArgs) -> Result<FitSettings, Failure> {
    if args.resume {
        let mut settings: FitSettings = read_settings(&args.out)?;
        if let Some(preset) = &args.preset
            && *preset != settings.preset
        {
            return Err(Failure::input(format!("the run was begun with preset `{}`", settings.preset))
                .with_hint("leave out `--preset`"));
        }
        if let Some(steps) = args.steps {
            settings.steps = steps;
        }
        return Ok(settings);
    }
    let file: TrainerFile = risorius_console::settings("trainer")?;
    let file = file.fit;
    let preset = args.preset.clone().or(file.preset).unwrap_or_else(|| PRESETS[0].to_owned());
    let mut settings = FitSettings::preset(&preset)?;
    if let Some(steps) = args.steps.or(file.steps) {
        settings = settings.with_steps(steps);
    }
    settings.seed = args.seed.or(file.seed).unwrap_or(settings.seed);
    settings.checkpoint_every = args.checkpoint_every.unwrap_or(settings.checkpoint_every);
    settings.rays = args.rays.or(file.rays).unwrap_or(settings.rays);
    settings.image_scale = args.image_scale.or(file.image_scale).unwrap_or(settings.image_scale);
    Ok(settings)
}

/// Whether to go on from a checkpoint: a fit that ended before its first one is begun anew, with its own settings.
pub(super) fn goes_on(args: &FitArgs, console: &Console) -> bool {
    let has_checkpoint = !fit::checkpoint::list(&args.out).is_empty();
    if args.resume && !has_checkpoint {
        console.note(&format!("{}: no checkpoint yet: begun anew with the same settings", args.out.display()));
    }
    args.resume && has_checkpoint
}

/// Refuses to mix two fits in one folder.
pub(super) fn prepare_run(args: &FitArgs) -> Result<(), Failure> {
    if args.resume {
        return Ok(());
    }
    let taken = args.out.join("settings.toml").exists() || args.out.join("checkpoints").exists();
    if taken && !args.force {
        return Err(Failure::input(format!("{}: there is a run already", args.out.display()))
            .with_hint("go on with `--resume`, or replace it with `--force`"));
    }
    if taken {
        for name in ["checkpoints", "eval"] {
            let path = args.out.join(name);
            if path.exists() {
                std::fs::remove_dir_all(&path).map_err(|e| risorius_formats::FormatError::io(&path, "remove", &e))?;
            }
        }
    }
    Ok(())
}
