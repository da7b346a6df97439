//! How long a fit will take: a few rays of it are timed on this machine, and scaled up.

use std::time::Instant;

use burn::tensor::Device;
use serde::Serialize;

use super::confies::{adam, with_gradients};
use super::norms;
use super::step::{gradients, host};
use crate::config::FitSettings;
use crate::cost::StepCost;
use crate::data::TrainData;
use crate::error::Result;
use crate::model::{ConfiesModel, region_groups};
use crate::space::NetSpace;

/// Arithmetic worth timing: a second or so on two cores.
const PROBE_FLOPS: f64 = 3e10;

/// What a fit is expected to take. An estimate: other work on the machine changes it.
#[derive(Clone, Debug, Serialize)]
pub struct Estimate {
    /// Wall seconds of a step.
    pub seconds_per_step: f64,
    /// Steps per second.
    pub iterations_per_sec: f64,
    /// Wall seconds of all steps; those that leave the uncertainty nets out are taken to be faster by their arithmetic.
    pub expected_secs: f64,
    /// Floating-point operations per second as papers count them.
    pub flops_per_sec: f64,
    /// How this was found.
    pub measured: String,
}

/// Times a step of a few rays and the optimiser's step for all parameters.
pub fn estimate(data: &TrainData, settings: &FitSettings, cost: &StepCost, device: &Device) -> Result<Estimate> {
    let device = with_gradients(device, settings);
    let space = NetSpace::new(&data.dataset.scene, data.extras(), settings.model.head_radius);
    let groups = region_groups(&data.table);
    let mut model = ConfiesModel::new(&settings.model, &groups, data.frames.len(), settings.seed, &device);
    let mut optimizer = adam();
    let per_ray = cost.flops_per_iteration / settings.rays as f64;
    let rays = ((PROBE_FLOPS / per_ray) as usize).clamp(1, settings.rays);
    let probe = FitSettings { rays, micro_rays: 0, ..settings.clone() };
    let (mut in_networks, mut in_optimizer) = (f64::INFINITY, f64::INFINITY);
    for step in 1..=3 {
        let started = Instant::now();
        let (gradients, _) = gradients(&model, data, &space, &probe, step)?;
        norms::GradientNorms::of(&model, &gradients).check_finite(step)?;
        let done = Instant::now();
        model = optimizer.step(settings.learning_rate.at(step), model, gradients);
        // Devices compute while the program goes on; a number read back is a number computed.
        host(model.latent_codes(burn::tensor::Tensor::from_data([0i32], &device)));
        in_networks = in_networks.min((done - started).as_secs_f64());
        in_optimizer = in_optimizer.min(done.elapsed().as_secs_f64());
    }
    let per_flop = in_networks / (rays as f64 * per_ray);
    let seconds_per_step = per_flop * cost.flops_per_iteration + in_optimizer;
    let expected_secs = per_flop * cost.flops_total + in_optimizer * settings.steps as f64;
    Ok(Estimate {
        seconds_per_step,
        iterations_per_sec: 1.0 / seconds_per_step,
        expected_secs,
        flops_per_sec: 1.0 / per_flop,
        measured: format!(
            "on this machine just now: the fastest of three steps of {rays} rays, scaled to {}, and of Adam on all parameters",
            settings.rays
        ),
    })
}
