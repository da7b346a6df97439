//! The fused kernels against their plain twins, in value and gradient, and the promises they make.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]
#![expect(clippy::excessive_precision, reason = "published values are quoted as they are")]

use std::cell::Cell;
use std::f32::consts::PI;
use std::ops::Range;

use burn::tensor::{Device, Tensor, TensorData};
use risorius_trainer::kernel::{
    EncodingSpec, MlpSpec, Products, composite, grouped_mlp_forward, mlp_forward, positional_encoding, reference,
};

/// A run's result and the gradients of its weighted sum.
type Outcome = Vec<Vec<f32>>;

thread_local! {
    /// State of the generator. Every test runs on a thread of its own, so each gets the same numbers every time.
    static STATE: Cell<u64> = const { Cell::new(7) };
}

fn device() -> Device {
    Device::flex().autodiff()
}

/// Evenly distributed values in `range`.
fn random_in<const D: usize>(shape: [usize; D], range: Range<f32>, device: &Device) -> Tensor<D> {
    let values = (0..shape.iter().product::<usize>()).map(|_| {
        let state = STATE.get().wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        STATE.set(state);
        range.start + (range.end - range.start) * ((state >> 40) as f32 / (1 << 24) as f32)
    });
    Tensor::from_data(TensorData::new(values.collect::<Vec<f32>>(), shape), device)
}

fn random<const D: usize>(shape: [usize; D], scale: f32, device: &Device) -> Tensor<D> {
    random_in(shape, -scale..scale, device)
}

fn vector<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_to_vec::<f32>().unwrap()
}

/// A scalar that weighs every element of the result differently.
fn weighted_sum<const D: usize>(result: Tensor<D>) -> Tensor<1> {
    let count = result.shape().num_elements();
    let device = result.device();
    let weights: Vec<f32> = (0..count).map(|i| ((i * 37 % 101) as f32 / 50.0) - 1.0).collect();
    let weights = Tensor::<1>::from_data(TensorData::new(weights, [count]), &device);
    (result.reshape([count as i32]) * weights).sum()
}

/// Nearly all elements agree to `tolerance` and none is off by its own order. In f32 the two ways of summing put a few of the
/// millions of activations on different sides of zero, which moves the gradients of their rows; the f64 tests, where
/// that does not happen, ask for equality throughout.
fn assert_close(name: &str, fused: &Outcome, plain: &Outcome, tolerance: f32) {
    assert_eq!(fused.len(), plain.len());
    for (part, (fused, plain)) in fused.iter().zip(plain).enumerate() {
        assert_eq!(fused.len(), plain.len(), "{name}: length of part {part}");
        let scale = plain.iter().fold(1e-3_f32, |scale, v| scale.max(v.abs()));
        let mut outliers = 0;
        for (i, (f, p)) in fused.iter().zip(plain).enumerate() {
            let error = (f - p).abs() / scale;
            assert!(error <= 1.0, "{name}: part {part}, element {i}: {f} instead of {p}");
            outliers += usize::from(error > tolerance);
        }
        assert!(outliers * 100 <= fused.len(), "{name}: part {part}: {outliers} of {} elements differ", fused.len());
    }
}

const SPECS: [MlpSpec; 6] = [
    MlpSpec { depth: 1, width: 8, skip: None, output: None, products: Products::F32 },
    MlpSpec { depth: 1, width: 5, skip: None, output: Some(3), products: Products::F32 },
    MlpSpec { depth: 3, width: 16, skip: Some(1), output: Some(2), products: Products::F32 },
    MlpSpec { depth: 4, width: 7, skip: Some(3), output: None, products: Products::F32 },
    MlpSpec { depth: 6, width: 64, skip: Some(4), output: Some(8), products: Products::F32 },
    MlpSpec { depth: 4, width: 33, skip: None, output: Some(64), products: Products::F32 },
];

fn mlp_outcome(run: impl Fn(Tensor<2>, Tensor<1>) -> Tensor<2>, x: &Tensor<2>, params: &Tensor<1>) -> Outcome {
    let (x, params) = (x.clone().detach().require_grad(), params.clone().detach().require_grad());
    let result = run(x.clone(), params.clone());
    let gradients = weighted_sum(result.clone()).backward();
    vec![vector(result), vector(x.grad(&gradients).unwrap()), vector(params.grad(&gradients).unwrap())]
}

