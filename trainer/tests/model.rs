//! Structural facts of the CoNFies field (fact sheet §5.1 and the end of §8).

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::ops::Range;

use burn::module::Module as _;
use burn::tensor::{Device, Tensor, TensorData};
use risorius_trainer::config::FitSettings;
use risorius_trainer::model::{ConfiesModel, Level, RayCodes, Uncertain, Windows};
use risorius_trainer::volume;

/// The paper's groups: 3 brow, 5 eye and 9 mouth AUs.
fn paper_groups() -> Vec<Range<usize>> {
    vec![0..3, 3..8, 8..17]
}

fn numbers<const D: usize>(t: Tensor<D>) -> Vec<f32> {
    t.into_data().try_to_vec::<f32>().unwrap()
}

/// Deterministic numbers in −1..1.
fn noise(n: usize, seed: u32) -> Vec<f32> {
    (0..n as u32)
        .map(|i| {
            let mut h = (i ^ seed.wrapping_mul(0x9E37_79B9)).wrapping_mul(0x85EB_CA6B);
            h ^= h >> 13;
            h = h.wrapping_mul(0xC2B2_AE35);
            (h >> 8) as f32 / 8_388_608.0 - 1.0
        })
        .collect()
}

struct Setup {
    model: ConfiesModel,
    device: Device,
}

const RAYS: usize = 3;
const SAMPLES: usize = 5;

impl Setup {
    /// A model whose slices are far from flat, so that a leak between regions would show.
    fn new(device: Device) -> Self {
        let Self { model, device } = Self::plain(device);
        Self { model: model.map(&mut Amplify), device }
    }

    /// A model as it starts.
    fn plain(device: Device) -> Self {
        let mut config = FitSettings::tiny().model;
        config.hyper_dims = 3;
        let model = ConfiesModel::new(&config, &paper_groups(), 4, 7, &device);
        Self { model, device }
    }

    fn codes(&self, alpha: Vec<f32>) -> RayCodes {
        let frames = Tensor::from_data(TensorData::new(vec![1, 2, 0], [RAYS]), &self.device);
        RayCodes {
            omega: self.model.latent_codes(frames),
            alpha: Tensor::from_data(TensorData::new(alpha, [RAYS, 17]), &self.device),
            directions: Tensor::from_data(TensorData::new([0.6, 0.0, 0.8].repeat(RAYS), [RAYS, 3]), &self.device),
        }
    }

    fn points(&self) -> Tensor<2> {
        Tensor::from_data(TensorData::new(noise(RAYS * SAMPLES * 3, 1), [RAYS * SAMPLES, 3]), &self.device)
    }

    fn open(&self) -> Windows {
        Windows::open(self.model.config())
    }
}

struct Amplify;

impl burn::module::ModuleMapper for Amplify {
    fn map_float<const D: usize>(&mut self, param: burn::module::Param<Tensor<D>>) -> burn::module::Param<Tensor<D>> {
        param.map(|t| {
            let data = numbers(t.clone());
            let peak = data.iter().fold(0.0f32, |m, v| m.max(v.abs()));
            let scale = if peak > 0.0 && peak < 1e-2 { 0.5 / peak } else { 1.0 };
            Tensor::from_data(
                TensorData::new(data.iter().map(|v| v * scale).collect::<Vec<_>>(), t.dims()),
                &t.device(),
            )
        })
    }
}

#[test]
fn the_presets_have_the_published_parameter_counts() {
    let device = Device::flex();
    for (settings, count) in [(FitSettings::paper(), 5_191_863), (FitSettings::code(), 8_074_423)] {
        let model = ConfiesModel::new(&settings.model, &paper_groups(), 375, 0, &device);
        assert_eq!(model.num_params(), count, "{}", settings.preset);
    }
}

#[test]
fn an_au_of_one_region_leaves_the_other_masks_bit_identical() {
    let s = Setup::new(Device::flex());
    let logits = |alpha: Vec<f32>| {
        let out = s.model.evaluate(Level::Fine, s.points(), &s.codes(alpha), s.open(), &Uncertain::None);
        numbers(out.mask_logits.unwrap())
    };
    let base = noise(RAYS * 17, 3);
    let before = logits(base.clone());
    for (region, group) in paper_groups().into_iter().enumerate() {
        for k in group {
            let mut alpha = base.clone();
            (0..RAYS).for_each(|r| alpha[r * 17 + k] = 0.77);
            let after = logits(alpha);
            for (i, (b, a)) in before.iter().zip(&after).enumerate() {
                if i % 3 != region {
                    assert_eq!(b.to_bits(), a.to_bits(), "AU {k} of region {region} moved a logit of region {}", i % 3);
                }
            }
            let moved = before.iter().zip(&after).enumerate().any(|(i, (b, a))| i % 3 == region && b != a);
            assert!(moved, "AU {k} does not reach its own mask");
        }
    }
}

#[test]
fn with_the_hyper_window_shut_the_field_does_not_see_the_attributes() {
    let s = Setup::new(Device::flex());
    let shut = Windows { hyper: 0.0, ..s.open() };
    let render = |alpha| {
        let out = s.model.evaluate(Level::Coarse, s.points(), &s.codes(alpha), shut, &Uncertain::All);
        let (logits, beta) = (out.mask_logits.unwrap(), out.uncertainty.unwrap());
        [numbers(out.density), numbers(out.color), numbers(logits), numbers(beta)]
    };
    assert_eq!(render(noise(RAYS * 17, 3)), render(noise(RAYS * 17, 4)));
}

#[test]
fn masks_and_uncertainties_leave_the_density_alone() {
    let s = Setup::plain(Device::flex().autodiff());
    let out = s.model.evaluate(Level::Fine, s.points(), &s.codes(noise(RAYS * 17, 3)), s.open(), &Uncertain::All);
    let deltas = Tensor::<2>::full([RAYS, SAMPLES], 0.2, &s.device);
    let still = volume::weights(out.density.clone(), deltas).detach();
    let mask = volume::composite(still.clone(), out.mask_logits.clone().unwrap()).sum();
    let beta = volume::composite(still, out.uncertainty.unwrap()).sum();
    let grads = (mask + beta).backward();
    assert!(out.density.grad(&grads).is_none_or(|g| numbers(g).iter().all(|&v| v == 0.0)));
}

#[test]
fn the_same_seed_gives_the_same_weights_and_another_seed_others() {
    let device = Device::flex();
    let weights = |seed| {
        let model = ConfiesModel::new(&FitSettings::tiny().model, &paper_groups(), 3, seed, &device);
        let frames = Tensor::from_data(TensorData::new(vec![0, 1, 2], [3]), &device);
        let omega = model.latent_codes(frames);
        [numbers(omega.clone()), numbers(model.attributes_of(omega).unwrap())]
    };
    assert_eq!(weights(5), weights(5));
    assert_ne!(weights(5), weights(6));
}
