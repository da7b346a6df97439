//! Encoding, network, volume rendering and pose chain.

use std::hint::black_box;
use std::time::Instant;

use burn::tensor::{Device, Tensor, TensorData};
use half::{bf16, f16};
use risorius_trainer::kernel::{self, MlpSpec, Products};
use risorius_trainer::volume::LAST_DELTA;

use crate::Rung;
use crate::numbers::Number;

/// Rows of the encoding and the network.
const ROWS: usize = 4096;
/// Frequency bands of the encoding.
const BANDS: usize = 8;
/// Hidden layers and their width.
const NET: (usize, usize) = (4, 64);
/// Samples of a ray.
const SAMPLES: usize = 64;
/// Poses of a chain: 15 s at 120 per second.
const POSES: usize = 1800;

/// Numbers in −1..1 that are always the same.
pub(crate) fn noise(n: usize, seed: u64) -> Vec<f64> {
    let hash = |i: usize| {
        let mut x = (i as u64 + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ seed.wrapping_mul(0xD1B5_4A32_D192_ED03);
        x = (x ^ x >> 32).wrapping_mul(0xD6E8_FEB8_6659_FD93);
        (x >> 40) as f64 / f64::from(1u32 << 23) - 1.0
    };
    (0..n).map(hash).collect()
}

/// Times `run` and compares what it gives with the f64 result.
pub(crate) fn rung(
    stage: &'static str,
    numbers: &'static str,
    rounds: u32,
    truth: &[f64],
    run: impl Fn() -> Vec<f64>,
) -> Rung {
    let mut best = f64::INFINITY;
    let mut found = Vec::new();
    for _ in 0..rounds.max(1) {
        let begun = Instant::now();
        found = black_box(run());
        best = best.min(begun.elapsed().as_secs_f64());
    }
    let scale = truth.iter().fold(0.0f64, |m, v| m.max(v.abs())).max(f64::MIN_POSITIVE);
    let apart: Vec<f64> = found.iter().zip(truth).map(|(a, b)| (a - b).abs() / scale).collect();
    let lost = apart.iter().filter(|e| !e.is_finite()).count();
    let sound = apart.iter().filter(|e| e.is_finite());
    Rung {
        stage,
        numbers,
        max_error: sound.clone().fold(0.0, |m: f64, e| m.max(*e)),
        rms_error: (sound.clone().map(|e| e * e).sum::<f64>() / sound.count().max(1) as f64).sqrt(),
        lost,
        nanos: best * 1e9 / truth.len() as f64,
    }
}

fn to<T: Number>(values: &[f64]) -> Vec<T> {
    values.iter().map(|&v| T::of(v)).collect()
}

fn back<T: Number>(values: impl IntoIterator<Item = T>) -> Vec<f64> {
    values.into_iter().map(Number::value).collect()
}

/// sin and cos of 2^k x, as the fused kernel orders them for one channel.
fn encode<T: Number>(x: &[T]) -> Vec<T> {
    let bands = |&x: &T| (0..BANDS).flat_map(move |k| x.times(T::of(f64::from(1u32 << k))).sin_cos());
    x.iter().flat_map(bands).collect()
}

fn spec() -> MlpSpec {
    MlpSpec { depth: NET.0, width: NET.1, skip: None, output: Some(4), products: Products::F32 }
}

fn mlp<T: Number>(x: &[T], inputs: usize, params: &[T]) -> Vec<T> {
    let mut out = Vec::new();
    let layers: Vec<(usize, usize)> = spec().layers(inputs).collect();
    for row in x.chunks_exact(inputs) {
        let mut h = row.to_vec();
        let mut rest = params;
        for (i, &(rows, cols)) in layers.iter().enumerate() {
            let (w, tail) = rest.split_at(rows * cols);
            let (bias, tail) = tail.split_at(cols);
            rest = tail;
            h = (0..cols)
                .map(|c| {
                    let sum = h.iter().enumerate().fold(bias[c], |s, (r, &v)| s.plus(v.times(w[r * cols + c])));
                    if i + 1 < layers.len() && sum.value() < 0.0 { T::of(0.0) } else { sum }
                })
                .collect();
        }
        out.extend(h);
    }
    out
}

/// Three channels per ray.
fn composite<T: Number>(sigma: &[T], deltas: &[T], values: &[T]) -> Vec<T> {
    let mut out = Vec::new();
    for ray in 0..sigma.len() / SAMPLES {
        let (mut depth, mut sum) = (T::of(0.0), [T::of(0.0); 3]);
        for i in ray * SAMPLES..(ray + 1) * SAMPLES {
            let x = sigma[i].times(deltas[i]);
            let weight = depth.negated().exp().times(T::of(1.0).plus(x.negated().exp().negated()));
            depth = depth.plus(x);
            for (c, s) in sum.iter_mut().enumerate() {
                *s = s.plus(weight.times(values[3 * i + c]));
            }
        }
        out.extend(sum);
    }
    out
}

/// A camera that goes on by small turns and shifts: where it stands after each.
fn chain<T: Number>(steps: &[T]) -> Vec<T> {
    let zero = T::of(0.0);
    let mut r = [[T::of(1.0), zero, zero], [zero, T::of(1.0), zero], [zero, zero, T::of(1.0)]];
    let mut t = [zero; 3];
    let mut out = Vec::new();
    for step in steps.as_chunks::<4>().0 {
        let [sin, cos] = step[0].sin_cos();
        let axis = out.len() / 3 % 3;
        let (a, b) = ((axis + 1) % 3, (axis + 2) % 3);
        for row in &mut r {
            let (u, v) = (row[a], row[b]);
            row[a] = u.times(cos).plus(v.times(sin));
            row[b] = v.times(cos).plus(u.times(sin).negated());
        }
        for (t, row) in t.iter_mut().zip(&r) {
            *t = (0..3).fold(*t, |s, k| s.plus(row[k].times(step[1 + k])));
        }
        out.extend(t);
    }
    out
}

/// The rungs of one stage from its generic text, given as a closure per type.
macro_rules! rungs {
    ($all:ident, $rounds:ident, $stage:literal, $truth:ident, |$t:ident| $run:expr) => {{
        macro_rules! in_type {
            ($name:literal, $type:ty) => {{
                type $t = $type;
                $all.push(rung($stage, $name, $rounds, &$truth, || back($run)));
            }};
        }
        in_type!("f64", f64);
        in_type!("f32", f32);
        in_type!("bf16", bf16);
        in_type!("f16", f16);
    }};
}

fn tensor<const D: usize>(values: &[f64], shape: [usize; D]) -> Tensor<D> {
    Tensor::from_data(TensorData::new(to::<f32>(values), shape), &Device::flex())
}

fn host<const D: usize>(t: Tensor<D>) -> Vec<f64> {
    t.into_data().try_to_vec::<f32>().map(back).unwrap_or_default()
}

/// All rungs of the four stages.
pub(crate) fn climb(rounds: u32) -> Vec<Rung> {
    let mut all = Vec::new();

    let x = noise(ROWS * 8, 1);
    let truth = encode(&x);
    rungs!(all, rounds, "encoding", truth, |T| encode(&to::<T>(&x)));
    let input = tensor(&x, [x.len(), 1]);
    all.push(rung("encoding", "f32 kernel", rounds, &truth, || {
        host(kernel::positional_encoding(input.clone(), 0..BANDS as i32, &[1.0; BANDS], false))
    }));

    let (inputs, rows) = (2 * BANDS, ROWS);
    let x: Vec<f64> = truth[..inputs * rows].to_vec();
    let count = spec().parameter_count(inputs);
    let params: Vec<f64> = noise(count, 2).into_iter().map(|v| v * 0.2).collect();
    let truth = mlp(&x, inputs, &params);
    rungs!(all, rounds, "network", truth, |T| mlp(&to::<T>(&x), inputs, &to::<T>(&params)));
    let (input, weights) = (tensor(&x, [rows, inputs]), tensor(&params, [count]));
    all.push(rung("network", "f32 kernel", rounds, &truth, || {
        host(kernel::mlp_forward(input.clone(), weights.clone(), &spec()))
    }));

    let rays = ROWS / 2;
    let sigma: Vec<f64> = noise(rays * SAMPLES, 3).into_iter().map(|v| (4.0 * v).exp()).collect();
    let deltas: Vec<f64> =
        (0..rays * SAMPLES).map(|i| if i % SAMPLES + 1 == SAMPLES { f64::from(LAST_DELTA) } else { 0.02 }).collect();
    let values: Vec<f64> = noise(rays * SAMPLES * 3, 4).into_iter().map(|v| 0.5 + 0.5 * v).collect();
    let truth = composite(&sigma, &deltas, &values);
    rungs!(all, rounds, "volume rendering", truth, |T| composite(
        &to::<T>(&sigma),
        &to::<T>(&deltas),
        &to::<T>(&values)
    ));
    let (s, d, v) =
        (tensor(&sigma, [rays, SAMPLES]), tensor(&deltas, [rays, SAMPLES]), tensor(&values, [rays, SAMPLES, 3]));
    all.push(rung("volume rendering", "f32 kernel", rounds, &truth, || {
        host(kernel::composite(s.clone(), d.clone(), v.clone()).0)
    }));

    let steps: Vec<f64> = noise(POSES * 4, 5).into_iter().map(|v| v * 0.01).collect();
    let truth = chain(&steps);
    rungs!(all, rounds, "pose chain", truth, |T| chain(&to::<T>(&steps)));
    all
}
