//! `trainer fit`.

use std::path::PathBuf;

use risorius_console::{AgainArgs, Console, Failure, Inputs, Running, Stage};
use risorius_formats::Reporter as _;
use serde::{Deserialize, Serialize};

use super::{DeviceArgs, need, parse_bytes, parse_duration};
use crate::config::{FitSettings, ModelKind, PRESETS};
use crate::cost::StepCost;
use crate::data::TrainData;
use crate::error::TrainerError;
use crate::fit;
use crate::fit::confies::Limits;
use crate::fit::estimate::{Estimate, estimate};
use crate::model::region_groups;
use crate::saved::check_field;

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
    /// The field to fit: splat (Gaussians, fast) or confies (the paper's networks) [default: splat]
    #[arg(long, value_name = "NAME")]
    field: Option<String>,
    /// Sizes and schedules of confies: cpu, paper (its words), code (the released code) or tiny [default: cpu]
    #[arg(long, value_name = "NAME")]
    pub(super) preset: Option<String>,
    /// With `--field confies`, a model of the paper's tables instead: conerf, conerf-m, hypernerf, hypernerf-ap, nerfies,
    /// nerf-latent or nerf [default: confies]
    #[arg(long, value_name = "NAME")]
    pub(super) model: Option<ModelKind>,
    /// Fit every so many frames of the dataset and hold out those in the middle; 2 is the paper's interpolation test
    #[arg(long, value_name = "N")]
    pub(super) interval: Option<usize>,
    /// Memory that confies may take, such as 2GiB: rays go through the networks in parts, with the same gradient
    #[arg(long, value_name = "SIZE", value_parser = parse_bytes)]
    pub(super) memory_limit: Option<u64>,
    /// Wall time to spend, such as 60s or 10m; schedules are stretched to it [default for splat: 1m]
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
    /// Steps between checkpoints [default for splat: by time, a minute or more apart]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub(super) checkpoint_every: Option<u64>,
    /// Change a setting, as in settings.toml, such as splat.gaussians=50000 or model.hyper_dims=4; may be repeated
    #[arg(long, value_name = "KEY=VALUE")]
    pub(super) set: Vec<String>,
    #[command(flatten)]
    pub(super) skips: super::SkipArgs,
    /// Go on from the newest checkpoint in RUN
    #[arg(long)]
    pub(super) resume: bool,
    #[command(flatten)]
    pub(super) again: AgainArgs,
    /// Replace an existing run
    #[arg(long, conflicts_with = "resume")]
    force: bool,
    /// Say what would be fitted, and its cost, without doing it
    #[arg(long)]
    pub(super) dry_run: bool,
    #[command(flatten)]
    pub(super) device: DeviceArgs,
}

/// What makes a finished run.
pub(super) const OUTPUTS: [&str; 2] = ["model.safetensors", "model.json"];

/// `[trainer.fit]` of `risorius.toml`.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct FitFile {
    pub(super) field: Option<String>,
    pub(super) preset: Option<String>,
    pub(super) steps: Option<u64>,
    /// As on the command line, such as `10m`.
    pub(super) budget: Option<String>,
    pub(super) seed: Option<u64>,
    pub(super) rays: Option<usize>,
    pub(super) image_scale: Option<u32>,
}

impl FitFile {
    /// Wall seconds, where steps are not asked for.
    pub(super) fn budget_secs(&self) -> Result<Option<f64>, Failure> {
        let parse = |text: &String| {
            parse_duration(text).map_err(|e| Failure::usage(format!("risorius.toml, trainer.fit.budget: {e}")))
        };
        self.budget.as_ref().filter(|_| self.steps.is_none()).map(parse).transpose()
    }
}

/// `[trainer]` of `risorius.toml`.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct TrainerFile {
    pub(super) fit: FitFile,
}

#[derive(Serialize)]
struct Plan<'a> {
    #[serde(flatten)]
    cost: StepCost,
    expected: Estimate,
    frames: usize,
    attributes: usize,
    regions: usize,
    image_scale: u32,
    settings: &'a FitSettings,
}

pub(super) fn run(args: &FitArgs, console: &Console) -> Result<(), Failure> {
    need(&args.dataset, "a dataset made by `dataset build`")?;
    match resolve_field(args)?.as_str() {
        "splat" => super::fit_splat::run(args, console),
        "confies" => run_confies(args, console),
        other => Err(Failure::usage(format!("there is no field `{other}`; fields: splat, confies"))),
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
        let file: TrainerFile = risorius_console::settings("trainer")?;
        return Ok(args.field.clone().or(file.fit.field).unwrap_or_else(|| "splat".to_owned()));
    }
    let Begun { field } = read_settings(&args.out)?;
    check_field(&field, &args.out)?;
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
        "{}: {} steps in {:.0} s, {:.0} pixels/s, {:.2} dB on the training pixels",
        summary.run.display(),
        summary.steps,
        summary.seconds,
        summary.pixels_per_sec,
        summary.train_psnr_db
    )
}

