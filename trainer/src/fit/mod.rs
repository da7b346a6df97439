//! The loop: draw rays, render both levels, sum the losses, step the optimiser, write what happened.

pub mod checkpoint;
pub mod estimate;
pub mod metrics;
pub mod norms;
mod step;
pub mod tensorboard;

use std::path::{Path, PathBuf};
use std::time::Instant;

use burn::module::Module as _;
use burn::optim::{AdamConfig, ModuleOptimizer};
use burn::tensor::Device;
use risorius_formats::run::RunManifest;
use risorius_formats::{Reporter, Warning};
use serde::Serialize;

use crate::config::FitSettings;
use crate::data::TrainData;
use crate::devices;
use crate::error::{Result, TrainerError};
use crate::model::{ConfiesModel, region_groups};
use crate::saved::SavedModel;
use crate::space::NetSpace;

pub use step::{StepNumbers, gradients, losses};
pub(crate) use step::{host, points, rows};

/// What a fit did.
#[derive(Clone, Debug, Serialize)]
pub struct FitSummary {
    /// The run's folder.
    pub run: PathBuf,
    /// Steps done in total.
    pub steps: u64,
    /// Wall seconds in total, resumed parts included.
    pub seconds: f64,
    /// Rays per second of this call.
    pub rays_per_sec: f64,
    /// Samples along these rays per second, forward and backward.
    pub samples_per_sec: f64,
    /// PSNR of the last steps' rays, dB.
    pub train_psnr_db: f64,
    /// Trainable numbers.
    pub parameters: usize,
    /// Training frames.
    pub frames: usize,
    /// Image scale that was fitted.
    pub scale: u32,
    /// Whether the schedule ended (or a budget or Ctrl-C ended it early).
    pub finished: bool,
}

/// When a fit ends before its schedule does.
#[derive(Clone, Copy, Debug, Default)]
pub struct Limits {
    /// Wall seconds for the fit; schedules are fitted to it by the measured pace.
    pub budget_secs: Option<f64>,
}

/// A fit in progress.
struct State {
    model: ConfiesModel,
    optimizer: ModuleOptimizer,
    step: u64,
    seconds_before: f64,
}

/// Fits an avatar of `data` into the folder `run`.
///
/// With `resume`, goes on from the newest checkpoint; without, an existing run is refused by the caller.
pub fn fit(
    data: &TrainData,
    settings: &FitSettings,
    limits: Limits,
    run: &Path,
    resume: bool,
    device: &Device,
    reporter: &dyn Reporter,
) -> Result<FitSummary> {
    settings.validate()?;
    let mut settings = settings.clone();
    devices::check(device, settings.model.products)?;
    let device = with_gradients(device, &settings);
    let space = NetSpace::new(&data.dataset.scene, data.extras(), settings.model.head_radius);
    let mut state = start(data, &settings, run, resume, &device)?;
    let parameters = state.model.num_params();
    reporter.note(&format!(
        "{} frames of {}×{}, {} attributes in {} regions, {parameters} parameters",
        data.frames.len(),
        data.frames[0].camera.intrinsics.width,
        data.frames[0].camera.intrinsics.height,
        data.table.attributes.len(),
        data.table.regions.len(),
    ));

    let started = Instant::now();
    if let (Some(budget), 0) = (limits.budget_secs, state.step) {
        settings = fit_to_budget(data, &space, settings, budget, &state.model, reporter)?;
    }
    settings_to_disk(&settings, run)?;
    let first_step = state.step;
    let mut log = metrics::MetricsLog::open(run, first_step)?;
    let mut recent = metrics::Recent::default();
    reporter.stage("fit", Some(settings.steps));
    reporter.advance(first_step);
    let mut stopped = false;
    let training_started = Instant::now();
    while state.step < settings.steps {
        if reporter.cancelled() || limits.budget_secs.is_some_and(|b| started.elapsed().as_secs_f64() > b * 1.05) {
            stopped = true;
            break;
        }
        let step = state.step + 1;
        let (grads, numbers) = gradients(&state.model, data, &space, &settings, step)?;
        let norms = norms::GradientNorms::of(&state.model, &grads);
        norms.check_finite(step)?;
        state.model = state.optimizer.step(settings.learning_rate.at(step), state.model, grads);
        state.step = step;
        recent.add(numbers.reconstruction_fine);
        let seconds = state.seconds_before + started.elapsed().as_secs_f64();
        let rates = [settings.learning_rate.at(step), settings.attribute_weight.at(step)];
        log.record(step, seconds, rates, &numbers, &norms)?;
        reporter.advance(1);
        if step % 50 == 0 {
            reporter.note(&format!("step {step}: {:.2} dB", recent.psnr_db()));
        }
        if step % settings.checkpoint_every == 0 || step == settings.steps {
            save(&state, seconds, data, &settings, &space, run)?;
        }
    }
    let seconds = state.seconds_before + started.elapsed().as_secs_f64();
    log.finish()?;
    let finished = state.step >= settings.steps;
    if !finished {
        save(&state, seconds, data, &settings, &space, run)?;
    }
    if stopped && reporter.cancelled() {
        return Err(TrainerError::Interrupted { done: format!("step {} of {}", state.step, settings.steps) });
    }
    if stopped {
        reporter.warn(Warning::new("budget", format!("the time ran out at step {} of {}", state.step, settings.steps)));
    }
    let rays = (state.step - first_step) as f64 * settings.rays as f64;
    Ok(FitSummary {
        run: run.to_owned(),
        steps: state.step,
        seconds,
        rays_per_sec: rays / training_started.elapsed().as_secs_f64().max(1e-9),
        // The fine pass looks at the coarse samples once more.
        samples_per_sec: rays * (2 * settings.coarse_samples + settings.fine_samples) as f64
            / training_started.elapsed().as_secs_f64().max(1e-9),
        train_psnr_db: recent.psnr_db(),
        parameters,
        frames: data.frames.len(),
        scale: data.scale,
        finished,
    })
}