#[test]
fn mlp_equals_its_twin() {
    let device = device();
    for spec in SPECS {
        for (rows, inputs) in [(1, 3), (127, 5), (128, 1), (300, 21), (5000, 9)] {
            let x = random([rows, inputs], 1.0, &device);
            let params = random([spec.parameter_count(inputs)], 0.4, &device);
            let fused = mlp_outcome(|x, p| mlp_forward(x, p, &spec), &x, &params);
            let plain = mlp_outcome(|x, p| reference::mlp(x, p, &spec), &x, &params);
            assert_close(&format!("{spec:?} on {rows}x{inputs}"), &fused, &plain, 2e-5);
        }
    }
}

/// Factors in bfloat16: the values to a few per cent, and gradients that point where the others do.
#[test]
fn products_in_bf16_keep_value_and_direction() {
    let device = device();
    for spec in SPECS {
        let half = MlpSpec { products: Products::Bf16, ..spec };
        let (rows, inputs, groups) = (300, 21, 3);
        let x = random([rows, inputs], 1.0, &device);
        let params = random([spec.parameter_count(inputs)], 0.4, &device);
        let own = random([rows, groups * 2], 1.0, &device);
        let grouped = random([groups, spec.parameter_count(inputs + 2)], 0.4, &device);
        let pairs = [
            [spec, half].map(|s| mlp_outcome(|x, p| mlp_forward(x, p, &s), &x, &params)),
            [spec, half].map(|s| {
                grouped_outcome(|a, b, c| grouped_mlp_forward(a, b, c, &s), &[x.clone(), own.clone(), grouped.clone()])
            }),
        ];
        for [plain, rounded] in pairs {
            assert_ne!(plain[0], rounded[0], "{spec:?}: nothing was rounded");
            for (part, (a, b)) in plain.iter().zip(&rounded).enumerate() {
                let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(a * b)).sum::<f64>();
                let cosine = dot(a, b) / (dot(a, a) * dot(b, b)).sqrt();
                // Seven layers of factors that are off by up to 0.4 %, and units near zero that change sides.
                assert!(cosine > 0.99, "{spec:?}, part {part}: cosine {cosine}");
                let size = dot(b, b).sqrt() / dot(a, a).sqrt();
                assert!((size - 1.0).abs() < 0.02, "{spec:?}, part {part}: size {size}");
            }
        }
    }
}

fn grouped_outcome(
    run: impl Fn(Tensor<2>, Tensor<2>, Tensor<2>) -> Tensor<2>,
    [shared, own, params]: &[Tensor<2>; 3],
) -> Outcome {
    let [shared, own, params] = [shared, own, params].map(|t| t.clone().detach().require_grad());
    let result = run(shared.clone(), own.clone(), params.clone());
    let gradients = weighted_sum(result.clone()).backward();
    let gradient = |tensor: &Tensor<2>| vector(tensor.grad(&gradients).unwrap());
    vec![vector(result), gradient(&shared), gradient(&own), gradient(&params)]
}

#[test]
fn grouped_mlp_equals_its_twin() {
    let device = device();
    for spec in SPECS {
        for (groups, rows, shared, own) in [(1, 130, 4, 2), (17, 1, 36, 1), (17, 300, 5, 1), (3, 700, 2, 4)] {
            let inputs = [
                random([rows, shared], 1.0, &device),
                random([rows, groups * own], 1.0, &device),
                random([groups, spec.parameter_count(shared + own)], 0.4, &device),
            ];
            let fused = grouped_outcome(|s, o, p| grouped_mlp_forward(s, o, p, &spec), &inputs);
            let plain = grouped_outcome(|s, o, p| reference::grouped_mlp(s, o, p, &spec), &inputs);
            assert_close(&format!("{groups} times {spec:?} on {rows}x({shared}+{own})"), &fused, &plain, 2e-5);
        }
    }
}

#[test]
fn a_group_without_shared_or_own_input_works() {
    let device = device();
    let spec = SPECS[2];
    for (shared, own) in [(3, 0), (0, 3)] {
        let inputs = [
            random([50, shared], 1.0, &device),
            random([50, 2 * own], 1.0, &device),
            random([2, spec.parameter_count(3)], 0.4, &device),
        ];
        let [shared_input, own_input, params] = inputs.clone();
        let result = vector(grouped_mlp_forward(shared_input, own_input, params.clone(), &spec));
        let single = |group: usize| {
            let x = if shared == 0 { inputs[1].clone().narrow(1, group * 3, 3) } else { inputs[0].clone() };
            reference::mlp(x, params.clone().narrow(0, group, 1).reshape([-1]), &spec)
        };
        let plain = vector(Tensor::cat(vec![single(0), single(1)], 1));
        assert_close(&format!("{shared} shared, {own} own"), &vec![result], &vec![plain], 2e-5);
    }
}

