//! "Render these rays" in f64, by its twin on Burn tensors, against finite differences. A process of its own: a device's
//! precision is set once.

use burn::tensor::{DType, Device, FloatDType, Tensor, TensorData};
use risorius_brick::model::LATENT;
use risorius_trainer::brick::tensors::{RayScene, Rendered, render_rays};

use self::support::*;

#[path = "support/rays.rs"]
mod support;

/// The twin's gradients are the slopes of its value: those of the numbers that matter most in each table.
#[test]
fn the_twin_s_gradients_are_its_finite_differences() {
    let mut device = Device::flex();
    device.configure(FloatDType::F64).unwrap();
    let model = lively(true);
    let (flat, batch) = (flat(&model), batch(24, 0.0));
    let lengths: Vec<usize> = model.shown_by().iter().map(|t| t.values.len()).collect();
    // What masks show has no gradient in the density, and their own slope is not that of the cut-off mask: they are left out
    // here.
    let masks = lengths.len() - 1 - LATENT;
    let scene = RayScene::new(model);
    let (of_numbers, of_activations) = {
        let device = device.clone().autodiff();
        let inputs = [&flat[..], &ACTIVATIONS, &MOTION].map(|v| vector(v, &device, DType::F64).require_grad());
        let [p, a, m] = inputs.clone();
        let grads = loss(&render_rays(&scene, p, a, m, &batch), false).backward();
        let [p, a, _] = inputs.map(|input| numbers(input.grad(&grads).unwrap()));
        (p, a)
    };
    let options = (&device, DType::F64);
    let value = |flat: &[f64], activations: &[f64]| {
        let vector = |v: &[f64]| Tensor::<1>::from_data(TensorData::new(v.to_vec(), [v.len()]), options);
        let motion = MOTION.map(f64::from);
        numbers(loss(&render_rays(&scene, vector(flat), vector(activations), vector(&motion), &batch), false))[0]
    };
    let wide = |values: &[f32]| values.iter().map(|v| f64::from(*v)).collect::<Vec<_>>();
    let (mut at, h) = (0, 1e-5);
    let activations = wide(&ACTIVATIONS);
    let numbers = wide(&flat);
    for (t, length) in lengths.into_iter().enumerate() {
        let range = at..at + length;
        at += length;
        if t == masks {
            continue;
        }
        let strongest = range.max_by(|&a, &b| of_numbers[a].abs().total_cmp(&of_numbers[b].abs())).unwrap();
        let moved = |d: f64| {
            let mut numbers = numbers.clone();
            numbers[strongest] += d;
            value(&numbers, &activations)
        };
        let (numeric, analytic) = ((moved(h) - moved(-h)) / (2.0 * h), of_numbers[strongest]);
        // A ReLU may bend between the two.
        assert!((numeric - analytic).abs() < 2e-3 * analytic.abs().max(1e-3), "table {t}: {analytic} {numeric}");
    }
    for (k, analytic) in of_activations.iter().enumerate() {
        let moved = |d: f64| {
            let mut activations = activations.clone();
            activations[k] += d;
            value(&numbers, &activations)
        };
        let numeric = (moved(h) - moved(-h)) / (2.0 * h);
        assert!((numeric - analytic).abs() < 5e-3 * analytic.abs().max(0.02), "activation {k}: {analytic} {numeric}");
    }
}
