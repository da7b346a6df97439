//! Passes over the rows of a tile between the matrix products.

use crate::kernel::matmul::Matrix;
use crate::kernel::scalar::Scalar;
use crate::kernel::wide::widest;

/// Partial sums of an inner product, so that it can run in vectors.
const LANES: usize = 16;

widest! {
    /// `to[r] += from[r]`, or `to[r] = from[r]` with `assign`.
    pub(super) fn add_rows<T: Scalar>(to: &mut [T], width: usize, from: Matrix<T>, assign: bool) {
        for (to, from) in to.chunks_exact_mut(width).zip(from.values.chunks(from.stride)) {
            if assign {
                to.copy_from_slice(&from[..width]);
            } else {
                for (to, &from) in to.iter_mut().zip(from) {
                    *to += from;
                }
            }
        }
    }

    /// `to += a · b` for an `a` of few columns.
    pub(super) fn add_thin_product<T: Scalar>(to: &mut [T], width: usize, a: Matrix<T>, b: &[T]) {
        for (to, a) in to.chunks_exact_mut(width).zip(a.values.chunks(a.stride).map(|row| &row[..a.cols])) {
            for (&a, b) in a.iter().zip(b.chunks_exact(width)) {
                for (to, &b) in to.iter_mut().zip(b) {
                    *to += a * b;
                }
            }
        }
    }

    /// Adds the bias to each row and cuts off below zero. A NaN stays one, which `max` would not grant.
    pub(super) fn add_bias_relu<T: Scalar>(values: &mut [T], bias: &[T]) {
        for row in values.chunks_exact_mut(bias.len()) {
            for (value, &bias) in row.iter_mut().zip(bias) {
                let sum = *value + bias;
                *value = if sum < T::ZERO { T::ZERO } else { sum };
            }
        }
    }

    /// Backward through a ReLU: clears `gradient` wherever the activation is not positive, and adds its columns to
    /// `sums`. Both matrices are dense with rows as long as `sums`.
    pub(super) fn mask_and_sum<T: Scalar>(gradient: &mut [T], activations: &[T], sums: &mut [T]) {
        let width = sums.len();
        for (gradient, activations) in gradient.chunks_exact_mut(width).zip(activations.chunks_exact(width)) {
            for ((gradient, &activation), sum) in gradient.iter_mut().zip(activations).zip(&mut *sums) {
                let passed = if activation <= T::ZERO { T::ZERO } else { *gradient };
                *gradient = passed;
                *sum += passed;
            }
        }
    }

    /// `sums[c] += Σ_r matrix[r, c]`.
    pub(super) fn sum_columns<T: Scalar>(matrix: Matrix<T>, sums: &mut [T]) {
        for row in matrix.values.chunks(matrix.stride).take(matrix.rows) {
            for (sum, &value) in sums.iter_mut().zip(row) {
                *sum += value;
            }
        }
    }

    /// `to += aᵀ · b` for an `a` of few columns.
    pub(super) fn add_thin_transposed<T: Scalar>(to: &mut [T], a: Matrix<T>, b: Matrix<T>) {
        let (columns, width) = (a.cols, b.cols);
        for (a, b) in a.values.chunks(a.stride).zip(b.values.chunks(b.stride)).take(a.rows) {
            for (&a, to) in a[..columns].iter().zip(to.chunks_exact_mut(width)) {
                for (to, &b) in to.iter_mut().zip(b) {
                    *to += a * b;
                }
            }
        }
    }

    /// `to = a · bᵀ`, or `to += a · bᵀ` with `accumulate`, for a `b` of few rows; `to` has rows of `stride`.
    pub(super) fn thin_back_product<T: Scalar>(to: &mut [T], stride: usize, a: Matrix<T>, b: Matrix<T>, accumulate: bool) {
        for (to, a) in to.chunks_mut(stride).zip(a.values.chunks_exact(a.stride)).take(a.rows) {
            for (to, b) in to.iter_mut().zip(b.values.chunks_exact(b.stride)).take(b.rows) {
                let mut sums = [T::ZERO; LANES];
                for (a, b) in a.chunks(LANES).zip(b.chunks(LANES)) {
                    for ((sum, &a), &b) in sums.iter_mut().zip(a).zip(b) {
                        *sum += a * b;
                    }
                }
                let product = sums.into_iter().fold(T::ZERO, |total, sum| total + sum);
                *to = if accumulate { *to + product } else { product };
            }
        }
    }
}