#[test]
fn strided_inputs_are_read_right() {
    let device = device();
    let spec = SPECS[2];
    let x = random([9, 140], 1.0, &device).transpose().slice([3..133, 2..8]);
    let params = random([spec.parameter_count(6)], 0.4, &device);
    let plain = vector(reference::mlp(x.clone(), params.clone(), &spec));
    assert_close("strided", &vec![vector(mlp_forward(x, params, &spec))], &vec![plain], 2e-5);
}

#[test]
fn only_wanted_gradients_come_back() {
    let device = device();
    let spec = SPECS[4];
    let x = random([40, 4], 1.0, &device);
    let params = random([spec.parameter_count(4)], 0.4, &device);
    let both = mlp_outcome(|x, p| mlp_forward(x, p, &spec), &x, &params);

    let tracked = x.clone().detach().require_grad();
    let loss = weighted_sum(mlp_forward(tracked.clone(), params.clone(), &spec));
    let gradients = loss.backward();
    assert_eq!(vector(tracked.grad(&gradients).unwrap()), both[1]);
    assert!(params.grad(&gradients).is_none());

    let tracked = params.detach().require_grad();
    let loss = weighted_sum(mlp_forward(x, tracked.clone(), &spec));
    assert_eq!(vector(tracked.grad(&loss.backward()).unwrap()), both[2]);
}

#[test]
fn plain_tensors_record_nothing_and_give_the_same_values() {
    let device = device();
    let spec = SPECS[4];
    let x = random([200, 4], 1.0, &device).require_grad();
    let params = random([spec.parameter_count(4)], 0.4, &device).require_grad();
    let inner = mlp_forward(x.clone().inner(), params.clone().inner(), &spec);
    assert!(!inner.device().is_autodiff());
    assert_eq!(vector(inner), vector(mlp_forward(x, params, &spec)));
}

#[test]
fn thread_count_changes_no_bit() {
    let device = device();
    let (spec, groups) = (SPECS[4], 17);
    let inputs = [
        random([3000, 36], 1.0, &device),
        random([3000, 17], 1.0, &device),
        random([groups, spec.parameter_count(37)], 0.3, &device),
    ];
    let rays = (random([700, 9], 1.0, &device).abs(), random([700, 9, 4], 1.0, &device));
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut outcome = grouped_outcome(|s, o, p| grouped_mlp_forward(s, o, p, &spec), &inputs);
            outcome.extend(encoding_outcome(|x| positional_encoding(x, 0..6, &[1.0; 6], true), &inputs[0]));
            let (sigma, values) = rays.clone();
            outcome.push(vector(composite(sigma.clone(), sigma, values).0));
            outcome
        })
    };
    let one = run(1);
    for threads in [2, 3] {
        let more = run(threads);
        for (one, more) in one.iter().zip(&more) {
            assert!(one.iter().zip(more).all(|(a, b)| a.to_bits() == b.to_bits()), "{threads} threads differ from one");
        }
    }
}

#[test]
fn empty_batches_give_empty_results() {
    let device = device();
    let spec = SPECS[4];
    let params = random([2, spec.parameter_count(5)], 0.4, &device).require_grad();
    let empty = |cols: usize| Tensor::<2>::zeros([0, cols], &device);
    let result = grouped_mlp_forward(empty(3), empty(4), params.clone(), &spec);
    assert_eq!(result.dims(), [0, 16]);
    let gradient = params.grad(&result.sum().backward()).unwrap();
    assert!(vector(gradient).iter().all(|&v| v == 0.0));
    assert_eq!(mlp_forward(empty(5), params.narrow(0, 0, 1).reshape([-1]), &spec).dims(), [0, 8]);
    assert_eq!(positional_encoding(empty(3), 0..2, &[1.0; 2], true).dims(), [0, 15]);
}

#[test]
fn not_a_number_stays_in_its_row() {
    let device = device();
    let spec = SPECS[4];
    let mut values = vec![0.3_f32; 4 * 5];
    values[6] = f32::NAN;
    let x = Tensor::<2>::from_data(TensorData::new(values, [5, 4]), &device);
    let result = vector(mlp_forward(x, random([spec.parameter_count(4)], 0.4, &device), &spec));
    for (row, result) in result.chunks(8).enumerate() {
        assert!(result.iter().all(|v| v.is_nan() == (row == 1)), "row {row}: {result:?}");
    }
}

