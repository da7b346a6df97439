//! A batch in parts, and gradients that must be the same, or zero.

use burn::tensor::{Device, Tensor, TensorData};
use risorius_trainer::config::{FitSettings, ModelKind};
use risorius_trainer::fit::gradients;
use risorius_trainer::fit::norms::GradientNorms;
use risorius_trainer::kernel::{MlpSpec, Products, mlp_forward_with_ray, reference};
use risorius_trainer::model::{ConfiesModel, Level, RayCodes, Uncertain, Windows, region_groups};
use risorius_trainer::schedule::Schedule;

use crate::scene::{by_path, numbers, peak, scene, settings, space};

/// A step at which the ambient window is open and the uncertainty still counts.
const STEP: u64 = 12;

fn model(settings: &FitSettings, device: &Device) -> ConfiesModel {
    let data = scene(&[]);
    ConfiesModel::new(&settings.model, &region_groups(&data.table), data.frames.len(), 3, device)
}

#[test]
fn parts_of_a_batch_add_up_to_its_gradient() {
    // Frames without annotation make the parts' counts differ from each other.
    let data = scene(&[0, 4]);
    let device = Device::flex().autodiff();
    for kind in [ModelKind::Confies, ModelKind::Conerf, ModelKind::Nerf] {
        let whole = FitSettings { annotated_share: 0.4, ..settings() }.with_model(kind);
        let model = model(&whole, &device);
        let space = space(&data, &whole);
        let (expected, expected_numbers) = gradients(&model, &data, &space, &whole, STEP).unwrap();
        let expected = by_path(&model, &expected);
        for micro_rays in [1, 7, 12, 23] {
            let parted = FitSettings { micro_rays, ..whole.clone() };
            let (got, numbers) = gradients(&model, &data, &space, &parted, STEP).unwrap();
            for (path, got) in by_path(&model, &got) {
                let (got, want) = (got.unwrap(), expected[&path].as_ref().unwrap());
                let scale = want.iter().fold(1e-6f32, |m, v| m.max(v.abs()));
                let error = got.iter().zip(want).map(|(g, w)| (g - w).abs()).fold(0.0, f32::max);
                assert!(error <= 2e-5 * scale, "{kind:?}, {micro_rays} together: {path} is off by {error} of {scale}");
            }
            assert!((numbers.attribute - expected_numbers.attribute).abs() < 1e-5);
            assert!((numbers.mask - expected_numbers.mask).abs() < 1e-5);
        }
    }
}

#[test]
fn what_cannot_matter_has_no_gradient() {
    let data = scene(&[]);
    let device = Device::flex().autodiff();
    let base = settings();
    let model = model(&base, &device);
    let space = space(&data, &base);
    let of = |settings: &FitSettings, step: u64| {
        let (gradients, _) = gradients(&model, &data, &space, settings, step).unwrap();
        (by_path(&model, &gradients), GradientNorms::of(&model, &gradients))
    };

    // Without its loss, nothing reaches the attribute net's only customer of its own: α comes from the table here.
    let quiet = FitSettings { attribute_weight: Schedule::Constant { value: 0.0 }, ..base.clone() };
    let (by, norms) = of(&quiet, STEP);
    assert!(by.iter().filter(|(p, _)| p.contains("uncertainty")).all(|(_, g)| g.is_none()));
    assert_eq!(peak(&by, "attribute"), 0.0);
    assert!(norms.total() > 0.0 && !norms.parts.contains_key("fine.uncertainty"));

    // A closed ambient window hides w: with it the slices have nothing to learn, and the windows of the paper are closed
    // until step 1,000.
    let paper = FitSettings { hyper_window: FitSettings::paper().hyper_window, ..base.clone() };
    for step in [1, 999, 1_000] {
        assert_eq!(peak(&of(&paper, step).0, "ambient"), 0.0, "step {step}");
    }
    assert!(peak(&of(&paper, 2_000).0, "ambient") > 0.0);

    // The coarse nets learn from the coarse level only: its pictures and masks, not what samples it proposes.
    let (all, _) = of(&base, STEP);
    for part in ["coarse.template", "coarse.masks", "coarse.uncertainty", "fine.template", "attribute", "latent"] {
        assert!(peak(&all, part) > 0.0, "{part}");
    }
}

