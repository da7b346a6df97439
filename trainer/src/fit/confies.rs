//! The paper's networks in the loop: draw rays, render both levels, sum the losses, step the optimiser.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Instant;

use burn::module::Module as _;
use burn::optim::{AdamConfig, ModuleOptimizer};
use burn::tensor::Device;
use risorius_formats::Reporter;
use serde::{Deserialize, Serialize};

use super::norms::GradientNorms;
use super::{FitSummary, Length, Plan, checkpoint, drive, gradients, note_scene, settings_to_disk};
use crate::config::FitSettings;
use crate::data::TrainData;
use crate::devices;
use crate::error::Result;
use crate::field::{FieldFit, StepReport};
use crate::model::{ConfiesModel, region_groups};
use crate::saved::SavedModel;
use crate::space::NetSpace;

/// When a fit ends before its schedule does.
#[derive(Clone, Copy, Debug, Default)]
pub struct Limits {
    /// Wall seconds for the fit; schedules are fitted to it by the measured pace.
    pub budget_secs: Option<f64>,
}

/// Unweighted terms of a step.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct ConfiesNumbers {
    /// Learning rate.
    pub learning_rate: f64,
    /// L_recon of the coarse level.
    pub reconstruction_coarse: f64,
    /// L_recon of the fine level.
    pub reconstruction: f64,
    /// L_mask, both levels.
    pub mask: f64,
    /// L_attr, both levels.
    pub attribute: f64,
    /// L_lat.
    pub latent: f64,
    /// Weight of L_attr.
    pub attribute_weight: f64,
    /// ‖∇‖₂ of everything.
    pub gradient_norm: f64,
    /// ‖∇‖₂ by part of the model.
    pub gradient_norms: BTreeMap<String, f64>,
}

/// A fit in progress.
struct ConfiesFit<'a> {
    data: &'a TrainData,
    settings: FitSettings,
    space: NetSpace,
    model: ConfiesModel,
    optimizer: ModuleOptimizer,
    step: u64,
}

impl FieldFit for ConfiesFit<'_> {
    type Numbers = ConfiesNumbers;

    fn step(&self) -> u64 {
        self.step
    }

    fn parameters(&self) -> usize {
        self.model.num_params()
    }

    /// Schedules go by the step.
    fn advance(&mut self, _done: f64) -> Result<StepReport<ConfiesNumbers>> {
        let Self { data, settings, space, .. } = self;
        let step = self.step + 1;
        let (grads, n) = gradients(&self.model, data, space, settings, step)?;
        let norms = GradientNorms::of(&self.model, &grads);
        norms.check_finite(step)?;
        let learning_rate = settings.learning_rate.at(step);
        self.model = self.optimizer.step(learning_rate, self.model.clone(), grads);
        self.step = step;
        Ok(StepReport {
            mse: n.reconstruction_fine,
            pixels: settings.rays,
            // Looked at before the optimiser's step.
            checked: Vec::new(),
            numbers: ConfiesNumbers {
                learning_rate,
                reconstruction_coarse: n.reconstruction_coarse,
                reconstruction: n.reconstruction_fine,
                mask: n.mask,
                attribute: n.attribute,
                latent: n.latent,
                attribute_weight: settings.attribute_weight.at(step),
                gradient_norm: norms.total(),
                gradient_norms: norms.parts,
            },
        })
    }

    fn write_checkpoint(&mut self, folder: &Path) -> Result<()> {
        checkpoint::write(folder, &self.model, &self.optimizer)
    }

    fn write_avatar(&mut self, run: &Path, _last: bool) -> Result<()> {
        SavedModel::describe_confies(self.data, &self.settings, &self.space).write(run, &self.model)
    }
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
    devices::check(device, settings.model.products)?;
    let device = with_gradients(device, settings);
    let (mut fit, seconds_before) = start(data, settings, run, resume, &device)?;
    note_scene(data, fit.parameters(), reporter);
    let started = Instant::now();
    if let (Some(budget), 0) = (limits.budget_secs, fit.step) {
        fit.settings = fit_to_budget(&fit, budget, reporter)?;
    }
    settings_to_disk(&fit.settings, run)?;
    let plan = Plan {
        data,
        run,
        field: "confies",
        seed: settings.seed,
        length: Length { steps: Some(fit.settings.steps), budget_secs: limits.budget_secs },
        checkpoint_every: fit.settings.checkpoint_every,
        started,
        seconds_before,
    };
    drive(&mut fit, &plan, reporter)
}

fn start<'a>(
    data: &'a TrainData,
    settings: &FitSettings,
    run: &Path,
    resume: bool,
    device: &Device,
) -> Result<(ConfiesFit<'a>, f64)> {
    let groups = region_groups(&data.table);
    let model = ConfiesModel::new(&settings.model, &groups, data.frames.len(), settings.seed, device);
    let space = NetSpace::new(&data.dataset.scene, data.extras(), settings.model.head_radius);
    let mut fit = ConfiesFit { data, settings: settings.clone(), space, model, optimizer: adam(), step: 0 };
    if !resume {
        return Ok((fit, 0.0));
    }
    let loaded = checkpoint::load(run, fit.model, fit.optimizer, &data.sha256)?;
    (fit.model, fit.optimizer, fit.step) = (loaded.model, loaded.optimizer, loaded.step);
    Ok((fit, loaded.seconds))
}

/// The device, with gradients recorded as the settings ask for.
pub(super) fn with_gradients(device: &Device, settings: &FitSettings) -> Device {
    let device = device.clone().autodiff();
    if settings.recompute { device.gradient_checkpointing() } else { device }
}

/// Adam as the family sets it (fact sheet §2.6): β 0.9 and 0.999, ε 1e-8, bias correction, no decay, no clipping.
pub(super) fn adam() -> ModuleOptimizer {
    AdamConfig::new().with_beta_1(0.9).with_beta_2(0.999).with_epsilon(1e-8).init()
}

/// Times a few steps and stretches the schedules to what fits into `budget` seconds.
fn fit_to_budget(fit: &ConfiesFit<'_>, budget: f64, reporter: &dyn Reporter) -> Result<FitSettings> {
    const PROBES: u32 = 6;
    let probe = |step: u64| gradients(&fit.model, fit.data, &fit.space, &fit.settings, step).map(drop);
    probe(1)?;
    let started = Instant::now();
    for step in 2..2 + u64::from(PROBES) {
        probe(step)?;
    }
    // The optimiser's step and the log are not in the probe; they take about a tenth.
    let per_step = started.elapsed().as_secs_f64() / f64::from(PROBES) * 1.1;
    let steps = ((budget / per_step) as u64).clamp(20, 2_000_000);
    reporter.note(&format!("{:.0} ms per step: {steps} steps fit into {budget:.0} s", per_step * 1e3));
    Ok(fit.settings.clone().with_steps(steps))
}
