//! Sine and cosine of many arguments at once.

use super::wide::widest;

/// Largest magnitude the vectorised reduction takes: the rounding error of π/2 in f64 times the quadrant count stays
/// below an f32's precision.
const LIMIT: f32 = 1.0e7;

/// Adding and subtracting this rounds an f64 of magnitude below 2^51 to the nearest integer, which is then found in
/// the low bits of the sum. Unlike `round` it needs no instruction beyond addition, so the loop vectorises anywhere.
const ROUND: f64 = 6_755_399_441_055_744.0;

widest! {
    /// `sin[i], cos[i] = (scale * x[i]).sin_cos()`.
    ///
    /// Error below 1.2e-7 in absolute value. The argument is reduced in f64, hence full precision for large arguments.
    pub(super) fn f32_scaled(x: &[f32], scale: f32, sin: &mut [f32], cos: &mut [f32]) {
        for ((x, sin), cos) in x.chunks(64).zip(sin.chunks_mut(64)).zip(cos.chunks_mut(64)) {
            // A NaN compares as false and leaves the polynomial as NaN.
            if x.iter().any(|&x| (x * scale).abs() > LIMIT) {
                for ((&x, sin), cos) in x.iter().zip(sin).zip(cos) {
                    (*sin, *cos) = (x * scale).sin_cos();
                }
            } else {
                for ((&x, sin), cos) in x.iter().zip(sin).zip(cos) {
                    (*sin, *cos) = sin_cos(x * scale);
                }
            }
        }
    }
}

/// `sin[i], cos[i] = (scale * x[i]).sin_cos()`.
pub(super) fn f64_scaled(x: &[f64], scale: f64, sin: &mut [f64], cos: &mut [f64]) {
    for ((&x, sin), cos) in x.iter().zip(sin).zip(cos) {
        (*sin, *cos) = (x * scale).sin_cos();
    }
}

/// Branch-free sine and cosine: reduction to ±π/4, minimax polynomials, quadrant fix-up.
#[inline(always)]
#[expect(clippy::inline_always, reason = "the loop around it vectorises only if this is inlined")]
fn sin_cos(x: f32) -> (f32, f32) {
    let x = f64::from(x);
    let shifted = x * std::f64::consts::FRAC_2_PI + ROUND;
    let quadrant = shifted.to_bits() as u32;
    let r = (x - (shifted - ROUND) * std::f64::consts::FRAC_PI_2) as f32;
    let r2 = r * r;
    let s = r + r * r2 * (-1.666_665_5e-1 + r2 * (8.332_161e-3 + r2 * -1.951_529_6e-4));
    let c = 1.0 - 0.5 * r2 + r2 * r2 * (4.166_664_6e-2 + r2 * (-1.388_731_6e-3 + r2 * 2.443_315_7e-5));
    let (sin, cos) = if quadrant & 1 == 0 { (s, c) } else { (c, s) };
    // The sine is negative in quadrants 2 and 3, the cosine in 1 and 2; both signs go to the sign bit.
    let flip = |value: f32, sign: u32| f32::from_bits(value.to_bits() ^ (sign << 30 & 0x8000_0000));
    (flip(sin, quadrant), flip(cos, quadrant.wrapping_add(1)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn worst(range: f32, scale: f32) -> f64 {
        let x: Vec<f32> = (0..200_003).map(|i| (i as f32 / 100_001.5 - 1.0) * range).collect();
        let (mut sin, mut cos) = (vec![0.0; x.len()], vec![0.0; x.len()]);
        f32_scaled(&x, scale, &mut sin, &mut cos);
        let error = |(i, &x): (usize, &f32)| {
            let (s, c) = f64::from(x * scale).sin_cos();
            (s - f64::from(sin[i])).abs().max((c - f64::from(cos[i])).abs())
        };
        x.iter().enumerate().map(error).fold(0.0, f64::max)
    }

    #[test]
    fn error_stays_below_an_ulp_of_one() {
        for (range, scale) in [(1.0, 1.0), (3.2, 1.0), (8.0, 128.0), (1e3, 1.0), (9e6, 1.0), (1e9, 1.0)] {
            let error = worst(range, scale);
            assert!(error < 1.2e-7, "{error} for arguments up to {}", range * scale);
        }
    }

    #[test]
    fn not_a_number_stays_one() {
        let x = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 0.0];
        let (mut sin, mut cos) = ([0.0; 4], [0.0; 4]);
        f32_scaled(&x, 1.0, &mut sin, &mut cos);
        assert!(sin[..3].iter().chain(&cos[..3]).all(|v| v.is_nan()));
        assert_eq!((sin[3], cos[3]), (0.0, 1.0));
    }
}
