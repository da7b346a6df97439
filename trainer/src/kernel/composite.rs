//! Volume rendering along rays.

use burn::backend::Dispatch;
use burn::tensor::Tensor;
use rayon::prelude::*;

use super::scalar::Scalar;
use super::{chunk_rows, is_fused, reference};

/// Rays a chunk is a multiple of.
const CHUNK_RAYS: usize = 16;

/// Renders `values` along rays: with `x = sigma * deltas`, `w_i = exp(-Σ_{j<i} x_j) (1 - exp(-x_i))`.
///
/// `sigma` and `deltas` are `[rays, samples]` (densities and the lengths they hold for, the last of which may be 1e10
/// for "to infinity"), `values` is `[rays, samples, channels]`. Returns `Σ_i w_i values_i`, `[rays, channels]`, and
/// the weights, `[rays, samples]`.
///
/// Differentiable in all three. No transmittance product is divided out, so opaque samples are harmless.
///
/// # Panics
///
/// Panics if the shapes do not fit each other or there are no samples or no channels.
pub fn composite(sigma: Tensor<2>, deltas: Tensor<2>, values: Tensor<3>) -> (Tensor<2>, Tensor<2>) {
    let [rays, samples, channels] = values.dims();
    assert_eq!(sigma.dims(), [rays, samples], "shape of the densities");
    assert_eq!(deltas.dims(), [rays, samples], "shape of the sample lengths");
    assert!(samples > 0 && channels > 0, "rays without samples or channels");
    if !is_fused(&sigma) {
        return reference::composite(sigma, deltas, values);
    }
    let both = Tensor::<2>::from_dispatch(<Dispatch as super::extension::Kernels>::fused_composite(
        sigma.into_dispatch(),
        deltas.into_dispatch(),
        values.into_dispatch(),
    ));
    (both.clone().narrow(1, 0, channels), both.narrow(1, channels, samples))
}

/// Samples along rays, row-major in the shapes of [`composite`].
#[derive(Clone, Copy)]
pub(super) struct Rays<'a, T> {
    pub(super) samples: usize,
    pub(super) channels: usize,
    pub(super) sigma: &'a [T],
    pub(super) deltas: &'a [T],
    pub(super) values: &'a [T],
}

impl<T: Scalar> Rays<'_, T> {
    /// Writes the weights of one ray and, with `after`, the transmittance behind each sample.
    fn weigh(&self, ray: usize, weights: &mut [T], mut after: Option<&mut [T]>) {
        let samples = ray * self.samples..(ray + 1) * self.samples;
        let (mut depth, mut before) = (T::ZERO, T::ONE);
        for (i, (&sigma, &delta)) in self.sigma[samples.clone()].iter().zip(&self.deltas[samples]).enumerate() {
            let x = sigma * delta;
            depth += x;
            // Not `before - behind`: that cancels where the sample is thin.
            weights[i] = before * (T::ONE - (-x).exp());
            before = (-depth).exp();
            if let Some(after) = after.as_deref_mut() {
                after[i] = before;
            }
        }
    }
}

/// Rendered values and weights of each ray side by side, `[rays, channels + samples]`.
pub(super) fn forward<T: Scalar>(rays: Rays<'_, T>) -> Vec<T> {
    let (samples, channels) = (rays.samples, rays.channels);
    let count = rays.sigma.len() / samples;
    let mut result = vec![T::ZERO; count * (channels + samples)];
    let chunk = chunk_rows(count, CHUNK_RAYS);
    result.par_chunks_mut(chunk * (channels + samples)).enumerate().for_each(|(index, result)| {
        for (ray, result) in result.chunks_exact_mut(channels + samples).enumerate() {
            let ray = index * chunk + ray;
            let (rendered, weights) = result.split_at_mut(channels);
            rays.weigh(ray, weights, None);
            let values = &rays.values[ray * samples * channels..][..samples * channels];
            for (i, &weight) in weights.iter().enumerate() {
                for (sum, &value) in rendered.iter_mut().zip(&values[i * channels..]) {
                    *sum += weight * value;
                }
            }
        }
    });
    result
}

/// Gradients in densities, lengths and values for the gradient `upstream` of [`forward`]'s result.
///
/// `∂w_i/∂x_i` is the transmittance behind sample i and `∂w_j/∂x_i = -w_j` for j > i, so one sweep from the far end
/// collects everything.
pub(super) fn backward<T: Scalar>(rays: Rays<'_, T>, upstream: &[T]) -> [Vec<T>; 3] {
    let (samples, channels) = (rays.samples, rays.channels);
    let count = rays.sigma.len() / samples;
    let mut sigmas = vec![T::ZERO; rays.sigma.len()];
    let mut deltas = vec![T::ZERO; rays.sigma.len()];
    let mut values = vec![T::ZERO; rays.values.len()];
    let chunk = chunk_rows(count, CHUNK_RAYS);
    sigmas
        .par_chunks_mut(chunk * samples)
        .zip(deltas.par_chunks_mut(chunk * samples))
        .zip(upstream.par_chunks(chunk * (channels + samples)))
        .zip(values.par_chunks_mut(chunk * samples * channels))
        .enumerate()
        .for_each(|(index, (((sigmas, deltas), upstream), values))| {
            let (mut weights, mut after) = (vec![T::ZERO; samples], vec![T::ZERO; samples]);
            for (row, upstream) in upstream.chunks_exact(channels + samples).enumerate() {
                let ray = index * chunk + row;
                rays.weigh(ray, &mut weights, Some(&mut after));
                let (to_rendered, to_weights) = upstream.split_at(channels);
                let mut behind = T::ZERO;
                for i in (0..samples).rev() {
                    let (here, local) = (ray * samples + i, row * samples + i);
                    let mut to_weight = to_weights[i];
                    for (channel, &to_rendered) in to_rendered.iter().enumerate() {
                        to_weight += to_rendered * rays.values[here * channels + channel];
                        values[local * channels + channel] = to_rendered * weights[i];
                    }
                    let to_x = to_weight * after[i] - behind;
                    behind += to_weight * weights[i];
                    sigmas[local] = to_x * rays.deltas[here];
                    deltas[local] = to_x * rays.sigma[here];
                }
            }
        });
    [sigmas, deltas, values]
}