#[test]
#[should_panic(expected = "parameters of an MLP")]
fn wrong_parameter_counts_are_refused() {
    let device = device();
    mlp_forward(random([2, 3], 1.0, &device), random([10], 1.0, &device), &SPECS[0]);
}

fn encoding_outcome(run: impl Fn(Tensor<2>) -> Tensor<2>, x: &Tensor<2>) -> Outcome {
    let x = x.clone().detach().require_grad();
    let result = run(x.clone());
    let gradients = weighted_sum(result.clone()).backward();
    vec![vector(result), vector(x.grad(&gradients).unwrap())]
}

#[test]
fn encoding_has_the_published_layout() {
    let x = Tensor::<2>::from_data([[0.1_f32, -0.2, 0.3]], &device());
    let encoded = vector(positional_encoding(x, 0..2, &[1.0, 0.5], true));
    let expected = [
        0.1,
        -0.2,
        0.3,
        0.099833417,
        -0.198669331,
        0.295520207,
        0.995004165,
        0.980066578,
        0.955336489,
        0.099334665,
        -0.194709171,
        0.282321237,
        0.490033289,
        0.460530497,
        0.412667807,
    ];
    assert_eq!(encoded.len(), expected.len());
    for (value, expected) in encoded.iter().zip(expected) {
        assert!((value - expected).abs() < 2e-7, "{value} instead of {expected}");
    }
}

#[test]
fn encoding_equals_its_twin() {
    let device = device();
    for (rows, channels, bands, identity) in [(1, 3, 0..1, false), (129, 3, 0..8, true), (5000, 1, -1..4, true)] {
        let window: Vec<f32> = bands.clone().map(|band| 1.0 / (2.0 + band as f32)).collect();
        let spec = EncodingSpec { bands: bands.clone(), window: window.clone(), identity };
        let x = random([rows, channels], PI, &device);
        let fused = encoding_outcome(|x| positional_encoding(x, bands.clone(), &window, identity), &x);
        let plain = encoding_outcome(|x| reference::positional_encoding(x, &spec), &x);
        assert_close(&format!("{spec:?} on {rows}x{channels}"), &fused, &plain, 2e-6);
    }
}

type Rays = (Tensor<2>, Tensor<2>, Tensor<3>);

fn composite_outcome(run: impl Fn(Tensor<2>, Tensor<2>, Tensor<3>) -> (Tensor<2>, Tensor<2>), rays: &Rays) -> Outcome {
    let (sigma, deltas) = (rays.0.clone().detach().require_grad(), rays.1.clone().detach().require_grad());
    let values = rays.2.clone().detach().require_grad();
    let (rendered, weights) = run(sigma.clone(), deltas.clone(), values.clone());
    let gradients = (weighted_sum(rendered.clone()) + weighted_sum(weights.clone())).backward();
    vec![
        vector(rendered),
        vector(weights),
        vector(sigma.grad(&gradients).unwrap()),
        vector(deltas.grad(&gradients).unwrap()),
        vector(values.grad(&gradients).unwrap()),
    ]
}

#[test]
fn composite_equals_its_twin() {
    let device = device();
    for (rays, samples, channels) in [(1, 1, 1), (3, 128, 4), (400, 13, 3)] {
        let sigma = random_in([rays, samples], 0.0..3.0, &device);
        let deltas = random_in([rays, samples], 0.01..0.2, &device);
        let input = (sigma, deltas, random([rays, samples, channels], 1.0, &device));
        let fused = composite_outcome(composite, &input);
        let plain = composite_outcome(reference::composite, &input);
        assert_close(&format!("{rays} rays of {samples} samples"), &fused, &plain, 1e-5);
    }
}

#[test]
fn composite_reaches_the_published_values() {
    let device = device();
    let sigma = Tensor::<2>::from_data([[0.2_f32, 1.0, 0.5, 2.0]], &device);
    let deltas = Tensor::<2>::from_data([[0.5_f32, 1.0, 0.5, 1e10]], &device);
    let colours = [[0.1_f32, 0.2, 0.3], [0.4, 0.5, 0.6], [0.7, 0.8, 0.9], [1.0, 0.0, 1.0]];
    let (rendered, weights) = composite(sigma, deltas, Tensor::from_data([colours], &device));
    let expected = [0.549084629, 0.363920342, 0.697236577, 0.095162582, 0.571966334, 0.073630823, 0.259240261];
    for (value, expected) in vector(rendered).into_iter().chain(vector(weights)).zip(expected) {
        assert!((value - expected).abs() < 1e-6, "{value} instead of {expected}");
    }
}
