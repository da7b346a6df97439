//! The whole model in f64: gradients of everything it says against central differences, parameter by parameter.
//!
//! A test binary of its own: the device's default float type has to be set before its first tensor.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use burn::module::{Module as _, ModuleMapper, ModuleVisitor, Param};
use burn::optim::GradientsParams;
use burn::tensor::{Device, FloatDType, Tensor, TensorData};
use risorius_trainer::config::{FitSettings, ModelKind};
use risorius_trainer::loss::{self, Counts};
use risorius_trainer::model::{ConfiesModel, Level, RayCodes, Uncertain, Windows};
use risorius_trainer::volume;

const STEP: f64 = 1e-6;
const RAYS: usize = 3;
const SAMPLES: usize = 4;

fn vector<const D: usize>(tensor: Tensor<D>) -> Vec<f64> {
    tensor.into_data().try_to_vec::<f64>().unwrap()
}

fn wave<const D: usize>(shape: [usize; D], f: f64, device: &Device) -> Tensor<D> {
    let values: Vec<f64> = (0..shape.iter().product()).map(|i| (i as f64 * f + 0.3).sin() * 0.7).collect();
    Tensor::from_data(TensorData::new(values, shape), device)
}

/// One number of everything that both levels say, all losses among it. Densities reach it through the weights, which
/// masks and uncertainties see as they are: here nothing is detached.
fn loss(model: &ConfiesModel, device: &Device) -> Tensor<1> {
    let frames = Tensor::from_data([1i32, 0, 1], device);
    let omega = model.latent_codes(frames);
    let alpha = model.attributes_of(omega.clone()).unwrap_or_else(|| Tensor::zeros([RAYS, 3], device));
    let codes = RayCodes { omega: omega.clone(), alpha: alpha.clone(), directions: wave([RAYS, 3], 1.9, device) };
    let windows = Windows { hyper: 0.7, warp: 1.6 };
    let counts = Counts { rays: 3.0, masks: 6.0, attributes: 9.0 };
    let mut sum = loss::latent(omega, counts);
    for level in [Level::Coarse, Level::Fine] {
        let points = wave([RAYS * SAMPLES, 3], 0.77, device);
        let out = model.evaluate(level, points, &codes, windows, &Uncertain::All);
        let deltas = Tensor::from_data(TensorData::new(vec![0.4f64; RAYS * SAMPLES], [RAYS, SAMPLES]), device);
        let weights = volume::weights(out.density, deltas);
        sum = sum
            + loss::reconstruction(volume::composite(weights.clone(), out.color), wave([RAYS, 3], 0.4, device), counts);
        if let Some(logits) = out.mask_logits {
            let count = logits.dims()[2];
            let (truth, given) = (wave([RAYS, count], 2.2, device).abs(), Tensor::ones([RAYS, count], device));
            sum = sum + loss::mask(volume::composite(weights.clone(), logits), truth, given, counts);
        }
        if let Some(beta) = out.uncertainty {
            let (truth, given) = (wave([RAYS, 3], 3.1, device), Tensor::ones([RAYS, 3], device));
            let beta = volume::composite(weights, beta);
            sum = sum + loss::attribute(alpha.clone(), truth, beta, given, counts);
        }
    }
    sum
}

/// Makes small weights large, so that nothing is flat, and biases differ from 0, so that no unit sits on its kink.
struct Amplify;

impl ModuleMapper for Amplify {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        param.map(|t| {
            let values = vector(t.clone());
            let peak = values.iter().fold(0.0f64, |m, v| m.max(v.abs()));
            let value = |(i, v): (usize, f64)| match peak {
                0.0 => 0.1 * (i as f64 * 1.3 + 0.7).sin(),
                p if p < 1e-2 => v * 0.4 / p,
                _ => v,
            };
            let values: Vec<f64> = values.into_iter().enumerate().map(value).collect();
            Tensor::from_data(TensorData::new(values, t.dims()), &t.device()).require_grad()
        })
    }
}

/// Moves one element of the parameter with this number.
struct Shift {
    parameter: usize,
    element: usize,
    by: f64,
    seen: usize,
}

impl ModuleMapper for Shift {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let own = self.seen == self.parameter;
        self.seen += 1;
        if !own {
            return param;
        }
        param.map(|t| {
            let mut values = vector(t.clone());
            values[self.element] += self.by;
            Tensor::from_data(TensorData::new(values, t.dims()), &t.device())
        })
    }
}

/// Every parameter's path and gradient, in order.
struct Read<'a> {
    gradients: &'a GradientsParams,
    path: Vec<String>,
    found: Vec<(String, Option<Vec<f64>>)>,
}

impl ModuleVisitor for Read<'_> {
    fn enter_module(&mut self, name: &str, _: &str) {
        self.path.push(name.to_owned());
    }

    fn exit_module(&mut self, _: &str, _: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        self.found.push((self.path.join("."), self.gradients.get::<D>(param.id).map(vector)));
    }
}

#[test]
fn gradients_of_the_whole_model_are_right() {
    let mut device = Device::flex();
    device.configure(FloatDType::F64).unwrap();
    let device = device.autodiff();
    for kind in [ModelKind::Confies, ModelKind::Conerf, ModelKind::Hypernerf, ModelKind::NerfLatent] {
        let mut config = FitSettings::tiny().with_model(kind).model;
        (config.latent_dims, config.warp.depth, config.warp.width) = (3, 5, 6);
        (config.sheet.width, config.template_bands, config.warp_bands, config.sheet_bands) = (5, 2, 2, 2);
        (config.mask.branch, config.mask.branch_skip, config.uncertainty.branch) = (4, true, 3);
        (config.template.depth, config.template.width, config.template_coarse.width) = (5, 7, 6);
        let model = ConfiesModel::new(&config, &[0..1, 1..3], 2, 5, &device).map(&mut Amplify);
        let gradients = GradientsParams::from_grads(loss(&model, &device).backward(), &model);
        let mut read = Read { gradients: &gradients, path: Vec::new(), found: Vec::new() };
        model.visit(&mut read);
        let (mut checked, mut moving) = (0, 0);
        for (parameter, (path, gradient)) in read.found.iter().enumerate() {
            let Some(gradient) = gradient else { panic!("{kind:?}: `{path}` has no gradient") };
            for element in (0..gradient.len()).step_by(gradient.len().div_ceil(4)) {
                let at = |by: f64| {
                    let moved = model.clone().map(&mut Shift { parameter, element, by, seen: 0 });
                    vector(loss(&moved, &device))[0]
                };
                let difference = (at(STEP) - at(-STEP)) / (2.0 * STEP);
                let error = (difference - gradient[element]).abs();
                assert!(
                    error < 1e-7 + 1e-5 * difference.abs(),
                    "{kind:?}: `{path}` {element}: {} for {difference}",
                    gradient[element]
                );
                checked += 1;
                moving += usize::from(difference.abs() > 1e-9);
            }
        }
        assert!(checked > 60 && moving * 2 > checked, "{kind:?}: {moving} of {checked} gradients are not zero");
    }
}
