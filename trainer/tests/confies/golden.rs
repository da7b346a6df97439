//! A tiny network with set weights against `golden/confies.py`, which computes the same from the paper's formulas alone.

use std::collections::BTreeMap;

use burn::module::{Module as _, ModuleMapper, Param};
use burn::tensor::{Device, Int, Tensor, TensorData};
use rand_chacha::ChaCha8Rng;
use risorius_trainer::config::{BranchedSize, FitSettings, LossWeights, NetSize, Spacing};
use risorius_trainer::loss::{self, Counts, LossTerms};
use risorius_trainer::model::{ConfiesModel, Level, RayCodes, Uncertain, Windows};
use risorius_trainer::{sampling, volume};
use serde_json::Value;

use crate::scene::numbers;

const RAYS: usize = 4;
const COARSE: usize = 6;
const FINE: usize = 5;

fn net(depth: usize, width: usize) -> NetSize {
    NetSize { depth, width }
}

/// Fills parameters by the formula of the script, and remembers their shapes.
#[derive(Default)]
struct Formula {
    path: Vec<String>,
    shapes: BTreeMap<String, Vec<usize>>,
}

impl ModuleMapper for Formula {
    fn enter_module(&mut self, name: &str, _: &str) {
        self.path.push(name.to_owned());
    }

    fn exit_module(&mut self, _: &str, _: &str) {
        self.path.pop();
    }

    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let name = self.path.join(".");
        let shape = param.val().dims();
        self.shapes.insert(name.clone(), shape.to_vec());
        let phase = name.bytes().enumerate().map(|(j, b)| (j + 1) * usize::from(b)).sum::<usize>() % 1009;
        let amplitude = if name.contains("biases") || name == "latent" { 0.1 } else { 0.45 };
        let value = |i: usize| (amplitude * (0.137 * phase as f64 + 1.7 * i as f64).sin()) as f32;
        let values: Vec<f32> = (0..shape.iter().product()).map(value).collect();
        param.map(|t| Tensor::from_data(TensorData::new(values, shape), &t.device()))
    }
}

fn noise(n: usize, seed: f64) -> Vec<f64> {
    (0..n).map(|i| f64::from((2.1 * i as f64 + seed).sin() as f32)).collect()
}

fn rows<const C: usize>(values: impl IntoIterator<Item = f64>, device: &Device) -> Tensor<2> {
    let values: Vec<f32> = values.into_iter().map(|v| v as f32).collect();
    let n = values.len() / C;
    Tensor::from_data(TensorData::new(values, [n, C]), device)
}

fn flat(value: &Value) -> Vec<f64> {
    match value {
        Value::Array(items) => items.iter().flat_map(flat).collect(),
        other => vec![other.as_f64().unwrap()],
    }
}

fn assert_close(name: &str, got: &[f32], want: &Value) {
    let want = flat(want);
    assert_eq!(got.len(), want.len(), "{name}");
    for (i, (g, w)) in got.iter().zip(&want).enumerate() {
        assert!((f64::from(*g) - w).abs() < 2e-5 * w.abs().max(1.0), "{name} {i}: {g} instead of {w}");
    }
}

