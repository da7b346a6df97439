//! The fused kernels in f64: gradients against central differences, values and gradients against the plain twins.
//!
//! A test binary of its own: the device's default float type has to be set before its first tensor.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use burn::tensor::{Device, Distribution, FloatDType, Tensor, TensorData};
use risorius_trainer::kernel::{
    MlpSpec, Products, composite, grouped_mlp_forward, mlp_forward, positional_encoding, reference,
};

const STEP: f64 = 1e-6;

fn vector<const D: usize>(tensor: Tensor<D>) -> Vec<f64> {
    tensor.into_data().try_to_vec::<f64>().unwrap()
}

/// Compares the gradient of `Σ weights · f(inputs)` with central differences, input by input.
fn check(name: &str, device: &Device, shapes: &[[usize; 2]], range: (f64, f64), f: impl Fn(&[Tensor<2>]) -> Tensor<2>) {
    let loss = |inputs: &[Tensor<2>]| {
        let result = f(inputs);
        let count = result.shape().num_elements();
        let weights: Vec<f64> = (0..count).map(|i| ((i * 37 % 101) as f64 / 50.0) - 1.0).collect();
        let weights = Tensor::<1>::from_data(TensorData::new(weights, [count]), device);
        (result.reshape([count as i32]) * weights).sum()
    };
    let inputs: Vec<Tensor<2>> = shapes
        .iter()
        .map(|&shape| Tensor::random(shape, Distribution::Uniform(range.0, range.1), device).require_grad())
        .collect();
    let gradients = loss(&inputs).backward();
    let mut checked = 0;
    for (index, input) in inputs.iter().enumerate() {
        let gradient = vector(input.grad(&gradients).unwrap());
        let values = vector(input.clone().detach());
        let shift = |element: usize, step: f64| {
            let mut values = values.clone();
            values[element] += step;
            let mut inputs = inputs.clone();
            inputs[index] = Tensor::from_data(TensorData::new(values, shapes[index]), device);
            vector(loss(&inputs))[0]
        };
        for element in (0..values.len()).step_by(values.len().div_ceil(60)) {
            let difference = (shift(element, STEP) - shift(element, -STEP)) / (2.0 * STEP);
            let error = (difference - gradient[element]).abs();
            let bound = 1e-6 * (1.0 + difference.abs());
            assert!(error < bound, "{name}: input {index}, element {element}: {} for {difference}", gradient[element]);
            checked += usize::from(difference != 0.0);
        }
    }
    assert!(checked > shapes.len() * 3, "{name}: nearly all gradients are zero");
}

/// One way to compute a result.
type Way<'a> = &'a dyn Fn(&[Tensor<2>]) -> Tensor<2>;

/// Compares values and gradients of two ways to compute the same, on the same random inputs.
fn compare(name: &str, device: &Device, shapes: &[[usize; 2]], ways: [Way; 2]) {
    let inputs: Vec<Tensor<2>> = shapes
        .iter()
        .map(|&shape| Tensor::random(shape, Distribution::Uniform(-0.5, 0.5), device).require_grad())
        .collect();
    let [fused, plain] = ways.map(|way| {
        let result = way(&inputs);
        let gradients = (result.clone() * result.clone().detach().cos()).sum().backward();
        let mut parts = vec![vector(result)];
        parts.extend(inputs.iter().map(|input| vector(input.grad(&gradients).unwrap())));
        parts
    });
    for (part, (fused, plain)) in fused.iter().zip(&plain).enumerate() {
        let scale = plain.iter().fold(1e-3_f64, |scale, v| scale.max(v.abs()));
        let error = fused.iter().zip(plain).map(|(f, p)| (f - p).abs()).fold(0.0, f64::max);
        assert!(error <= 1e-12 * scale, "{name}: part {part} is off by {error} of {scale}");
    }
}

#[test]
fn gradients_are_right() {
    let mut device = Device::flex();
    device.configure(FloatDType::F64).unwrap();
    let device = device.autodiff();
    device.seed(11);

    for (skip, output) in [(None, None), (Some(2), None), (None, Some(3)), (Some(1), Some(3))] {
        let spec = MlpSpec { depth: 3, width: 12, skip, output, products: Products::F32 };
        let count = spec.parameter_count(4);
        check(&format!("mlp {spec:?}"), &device, &[[130, 4], [1, count]], (-0.6, 0.6), |inputs| {
            mlp_forward(inputs[0].clone(), inputs[1].clone().reshape([count as i32]), &spec)
        });
        let count = spec.parameter_count(5);
        check(&format!("grouped mlp {spec:?}"), &device, &[[9, 3], [9, 6], [3, count]], (-0.6, 0.6), |inputs| {
            grouped_mlp_forward(inputs[0].clone(), inputs[1].clone(), inputs[2].clone(), &spec)
        });
    }
    check("encoding", &device, &[[7, 3]], (-3.0, 3.0), |inputs| {
        positional_encoding(inputs[0].clone(), 0..4, &[1.0, 1.0, 0.7, 0.2], true)
    });
    check("composite", &device, &[[5, 6], [5, 6], [30, 2]], (0.1, 1.5), |inputs| {
        let values = inputs[2].clone().reshape([5, 6, 2]);
        let (rendered, weights) = composite(inputs[0].clone(), inputs[1].clone(), values);
        Tensor::cat(vec![rendered, weights], 1)
    });

    for (rows, groups, shared, own) in [(1, 17, 36, 1), (700, 17, 36, 1), (300, 1, 3, 2), (513, 3, 5, 7)] {
        let spec = MlpSpec { depth: 6, width: 20, skip: Some(4), output: Some(8), products: Products::F32 };
        let shapes = [[rows, shared], [rows, groups * own], [groups, spec.parameter_count(shared + own)]];
        compare(
            &format!("{groups} networks of {shared}+{own} inputs on {rows} rows"),
            &device,
            &shapes,
            [grouped_mlp_forward, reference::grouped_mlp]
                .map(|run| move |t: &[Tensor<2>]| run(t[0].clone(), t[1].clone(), t[2].clone(), &spec))
                .each_ref()
                .map(|run| run as Way),
        );
        let shapes = [[rows, shared], [1, spec.parameter_count(shared)]];
        compare(
            &format!("a network of {shared} inputs on {rows} rows"),
            &device,
            &shapes,
            [&|t| mlp_forward(t[0].clone(), t[1].clone().reshape([-1]), &spec), &|t| {
                reference::mlp(t[0].clone(), t[1].clone().reshape([-1]), &spec)
            }],
        );
    }
}