/// Takes the run's lock and decides whether a fit that was begun goes on: because that was asked for, or, with
/// `--if-changed`, because it is the same one. `settings` are those of a new fit. `None`: there is nothing to do.
pub(super) fn begin(
    args: &FitArgs,
    settings: &impl Serialize,
    console: &Console,
) -> Result<Option<(Running, bool)>, Failure> {
    let asked = serde_json::json!({ "settings": settings, "budget_secs": args.budget });
    let stage = Stage::new("trainer fit", &args.out, &asked)?;
    let inputs = Inputs::default().folder("dataset", &args.dataset, |name| !name.starts_with("report/"));
    let Some(running) = stage.begin(args.again, inputs, console)? else { return Ok(None) };
    let begun = args.again.if_changed && running.is_unfinished();
    // A fit that ended before its first checkpoint is begun anew, with its own settings.
    let can_go_on = !fit::checkpoint::list(&args.out).is_empty();
    let resume = (args.resume || begun) && can_go_on;
    if resume && !args.resume {
        console.say(&format!("{}: goes on from its newest checkpoint", args.out.display()));
    } else if args.resume && !resume {
        console.note(&format!("{}: no checkpoint yet: begun anew with the same settings", args.out.display()));
    }
    prepare_run(args, args.resume || resume, begun)?;
    Ok(Some((running, resume)))
}

fn run_confies(args: &FitArgs, console: &Console) -> Result<(), Failure> {
    let mut settings = resolve(args, args.resume)?;
    settings.validate()?;
    let device = args.device.device()?;
    let mut work = None;
    if !args.dry_run {
        let Some((running, resume)) = begin(args, &settings, console)? else { return Ok(()) };
        if resume {
            settings = resolve(args, true)?;
        }
        work = Some((running, resume));
    }
    let data = TrainData::load_every(&args.dataset, settings.image_scale, settings.interval, console)?;
    let groups = region_groups(&data.table);
    let cost = StepCost::of(&settings, &groups, data.frames.len(), data.bytes());
    if let Some(limit) = args.memory_limit {
        settings.micro_rays = rays_within(&cost, limit, settings.rays)?;
    }
    if args.dry_run {
        let cost = StepCost::of(&settings, &groups, data.frames.len(), data.bytes());
        let plan = Plan {
            expected: estimate(&data, &settings, &cost, &device)?,
            cost,
            frames: data.frames.len(),
            attributes: data.table.attributes.len(),
            regions: data.table.regions.len(),
            image_scale: data.scale,
            settings: &settings,
        };
        console.finish(&plan, &plan.words());
        return Ok(());
    }
    let file: TrainerFile = risorius_console::settings("trainer")?;
    let by_file = if args.steps.is_none() { file.fit.budget_secs()? } else { None };
    let limits = Limits { budget_secs: args.budget.or(by_file) };
    let Some((running, resume)) = work else { return Err(Failure::bug("a fit without a lock")) };
    running.mark()?;
    let summary = fit::confies::fit(&data, &settings, limits, &args.out, resume, &device, console)?;
    running.finish(&OUTPUTS)?;
    console.finish(&summary, &describe(&summary));
    Ok(())
}

/// Rays that may go together; 0 for all.
fn rays_within(cost: &StepCost, limit: u64, rays: usize) -> Result<usize, Failure> {
    let memory = &cost.memory;
    match memory.rays_within(limit) {
        Some(together) if together >= rays => Ok(0),
        Some(together) => Ok(together),
        None => {
            let fixed = mib(memory.program_bytes + memory.parameters_bytes + memory.images_bytes);
            Err(Failure::input(format!("`--memory-limit`: {:.0} MiB are too little", mib(limit))).with_hint(format!(
                "the program, images, weights and moments alone take {fixed:.0} MiB; choose a coarser `--image-scale` or a smaller preset"
            )))
        }
    }
}

fn mib(bytes: u64) -> f64 {
    bytes as f64 / (1024.0 * 1024.0)
}

impl Plan<'_> {
    fn words(&self) -> String {
        let (cost, memory, expected) = (&self.cost, &self.cost.memory, &self.expected);
        format!(
            "would fit {} parameters to {} frames (scale {}) in {} steps of {} rays\n\
             {:.3} TFLOP per step, {:.0} MiB of memory ({} rays together)\n\
             about {} in all, {:.2} s per step ({})",
            cost.parameters,
            self.frames,
            self.image_scale,
            self.settings.steps,
            self.settings.rays,
            cost.flops_per_iteration * 1e-12,
            mib(memory.total_bytes),
            memory.rays_together,
            duration(expected.expected_secs),
            expected.seconds_per_step,
            expected.measured,
        )
    }
}