#[test]
fn the_fine_level_gives_the_coarse_nets_no_gradient() {
    let s = settings();
    let device = Device::flex().autodiff();
    let model = model(&s, &device);
    let codes = codes(&s, 3, &device);
    let points = Tensor::from_data(TensorData::new(vec![0.2f32; 3 * 4 * 3], [12, 3]), &device);
    let out = model.evaluate(Level::Fine, points, &codes, Windows::open(&s.model), &Uncertain::All);
    let loss = out.color.sum() + out.density.sum() + out.mask_logits.unwrap().sum() + out.uncertainty.unwrap().sum();
    let gradients = burn::optim::GradientsParams::from_grads(loss.backward(), &model);
    let by = by_path(&model, &gradients);
    assert!(by.iter().filter(|(p, _)| p.starts_with("coarse")).all(|(_, g)| g.is_none()));
    assert!(peak(&by, "fine") > 0.0);
}

fn codes(s: &FitSettings, rays: usize, device: &Device) -> RayCodes {
    let wave = |n: usize, f: f32| (0..n).map(|i| (i as f32 * f).sin() * 0.6).collect::<Vec<_>>();
    let d = s.model.latent_dims;
    RayCodes {
        omega: Tensor::from_data(TensorData::new(wave(rays * d, 1.1), [rays, d]), device),
        alpha: Tensor::from_data(TensorData::new(wave(rays * 4, 0.7), [rays, 4]), device),
        directions: Tensor::from_data(TensorData::new([0.0f32, 0.6, 0.8].repeat(rays), [rays, 3]), device),
    }
}

#[test]
fn uncertainty_of_some_rays_is_that_of_all() {
    let s = settings();
    let device = Device::flex();
    let model = model(&s, &device);
    let codes = codes(&s, 5, &device);
    let points: Vec<f32> = (0..5 * 6 * 3).map(|i| (i as f32 * 0.9).sin()).collect();
    let points = Tensor::<2>::from_data(TensorData::new(points, [30, 3]), &device);
    let of = |uncertain| {
        let out = model.evaluate(Level::Coarse, points.clone(), &codes, Windows::open(&s.model), &uncertain);
        out.uncertainty.map(numbers)
    };
    let all = of(Uncertain::All).unwrap();
    let some = of(Uncertain::Rays(Box::new(Tensor::from_data([1i32, 4], &device)))).unwrap();
    assert_eq!(some, [&all[24..48], &all[96..]].concat());
    assert!(of(Uncertain::None).is_none());
}

#[test]
fn what_a_ray_shares_may_be_multiplied_once() {
    let device = Device::flex().autodiff();
    let wave = |n: usize, f: f32| (0..n).map(|i| (i as f32 * f).sin()).collect::<Vec<_>>();
    for (depth, skip) in [(2, None), (6, Some(4)), (3, Some(1))] {
        let spec = MlpSpec { depth, width: 12, skip, output: Some(3), products: Products::F32 };
        let count = spec.parameter_count(9);
        let run = |once: bool| {
            let x = Tensor::<2>::from_data(TensorData::new(wave(35 * 4, 0.7), [35, 4]), &device).require_grad();
            let ray = Tensor::<2>::from_data(TensorData::new(wave(7 * 5, 1.3), [7, 5]), &device).require_grad();
            let params = Tensor::<1>::from_data(TensorData::new(wave(count, 2.1), [count]), &device) * 0.4;
            let params = params.require_grad();
            let out = if once {
                reference::mlp_with_ray(x.clone(), ray.clone(), params.clone(), &spec)
            } else {
                mlp_forward_with_ray(x.clone(), &ray, params.clone(), &spec)
            };
            let grads = (out.clone() * out.clone().detach().cos()).sum().backward();
            [
                numbers(out),
                numbers(x.grad(&grads).unwrap()),
                numbers(ray.grad(&grads).unwrap()),
                numbers(params.grad(&grads).unwrap()),
            ]
        };
        for (once, each) in run(true).iter().zip(run(false)) {
            let scale = each.iter().fold(1e-3f32, |m, v| m.max(v.abs()));
            assert!(once.iter().zip(&each).all(|(a, b)| (a - b).abs() < 3e-5 * scale), "{spec:?}");
        }
    }
}

#[test]
fn recomputing_activations_changes_no_gradient() {
    let data = scene(&[0]);
    let s = settings();
    let of = |device: Device| {
        let model = model(&s, &device);
        let (gradients, _) = gradients(&model, &data, &space(&data, &s), &s, STEP).unwrap();
        by_path(&model, &gradients)
    };
    let kept = of(Device::flex().autodiff());
    assert_eq!(kept, of(Device::flex().autodiff().gradient_checkpointing()));
    assert!(peak(&kept, "fine.template") > 0.0);
}
