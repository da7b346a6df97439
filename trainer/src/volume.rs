//! Volume rendering of samples along rays (eq. 2 and 11; fact sheet §2.2).
//!
//! ```text
//! a_i = 1 − exp(−σ_i δ_i)     T_i = exp(−Σ_{j<i} σ_j δ_j)     w_i = a_i T_i
//! ```
//!
//! The last sample is followed by δ = 1e10: what the ray does not hit nearer, it hits there, and the weights sum to 1.
//! Transmittance is kept as a sum of exponents; the product form's gradient divides by 1 − a.

use burn::tensor::Tensor;

/// The interval after the last sample.
pub const LAST_DELTA: f32 = 1e10;

/// Weights of the samples.
///
/// # Shapes
/// `density` and `deltas`: `[r, s]`, result: `[r, s]`
pub fn weights(density: Tensor<2>, deltas: Tensor<2>) -> Tensor<2> {
    let [r, s] = density.dims();
    let optical = density * deltas;
    // Exclusive sum by shifting: subtracting the last, huge term again would leave nothing but rounding.
    let before =
        Tensor::cat(vec![Tensor::zeros([r, 1], &optical.device()), optical.clone().narrow(1, 0, s - 1).cumsum(1)], 1);
    (optical.neg().exp().neg() + 1.0) * before.neg().exp()
}

/// `Σ w_i value_i` per ray.
///
/// # Shapes
/// `weights`: `[r, s]`, `values`: `[r, s, c]`, result: `[r, c]`
pub fn composite(weights: Tensor<2>, values: Tensor<3>) -> Tensor<2> {
    (values * weights.unsqueeze_dim::<3>(2)).sum_dim(1).squeeze_dim::<2>(1)
}

/// Distances between samples and the last interval, ray after ray.
pub fn deltas(depths: &[f32], samples: usize) -> Vec<f32> {
    let mut out = vec![LAST_DELTA; depths.len()];
    for (out, z) in out.chunks_exact_mut(samples).zip(depths.chunks_exact(samples)) {
        for i in 0..samples - 1 {
            out[i] = z[i + 1] - z[i];
        }
    }
    out
}

#[cfg(test)]
#[allow(clippy::excessive_precision, reason = "check values are kept as published")]
mod tests {
    use burn::tensor::{Device, TensorData};

    use super::*;

    #[test]
    fn it_matches_the_check_vector() {
        let device = Device::flex();
        let z = [1.0, 1.5, 2.5, 3.0];
        let sigma = Tensor::<2>::from_data(TensorData::new(vec![0.2f32, 1.0, 0.5, 2.0], [1, 4]), &device);
        let d = Tensor::<2>::from_data(TensorData::new(deltas(&z, 4), [1, 4]), &device);
        let w = weights(sigma, d);
        let got = w.clone().into_data().try_to_vec::<f32>().unwrap();
        for (g, e) in got.iter().zip([0.095_162_58, 0.571_966_33, 0.073_630_82, 0.259_240_26]) {
            assert!((g - e).abs() < 1e-6, "{got:?}");
        }
        let colors = vec![0.1f32, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 0.0, 1.0];
        let rgb = composite(w, Tensor::from_data(TensorData::new(colors, [1, 4, 3]), &device));
        let got = rgb.into_data().try_to_vec::<f32>().unwrap();
        for (g, e) in got.iter().zip([0.549_084_63, 0.363_920_34, 0.697_236_58]) {
            assert!((g - e).abs() < 1e-6, "{got:?}");
        }
    }
}
