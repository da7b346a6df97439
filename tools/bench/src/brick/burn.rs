//! A step of a fitted avatar through Burn: rays by the operation, a loss on tensors, Burn's Adam over whole tensors. What it
//! takes beside a fit's own step is why a fit does not go this way.

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use burn::optim::{AdamConfig, GradientsParams};
use burn::tensor::{Device, Tensor};
use glam::DVec2;
use risorius_brick::batch::{self, RayBatch, RayValues};
use risorius_brick::model::activation;
use risorius_console::Failure;
use risorius_formats::Camera;
use risorius_trainer::Avatar;
use risorius_trainer::brick::tensors::{BrickParameters, RayScene, render_rays};
use serde::Serialize;

use super::pictures::median;

/// Rays of a step: those of a fit's 64,000 samples where a ray takes sixteen.
const RAYS: usize = 4096;
/// Steps that are timed, after one that is not.
const STEPS: usize = 5;

/// Medians, milliseconds on the wall.
#[derive(Clone, Debug, Serialize)]
pub(super) struct BurnStep {
    rays: usize,
    parameters: usize,
    /// The kernels without Burn: there, and back.
    kernels_ms: [f64; 2],
    /// All numbers as one tensor, the operation, the loss.
    forward_ms: f64,
    /// The loss's gradient, the operation's, and whole tensors of it.
    backward_ms: f64,
    /// Burn's Adam.
    adam_ms: f64,
}

pub(super) fn measure(run: &Path) -> Result<BurnStep, Failure> {
    let avatar = Avatar::open(run, &Device::flex())?;
    let Some(model) = avatar.brick_model() else {
        return Err(Failure::input(format!("{}: no brick field", run.display())));
    };
    let camera = Camera::from(&avatar.saved.default_camera);
    let i = &camera.intrinsics;
    // Evenly over the picture, in an order without a pattern.
    let place = |n: usize| {
        let along = |step: f64| (n as f64 * step).fract();
        DVec2::new(along(0.754_877_666) * f64::from(i.width), along(0.569_840_291) * f64::from(i.height))
    };
    let directions: Vec<[f32; 3]> =
        (0..RAYS).filter_map(|n| camera.ray_direction(place(n))).map(|d| d.as_vec3().to_array()).collect();
    let batch = Arc::new(RayBatch {
        origin: camera.center().as_vec3().to_array(),
        directions,
        jitter: Vec::new(),
        divisions: model.divisions,
        planes: model.planes,
        opaque: 1e-3,
        haze: [0.0; 2],
        spread: [0.0; 2],
    });
    let device = Device::flex().autodiff();
    let scene = RayScene::new(model.clone());
    let mut parameters = BrickParameters::of(model, &device);
    let mut adam = AdamConfig::new().init();
    let image = model.neutral_image;
    let attributes = avatar.neutral_attributes();
    let ms = |since: Instant| since.elapsed().as_secs_f64() * 1e3;
    let mut times = [Vec::new(), Vec::new(), Vec::new()];
    for step in 0..=STEPS {
        let begun = Instant::now();
        let (activations, motion) = (parameters.activations(image, &attributes), parameters.motion(image));
        let shown = render_rays(&scene, parameters.flat(), activations, motion, &batch);
        let loss: Tensor<1> = (shown.color - 0.5).powi_scalar(2).mean();
        let forward = ms(begun);
        let begun = Instant::now();
        let gradients = GradientsParams::from_grads(loss.backward(), &parameters);
        let backward = ms(begun);
        let begun = Instant::now();
        // A rate of next to nothing: the avatar stays what it is.
        parameters = adam.step(1e-9, parameters, gradients);
        if step > 0 {
            times.iter_mut().zip([forward, backward, ms(begun)]).for_each(|(all, time)| all.push(time));
        }
    }
    let mut kernels = [Vec::new(), Vec::new()];
    let mut activations: Vec<f32> = attributes.iter().map(|&a| activation(a)).collect();
    activations.extend(model.code(image));
    for _ in 0..STEPS {
        let begun = Instant::now();
        let values = batch::forward(model, &activations, &[0.0; 6], &batch);
        kernels[0].push(ms(begun));
        let upstream: Vec<RayValues> =
            values.iter().map(|v| RayValues { color: v.color.map(|c| c - 0.5), ..RayValues::default() }).collect();
        let begun = Instant::now();
        std::hint::black_box(batch::backward(model, &activations, &[0.0; 6], &batch, &upstream));
        kernels[1].push(ms(begun));
    }
    let [forward_ms, backward_ms, adam_ms] = times.map(median);
    Ok(BurnStep {
        rays: batch.directions.len(),
        parameters: model.parameters(),
        kernels_ms: kernels.map(median),
        forward_ms,
        backward_ms,
        adam_ms,
    })
}

impl BurnStep {
    pub(super) fn table(&self) -> String {
        let Self { rays, parameters, kernels_ms: [there, back], forward_ms, backward_ms, adam_ms } = self;
        [
            format!("| a step of {rays} rays, {:.0} M parameters, through Burn | ms |", *parameters as f64 * 1e-6),
            "|---|---|".to_owned(),
            format!("| numbers as one tensor, operation, loss | {forward_ms:.0} |"),
            format!("| way back, gradients as whole tensors | {backward_ms:.0} |"),
            format!("| Burn's Adam | {adam_ms:.0} |"),
            format!("| the kernels alone: there | {there:.0} |"),
            format!("| back (there once more), gradients as arrays | {back:.0} |"),
        ]
        .join("\n")
    }
}
