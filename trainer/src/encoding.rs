//! Positional encoding with the coarse-to-fine window (fact sheet §1.1).

use burn::tensor::Tensor;

use crate::kernel;

/// Weight of each of `bands` frequency bands at window value `a`.
///
/// ```text
/// weight_k = ½ (1 − cos(π · clip(a − k, 0, 1)))
/// ```
pub fn window(bands: usize, a: f64) -> Vec<f32> {
    let weight = |k: usize| 0.5 * (1.0 - (std::f64::consts::PI * (a - k as f64).clamp(0.0, 1.0)).cos());
    (0..bands).map(|k| weight(k) as f32).collect()
}

/// All bands open.
pub fn open_window(bands: usize) -> Vec<f32> {
    vec![1.0; bands]
}

/// Width of an encoding of `channels` inputs.
pub fn width(channels: usize, bands: usize, identity: bool) -> usize {
    channels * (2 * bands + usize::from(identity))
}

/// γ(x) of every row.
///
/// Order of the output: `[x if identity | sin(2⁰x), cos(2⁰x) | sin(2¹x), cos(2¹x) | …]`, each group over all channels.
///
/// # Shapes
/// `x`: `[n, channels]`, result: `[n, width(channels, window.len(), identity)]`
pub fn encode(x: Tensor<2>, window: &[f32], identity: bool) -> Tensor<2> {
    kernel::positional_encoding(x, 0..window.len() as i32, window, identity)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_window_matches_the_check_values() {
        for (a, expected) in [(2.25, [1.0, 1.0, 0.146_446_61, 0.0, 0.0, 0.0]), (1.5, [1.0, 0.5, 0.0, 0.0, 0.0, 0.0])] {
            for (got, want) in window(6, a).iter().zip(expected) {
                assert!((got - want).abs() < 1e-7, "{a}: {got} {want}");
            }
        }
    }
}
