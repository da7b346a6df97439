//! The only code of the trainer's kernels that computes addresses or leaves the build's instructions, on its own: matrix
//! products that hand raw pointers to `gemm`, and the loops that are compiled for wider vectors. Every slice ends where its
//! last element does, so that the sanitizer sees a step beyond.

#![no_main]
#![warn(unsafe_code)]
#![allow(dead_code, reason = "the trainer uses more of these files")]

#[path = "../../../trainer/src/kernel/matmul.rs"]
mod matmul;
#[path = "../../../trainer/src/kernel/sincos.rs"]
mod sincos;
#[path = "../../../trainer/src/kernel/wide.rs"]
mod wide;

/// What `matmul.rs` needs of the trainer's trait of the same name, without Burn.
mod scalar {
    pub(crate) trait Scalar: Copy + 'static {
        const ONE: Self;
    }
    impl Scalar for f32 {
        const ONE: Self = 1.0;
    }
    impl Scalar for f64 {
        const ONE: Self = 1.0;
    }
}

use matmul::{Matrix, MatrixMut, accumulate_transposed, multiply};

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    let Some((head, rest)) = data.split_first_chunk::<6>() else { return };
    products(*head, rest);
    waves(rest);
});

/// Three products of whole numbers, which are exact in any order, and what lies between their rows.
fn products([m, n, k, more_a, more_b, more_c]: [u8; 6], rest: &[u8]) {
    let (m, n, k) = (usize::from(m), usize::from(n % 80), usize::from(k % 80));
    let [a_stride, b_stride, c_stride] = [(k, more_a), (n, more_b), (n, more_c)].map(|(w, m)| w + usize::from(m % 8));
    let filled = |rows: usize, width: usize, stride: usize, seed: usize| -> Box<[f32]> {
        let length = if rows == 0 { 0 } else { (rows - 1) * stride + width };
        let byte = |i: usize| rest.get((i + seed) % rest.len().max(1)).copied().unwrap_or(i as u8);
        (0..length).map(|i| f32::from(byte(i) % 13) - 6.0).collect()
    };
    let (a, b, mut c) = (filled(m, k, a_stride, 1), filled(k, n, b_stride, 2), filled(m, n, c_stride, 3));
    let old = c.clone();
    let turned: Box<[f32]> = (0..k * m).map(|i| a[i % m * a_stride + i / m]).collect();
    let (a, b) = (Matrix::new(&a, m, k, a_stride), Matrix::new(&b, k, n, b_stride));
    multiply(a, b, MatrixMut::new(&mut c, m, n, c_stride), false);
    multiply(a, b, MatrixMut::new(&mut c, m, n, c_stride), true);
    accumulate_transposed(Matrix::dense(&turned, k, m), b, MatrixMut::new(&mut c, m, n, c_stride));
    for (i, (&value, &old)) in c.iter().zip(&old).enumerate() {
        let (row, col) = (i / c_stride, i % c_stride);
        let product =
            |row: usize| (0..k).map(|l| a.values[row * a_stride + l] * b.values[l * b_stride + col]).sum::<f32>();
        assert_eq!(value, if col < n { 3.0 * product(row) } else { old }, "{m}×{n}×{k}, row {row}, column {col}");
    }
}

/// Sine and cosine against those of the standard library in f64.
fn waves(rest: &[u8]) {
    let x: Box<[f32]> = rest.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    let (mut sin, mut cos) = (vec![0.0; x.len()].into_boxed_slice(), vec![0.0; x.len()].into_boxed_slice());
    sincos::f32_scaled(&x, 1.0, &mut sin, &mut cos);
    for ((&x, &sin), &cos) in x.iter().zip(&sin).zip(&cos) {
        let (s, c) = f64::from(x).sin_cos();
        let off = (s - f64::from(sin)).abs().max((c - f64::from(cos)).abs());
        assert!(if x.is_finite() { off < 1.2e-7 } else { sin.is_nan() && cos.is_nan() }, "{x} gives {sin}, {cos}");
    }
}