fn start(data: &TrainData, settings: &FitSettings, run: &Path, resume: bool, device: &Device) -> Result<State> {
    let groups = region_groups(&data.table);
    let model = ConfiesModel::new(&settings.model, &groups, data.frames.len(), settings.seed, device);
    let optimizer = adam();
    if !resume {
        return Ok(State { model, optimizer, step: 0, seconds_before: 0.0 });
    }
    let loaded = checkpoint::load(run, model, optimizer, &data.sha256)?;
    Ok(State { model: loaded.model, optimizer: loaded.optimizer, step: loaded.step, seconds_before: loaded.seconds })
}

/// The device, with gradients recorded as the settings ask for.
fn with_gradients(device: &Device, settings: &FitSettings) -> Device {
    let device = device.clone().autodiff();
    if settings.recompute { device.gradient_checkpointing() } else { device }
}

/// Adam as the family sets it (fact sheet §2.6): β 0.9 and 0.999, ε 1e-8, bias correction, no decay, no clipping.
fn adam() -> ModuleOptimizer {
    AdamConfig::new().with_beta_1(0.9).with_beta_2(0.999).with_epsilon(1e-8).init()
}

/// Times a few steps on a throw-away copy and stretches the schedules to what fits into `budget` seconds.
fn fit_to_budget(
    data: &TrainData,
    space: &NetSpace,
    settings: FitSettings,
    budget: f64,
    model: &ConfiesModel,
    reporter: &dyn Reporter,
) -> Result<FitSettings> {
    const PROBES: u32 = 6;
    let probe = |step: u64| -> Result<()> { gradients(model, data, space, &settings, step).map(drop) };
    probe(1)?;
    let started = Instant::now();
    for step in 2..2 + u64::from(PROBES) {
        probe(step)?;
    }
    // The optimiser's step and the log are not in the probe; they take about a tenth.
    let per_step = started.elapsed().as_secs_f64() / f64::from(PROBES) * 1.1;
    let steps = ((budget / per_step) as u64).clamp(20, 2_000_000);
    reporter.note(&format!("{:.0} ms per step: {steps} steps fit into {budget:.0} s", per_step * 1e3));
    Ok(settings.with_steps(steps))
}

pub(crate) fn settings_to_disk(settings: &impl Serialize, run: &Path) -> Result<()> {
    let path = run.join("settings.toml");
    let text = toml::to_string(settings).map_err(|e| TrainerError::Setting {
        message: format!("the settings cannot be written: {e}"),
        hint: String::new(),
    })?;
    Ok(risorius_formats::atomic::write_file(path, text.as_bytes())?)
}

fn save(
    state: &State,
    seconds: f64,
    data: &TrainData,
    settings: &FitSettings,
    space: &NetSpace,
    run: &Path,
) -> Result<()> {
    checkpoint::save(run, &state.model, &state.optimizer, state.step, seconds, &data.sha256)?;
    SavedModel::describe_confies(data, settings, space).write(run, &state.model)?;
    manifest(data, "confies", settings.seed, state.step, seconds).write(run.join("run.json"))?;
    Ok(())
}

/// `RUN/run.json`.
pub(crate) fn manifest(data: &TrainData, field: &str, seed: u64, steps: u64, seconds: f64) -> RunManifest {
    RunManifest {
        version: 1,
        dataset: data.dir.clone(),
        dataset_sha256: data.sha256.clone(),
        field: field.to_owned(),
        seed,
        steps,
        seconds,
        written_by: format!("risorius {}", env!("CARGO_PKG_VERSION")),
    }
}