#[test]
fn a_tiny_network_gives_what_numpy_gives() {
    let golden: Value = serde_json::from_str(include_str!("../golden/confies.json")).unwrap();
    let device = Device::flex();
    let mut settings = FitSettings::paper();
    let m = &mut settings.model;
    m.latent_dims = 5;
    m.attribute = net(6, 7);
    (m.warp, m.warp_bands) = (net(5, 8), 3);
    (m.sheet, m.sheet_bands) = (net(5, 6), 3);
    (m.hyper_dims, m.hyper_bands) = (2, 2);
    m.mask = BranchedSize { trunk: net(2, 6), branch: 4, branch_skip: true };
    m.rest_mask = risorius_trainer::config::RestMask::Clipped;
    m.uncertainty = BranchedSize { trunk: net(1, 5), branch: 3, branch_skip: false };
    (m.template, m.template_coarse, m.template_bands) = (net(6, 9), net(2, 7), 3);
    (m.view_bands, m.color_width) = (2, 6);
    let mut formula = Formula::default();
    let model = ConfiesModel::new(m, &[0..1, 1..3], 3, 0, &device).map(&mut formula);
    let shapes: BTreeMap<String, Vec<usize>> = serde_json::from_value(golden["parameters"].clone()).unwrap();
    assert_eq!(formula.shapes, shapes);

    let omega = model.latent_codes(Tensor::<1, Int>::from_data([0i32, 2, 1, 2], &device));
    let alpha = model.attributes_of(omega.clone()).unwrap();
    assert_close("α", &numbers(alpha.clone()), &golden["alpha"]);
    let origins: Vec<f64> = noise(RAYS * 3, 1.0).iter().map(|v| 0.2 * v).collect();
    let mut directions = noise(RAYS * 3, 2.0);
    for d in directions.as_chunks_mut::<3>().0 {
        d[2] += 2.0;
        let length = d.iter().map(|v| v * v).sum::<f64>().sqrt();
        *d = d.map(|v| f64::from((v / length) as f32));
    }
    let codes =
        RayCodes { omega: omega.clone(), alpha: alpha.clone(), directions: rows::<3>(directions.clone(), &device) };
    let truth = rows::<3>(noise(RAYS * 3, 3.0).iter().map(|v| f64::midpoint(*v, 1.0)), &device);
    let masks = rows::<2>(noise(RAYS * 2, 4.0).iter().map(|v| f64::from(u8::from(*v > 0.2))), &device);
    let masks_given = rows::<2>([1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 1.0, 1.0], &device);
    let attributes = rows::<3>(noise(RAYS * 3, 5.0), &device);
    let given = rows::<3>([1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 1.0, 1.0, 1.0], &device);
    let counts = Counts { rays: 4.0, masks: 6.0, attributes: 8.0 };

    let mut ray = Vec::new();
    sampling::stratified(&mut ray, COARSE, 0.5, 2.5, Spacing::Depth, None::<&mut ChaCha8Rng>);
    let mut depths = ray.repeat(RAYS);
    let mut total = 0.0;
    for (level, name) in [(Level::Coarse, "coarse"), (Level::Fine, "fine")] {
        let golden = &golden[name];
        assert_close("depths", &depths, &golden["depths"]);
        let samples = depths.len() / RAYS;
        let point = |i: usize, c: usize| {
            let r = i / samples;
            origins[r * 3 + c] + f64::from(depths[i]) * directions[r * 3 + c]
        };
        let points =
            rows::<3>((0..depths.len()).flat_map(|i| (0..3).map(move |c| (i, c))).map(|(i, c)| point(i, c)), &device);
        let windows = Windows { hyper: 1.3, warp: 1.6 };
        let out = model.evaluate(level, points, &codes, windows, &Uncertain::All);
        assert_close("density", &numbers(out.density.clone()), &golden["density"]);
        let deltas = TensorData::new(volume::deltas(&depths, samples), [RAYS, samples]);
        let weights = volume::weights(out.density, Tensor::from_data(deltas, &device));
        assert_close("weights", &numbers(weights.clone()), &golden["weights"]);
        let rgb = volume::composite(weights.clone(), out.color);
        let logits = volume::composite(weights.clone(), out.mask_logits.unwrap());
        let beta = volume::composite(weights.clone(), out.uncertainty.unwrap());
        assert_close("rgb", &numbers(rgb.clone()), &golden["rgb"]);
        assert_close("mask logits", &numbers(logits.clone()), &golden["mask_logits"]);
        assert_close("β", &numbers(beta.clone()), &golden["beta"]);
        let terms = LossTerms {
            reconstruction: loss::reconstruction(rgb, truth.clone(), counts),
            mask: Some(loss::mask(logits, masks.clone(), masks_given.clone(), counts)),
            attribute: Some(loss::attribute(alpha.clone(), attributes.clone(), beta, given.clone(), counts)),
            latent: Some(loss::latent(omega.clone(), counts)),
        };
        for (name, term) in [
            ("reconstruction", Some(&terms.reconstruction)),
            ("mask", terms.mask.as_ref()),
            ("attribute", terms.attribute.as_ref()),
            ("latent", terms.latent.as_ref()),
        ] {
            assert_close(name, &numbers(term.unwrap().clone()), &golden["terms"][name]);
        }
        total += numbers(terms.total(&LossWeights { mask: 0.01, latent: 1e-4 }, 0.07))[0];
        let mut next = Vec::new();
        for (z, w) in depths.chunks_exact(samples).zip(numbers(weights).chunks_exact(samples)) {
            sampling::union(&mut next, z, w, FINE, None::<&mut ChaCha8Rng>);
        }
        depths = next;
    }
    assert_close("total", &[total], &golden["total"]);
}
