//! Windowed positional encoding.

use std::ops::Range;

use burn::backend::Dispatch;
use burn::tensor::Tensor;
use rayon::prelude::*;

use super::scalar::Scalar;
use super::{TILE_ROWS, chunk_rows, is_fused, reference};

/// Which frequencies an encoding has and how much of each shows.
#[derive(Debug, Clone, PartialEq)]
pub struct EncodingSpec {
    /// Band k scales its argument by 2^k.
    pub bands: Range<i32>,
    /// Weight of each band, in 0..=1; as many as there are bands.
    pub window: Vec<f32>,
    /// Whether the input itself comes first, never windowed.
    pub identity: bool,
}

impl EncodingSpec {
    /// Columns of the encoding of `channels` channels.
    pub fn columns(&self, channels: usize) -> usize {
        channels * (usize::from(self.identity) + 2 * self.bands.len())
    }
}

/// Encodes `x`, `[n, c]`, as `[n, columns]`: the input if `identity`, then for each band k the sines of `2^k x` of all
/// channels and the cosines of all channels, times the band's weight.
///
/// Differentiable in `x`. `f32` values are within 1.2e-7 of the exact ones.
///
/// # Panics
///
/// Panics if the window does not have one weight per band.
pub fn positional_encoding(x: Tensor<2>, bands: Range<i32>, window: &[f32], identity: bool) -> Tensor<2> {
    assert_eq!(window.len(), bands.len(), "weights of the bands {bands:?}");
    let spec = EncodingSpec { bands, window: window.to_vec(), identity };
    if is_fused(&x) && spec.columns(1) > 0 {
        let encoded = <Dispatch as super::extension::Kernels>::fused_encoding(x.into_dispatch(), spec);
        return Tensor::from_dispatch(encoded);
    }
    reference::positional_encoding(x, &spec)
}

/// Rows encoded together, so that sines run over long stretches whatever the channel count.
const BLOCK_ROWS: usize = TILE_ROWS;

/// `[n, columns]` from `[n, channels]`.
pub(super) fn forward<T: Scalar>(x: &[T], channels: usize, spec: &EncodingSpec) -> Vec<T> {
    let columns = spec.columns(channels);
    let rows = x.len().checked_div(channels).unwrap_or(0);
    let mut encoded = vec![T::ZERO; rows * columns];
    if rows == 0 {
        return encoded;
    }
    let chunk = chunk_rows(rows, TILE_ROWS);
    encoded.par_chunks_mut(chunk * columns).zip(x.par_chunks(chunk * channels)).for_each(|(encoded, x)| {
        let (mut sin, mut cos) = (vec![T::ZERO; BLOCK_ROWS * channels], vec![T::ZERO; BLOCK_ROWS * channels]);
        let blocks = encoded.chunks_mut(BLOCK_ROWS * columns).zip(x.chunks(BLOCK_ROWS * channels));
        for (encoded, x) in blocks {
            let mut column = 0;
            if spec.identity {
                spread(x, channels, encoded, columns, column, T::ONE);
                column += channels;
            }
            for (band, &weight) in spec.bands.clone().zip(&spec.window) {
                let scale = T::from_f64(f64::from(band).exp2());
                let weight = T::from_f64(f64::from(weight));
                let (sin, cos) = (&mut sin[..x.len()], &mut cos[..x.len()]);
                T::sin_cos_scaled(x, scale, sin, cos);
                spread(sin, channels, encoded, columns, column, weight);
                spread(cos, channels, encoded, columns, column + channels, weight);
                column += 2 * channels;
            }
        }
    });
    encoded
}

/// `encoded[r, column + c] = weight * values[r, c]`.
fn spread<T: Scalar>(values: &[T], channels: usize, encoded: &mut [T], columns: usize, column: usize, weight: T) {
    for (encoded, values) in encoded.chunks_exact_mut(columns).zip(values.chunks_exact(channels)) {
        for (encoded, &value) in encoded[column..column + channels].iter_mut().zip(values) {
            *encoded = weight * value;
        }
    }
}

/// Gradient in `x` for the gradient `upstream` of the encoding.
pub(super) fn backward<T: Scalar>(x: &[T], channels: usize, spec: &EncodingSpec, upstream: &[T]) -> Vec<T> {
    let columns = spec.columns(channels);
    let rows = x.len().checked_div(channels).unwrap_or(0);
    let mut gradient = vec![T::ZERO; x.len()];
    if rows == 0 {
        return gradient;
    }
    let chunk = chunk_rows(rows, TILE_ROWS);
    let chunks = gradient.par_chunks_mut(chunk * channels).zip(x.par_chunks(chunk * channels));
    chunks.zip(upstream.par_chunks(chunk * columns)).for_each(|((gradient, x), upstream)| {
        let (mut sin, mut cos) = (vec![T::ZERO; BLOCK_ROWS * channels], vec![T::ZERO; BLOCK_ROWS * channels]);
        let blocks = gradient.chunks_mut(BLOCK_ROWS * channels).zip(x.chunks(BLOCK_ROWS * channels));
        for ((gradient, x), upstream) in blocks.zip(upstream.chunks(BLOCK_ROWS * columns)) {
            let mut column = 0;
            if spec.identity {
                for (gradient, upstream) in gradient.chunks_exact_mut(channels).zip(upstream.chunks_exact(columns)) {
                    gradient.copy_from_slice(&upstream[..channels]);
                }
                column += channels;
            }
            for (band, &weight) in spec.bands.clone().zip(&spec.window) {
                let scale = T::from_f64(f64::from(band).exp2());
                let weight = T::from_f64(f64::from(weight)) * scale;
                T::sin_cos_scaled(x, scale, &mut sin[..x.len()], &mut cos[..x.len()]);
                let rows = gradient.chunks_exact_mut(channels).zip(upstream.chunks_exact(columns));
                let functions = sin.chunks_exact(channels).zip(cos.chunks_exact(channels));
                for ((gradient, upstream), (sin, cos)) in rows.zip(functions) {
                    let (to_sin, to_cos) = upstream[column..column + 2 * channels].split_at(channels);
                    for channel in 0..channels {
                        gradient[channel] += weight * (to_sin[channel] * cos[channel] - to_cos[channel] * sin[channel]);
                    }
                }
                column += 2 * channels;
            }
        }
    });
    gradient
}
