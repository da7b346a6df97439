//! Speed of the fused kernels against their layer-by-layer twins and a bare matrix product, in one run.
//!
//! `cargo run -p risorius-trainer --release --example kernel_bench [-- THREADS]`
#![expect(clippy::print_stdout, reason = "a benchmark prints its table")]

use std::hint::black_box;
use std::time::Instant;

use burn::tensor::{Device, Distribution, Tensor};
use risorius_trainer::kernel::{
    EncodingSpec, MlpSpec, Products, composite, grouped_mlp_forward, mlp_forward, positional_encoding, reference,
    set_threads,
};

#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Fastest run of each of some jobs, in seconds. The jobs take turns, so that a busy spell of the machine hits all.
fn fastest<const N: usize>(jobs: [&dyn Fn(); N]) -> [f64; N] {
    let mut best = [f64::INFINITY; N];
    let begin = Instant::now();
    for round in 0..60 {
        for (best, job) in best.iter_mut().zip(jobs) {
            let start = Instant::now();
            job();
            *best = best.min(start.elapsed().as_secs_f64());
        }
        if round > 1 && begin.elapsed().as_secs_f64() > 5.0 {
            break;
        }
    }
    best
}

fn random(shape: [usize; 2], device: &Device) -> Tensor<2> {
    Tensor::random(shape, Distribution::Uniform(-0.2, 0.2), device)
}

/// Seconds of a forward pass without and of a forward and backward pass with autodiff, fused and as the twin does it.
fn measure(
    inputs: &[Tensor<2>],
    fused: impl Fn(&[Tensor<2>]) -> Tensor<2>,
    twin: impl Fn(&[Tensor<2>]) -> Tensor<2>,
) -> [[f64; 2]; 2] {
    let plain: Vec<_> = inputs.iter().map(|input| input.clone().inner()).collect();
    let tracked: Vec<_> = inputs.iter().map(|input| input.clone().detach().require_grad()).collect();
    let [fused_forward, fused_both, twin_forward, twin_both] = fastest([
        &|| drop(black_box(fused(&plain))),
        &|| drop(black_box(fused(&tracked).sum().backward())),
        &|| drop(black_box(twin(&plain))),
        &|| drop(black_box(twin(&tracked).sum().backward())),
    ]);
    [[fused_forward, fused_both], [twin_forward, twin_both]]
}

fn report(name: &str, rows: usize, flops: Option<f64>, [fused, plain]: [[f64; 2]; 2]) {
    let rate = |factor: f64, seconds: f64| match flops {
        Some(flops) => format!("{:6.1} GFLOP/s", factor * flops / seconds * 1e-9),
        None => format!("{:6.2} ms     ", seconds * 1e3),
    };
    println!(
        "{name:32} {rows:6} | forward {} twin {} ratio {:5.2} | forward+backward {} twin {} ratio {:5.2}",
        rate(1.0, fused[0]),
        rate(1.0, plain[0]),
        plain[0] / fused[0],
        rate(3.0, fused[1]),
        rate(3.0, plain[1]),
        plain[1] / fused[1],
    );
}

/// Multiplications and additions of the weights for one row.
fn flops(spec: &MlpSpec, inputs: usize) -> f64 {
    spec.layers(inputs).map(|(rows, cols)| 2.0 * (rows * cols) as f64).sum()
}

/// A 512-cubed product on one core: what the machine can do just now.
fn floor() -> f64 {
    let device = Device::flex();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build();
    let (a, b) = (random([512, 512], &device), random([512, 512], &device));
    let run = || fastest([&|| drop(black_box(a.clone().matmul(b.clone())))]);
    let [seconds] = pool.map_or_else(|_| run(), |pool| pool.install(run));
    2.0 * 512_f64.powi(3) / seconds * 1e-9
}

fn main() {
    if let Some(threads) = std::env::args().nth(1).and_then(|arg| arg.parse().ok()) {
        set_threads(threads);
    }
    let device = Device::flex().autodiff();
    println!(
        "512x512x512 product on one thread: {:.1} GFLOP/s; rates count 3 forward passes for forward+backward",
        floor()
    );

    for rows in [16_384, 65_536] {
        let dense = [
            (
                "123 -> 4x64 -> 64",
                123,
                MlpSpec { depth: 4, width: 64, skip: None, output: Some(64), products: Products::F32 },
            ),
            (
                "339 -> 8x256, skip 4",
                339,
                MlpSpec { depth: 8, width: 256, skip: Some(4), output: None, products: Products::F32 },
            ),
        ];
        for (name, inputs, spec) in dense {
            let tensors = [random([rows, inputs], &device), random([1, spec.parameter_count(inputs)], &device)];
            let times = measure(
                &tensors,
                |t| mlp_forward(t[0].clone(), t[1].clone().reshape([-1]), &spec),
                |t| reference::mlp(t[0].clone(), t[1].clone().reshape([-1]), &spec),
            );
            report(name, rows, Some(rows as f64 * flops(&spec, inputs)), times);
        }
        let grouped = [
            (
                "17 x (36+1 -> 6x64 -> 8, skip 4)",
                MlpSpec { depth: 6, width: 64, skip: Some(4), output: Some(8), products: Products::F32 },
            ),
            (
                "17 x (36+1 -> 4x16 -> 2)",
                MlpSpec { depth: 4, width: 16, skip: None, output: Some(2), products: Products::F32 },
            ),
        ];
        for (name, spec) in grouped {
            let params = random([17, spec.parameter_count(37)], &device);
            let tensors = [random([rows, 36], &device), random([rows, 17], &device), params];
            let times = measure(
                &tensors,
                |t| grouped_mlp_forward(t[0].clone(), t[1].clone(), t[2].clone(), &spec),
                |t| reference::grouped_mlp(t[0].clone(), t[1].clone(), t[2].clone(), &spec),
            );
            report(name, rows, Some(17.0 * rows as f64 * flops(&spec, 37)), times);
        }
        let spec = EncodingSpec { bands: 0..8, window: vec![1.0; 8], identity: true };
        let times = measure(
            &[random([rows, 3], &device)],
            |t| positional_encoding(t[0].clone(), 0..8, &spec.window, true),
            |t| reference::positional_encoding(t[0].clone(), &spec),
        );
        report("encoding of 3 channels, 8 bands", rows, None, times);

        let (rays, samples) = (rows / 128, 128);
        let tensors = [
            random([rays, samples], &device).abs(),
            random([rays, samples], &device).abs(),
            random([rows, 24], &device),
        ];
        let run = |render: fn(Tensor<2>, Tensor<2>, Tensor<3>) -> (Tensor<2>, Tensor<2>)| {
            move |t: &[Tensor<2>]| {
                let values = t[2].clone().reshape([rays, samples, 24]);
                let (rendered, weights) = render(t[0].clone(), t[1].clone(), values);
                Tensor::cat(vec![rendered, weights], 1)
            }
        };
        let times = measure(&tensors, run(composite), run(reference::composite));
        report("rays of 128 samples, 24 channels", rows, None, times);
    }
}