fn duration(secs: f64) -> String {
    if secs < 120.0 {
        format!("{secs:.0} s")
    } else if secs < 7200.0 {
        format!("{:.0} min", secs / 60.0)
    } else if secs < 172_800.0 {
        format!("{:.1} h", secs / 3600.0)
    } else {
        format!("{:.0} days", secs / 86_400.0)
    }
}

/// Command line, then the settings of the run to resume, then `risorius.toml`, then the preset.
fn resolve(args: &FitArgs, resume: bool) -> Result<FitSettings, Failure> {
    if resume {
        let mut settings: FitSettings = read_settings(&args.out)?;
        if let Some(preset) = &args.preset
            && *preset != settings.preset
        {
            return Err(Failure::input(format!("the run was begun with preset `{}`", settings.preset))
                .with_hint("leave out `--preset`"));
        }
        if args.model.is_some_and(|m| m != settings.model.kind) {
            let begun = settings.model.kind.name();
            return Err(
                Failure::input(format!("the run was begun with model `{begun}`")).with_hint("leave out `--model`")
            );
        }
        if let Some(steps) = args.steps {
            settings.steps = steps;
        }
        return Ok(settings);
    }
    let file: TrainerFile = risorius_console::settings("trainer")?;
    let file = file.fit;
    let preset = args.preset.clone().or(file.preset).unwrap_or_else(|| PRESETS[0].to_owned());
    let mut settings = FitSettings::preset(&preset)?.with_model(args.model.unwrap_or_default());
    settings.interval = args.interval.unwrap_or(settings.interval);
    if let Some(steps) = args.steps.or(file.steps) {
        settings = settings.with_steps(steps);
    }
    settings.seed = args.seed.or(file.seed).unwrap_or(settings.seed);
    settings.checkpoint_every = args.checkpoint_every.unwrap_or(settings.checkpoint_every);
    settings.rays = args.rays.or(file.rays).unwrap_or(settings.rays);
    settings.image_scale = args.image_scale.or(file.image_scale).unwrap_or(settings.image_scale);
    args.set.iter().try_fold(settings, |settings, change| changed(&settings, change))
}

/// The settings with one changed, `KEY=VALUE` as in `settings.toml`; dots lead into tables.
pub(super) fn changed<T: Serialize + serde::de::DeserializeOwned>(settings: &T, change: &str) -> Result<T, Failure> {
    let wrong = |why: &str| Failure::usage(format!("`--set {change}`: {why}"));
    let (key, value) = change.split_once('=').ok_or_else(|| wrong("expected KEY=VALUE"))?;
    let mut value: toml::Table = toml::from_str(&format!("value = {value}")).map_err(|e| wrong(e.message()))?;
    let value = value.remove("value").ok_or_else(|| wrong("no value"))?;
    let mut all = toml::Table::try_from(settings).map_err(|e| wrong(&e.to_string()))?;
    let (tables, last) = key.trim().rsplit_once('.').map_or((None, key.trim()), |(t, l)| (Some(t), l));
    let mut table = &mut all;
    for name in tables.iter().flat_map(|t| t.split('.')) {
        table =
            table.get_mut(name).and_then(toml::Value::as_table_mut).ok_or_else(|| wrong("there is no such table"))?;
    }
    if !table.contains_key(last) {
        let known: Vec<&str> = table.keys().map(String::as_str).collect();
        return Err(wrong(&format!("there is no such setting here, only {}", known.join(", "))));
    }
    table.insert(last.to_owned(), value);
    all.try_into().map_err(|e: toml::de::Error| wrong(e.message()))
}

/// Refuses to mix two fits in one folder. What is `ours` is a fit that was begun and left nothing to go on from.
fn prepare_run(args: &FitArgs, resume: bool, ours: bool) -> Result<(), Failure> {
    if resume {
        return Ok(());
    }
    let taken = args.out.join("settings.toml").exists() || args.out.join("checkpoints").exists();
    if taken && !args.force && !ours {
        return Err(Failure::input(format!("{}: there is a run already", args.out.display()))
            .with_hint("go on with `--resume`, or replace it with `--force`"));
    }
    if taken {
        for name in ["checkpoints", "eval", fit::tensorboard::FOLDER] {
            let path = args.out.join(name);
            if path.exists() {
                std::fs::remove_dir_all(&path).map_err(|e| risorius_formats::FormatError::io(&path, "remove", &e))?;
            }
        }
    }
    Ok(())
}
