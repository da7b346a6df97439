//! Small functions of the innermost loops: of one number, and of sixteen side by side with the same bits.
#![allow(unsafe_code, reason = "arithmetic on vectors; what it asks of the machine stands at `Simd`")]

use crate::simd::Simd;

/// Raw densities above this count as this; the gradient passes unchanged.
pub const DENSITY_CLAMP: f32 = 8.0;
/// What is taken off a raw density before the exponential: an untrained field is thin.
pub const DENSITY_SHIFT: f32 = 1.0;

/// e^x to 3e-7 relative, between 2^-126 and 2^126.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    let t = (x * std::f32::consts::LOG2_E).clamp(-126.0, 126.0);
    // Adding and taking off 1.5 · 2^23 rounds to the nearest whole number without a call.
    let whole = (t + 12_582_912.0) - 12_582_912.0;
    let f = (t - whole) * std::f32::consts::LN_2;
    // Taylor series of e^f for |f| ≤ ln 2 / 2.
    let p = 1.0 + f * (1.0 + f * (0.5 + f * (1.0 / 6.0 + f * (1.0 / 24.0 + f * (1.0 / 120.0 + f * (1.0 / 720.0))))));
    f32::from_bits(((whole as i32 + 127) as u32) << 23) * p
}

/// 1 / (1 + e^-x)
#[inline(always)]
pub fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// Density of a raw density.
#[inline(always)]
pub fn density(raw: f32) -> f32 {
    exp((raw - DENSITY_SHIFT).min(DENSITY_CLAMP))
}

/// [`exp`] of sixteen numbers.
///
/// # Safety
/// As the operations of [`Simd`].
#[inline(always)]
pub(crate) unsafe fn exp_each<S: Simd>(x: S::V) -> S::V {
    // SAFETY: the caller's promise.
    unsafe {
        let t = S::mul(x, S::splat(std::f32::consts::LOG2_E));
        // The number second: where it is none, it stays so.
        let t = S::max(S::splat(-126.0), S::min(S::splat(126.0), t));
        let magic = S::splat(12_582_912.0);
        let whole = S::sub(S::add(t, magic), magic);
        let f = S::mul(S::sub(t, whole), S::splat(std::f32::consts::LN_2));
        let mut p = S::splat(1.0 / 720.0);
        for term in [1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0] {
            p = S::add(S::splat(term), S::mul(f, p));
        }
        let power = S::i_mul(S::i_add(S::i_from(whole), S::i_splat(127)), S::i_splat(1 << 23));
        S::mul(S::i_bits(power), p)
    }
}

/// [`sigmoid`] of sixteen numbers.
///
/// # Safety
/// As the operations of [`Simd`].
#[inline(always)]
pub(crate) unsafe fn sigmoid_each<S: Simd>(x: S::V) -> S::V {
    // SAFETY: the caller's promise.
    unsafe {
        let one = S::splat(1.0);
        S::div(one, S::add(one, exp_each::<S>(S::sub(S::splat(-0.0), x))))
    }
}

/// Opacity of a step of length `step` through sixteen raw densities: 1 − exp(−σ · step).
///
/// # Safety
/// As the operations of [`Simd`].
#[inline(always)]
pub(crate) unsafe fn opacity_each<S: Simd>(raw: S::V, step: f32) -> S::V {
    // SAFETY: the caller's promise.
    unsafe {
        let sigma = exp_each::<S>(S::min(S::sub(raw, S::splat(DENSITY_SHIFT)), S::splat(DENSITY_CLAMP)));
        S::sub(S::splat(1.0), exp_each::<S>(S::mul(S::sub(S::splat(-0.0), sigma), S::splat(step))))
    }
}

/// a · b
#[inline(always)]
pub fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// The rotation by the vector `w` (angle |w|) applied to `p`, after Rodrigues; exact, and stable at 0.
pub fn rotate(w: [f32; 3], p: [f32; 3]) -> [f32; 3] {
    let angle2 = dot(w, w);
    let angle = angle2.sqrt();
    let (a, b) = if angle < 1e-4 {
        (1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0)
    } else {
        (angle.sin() / angle, (1.0 - angle.cos()) / angle2)
    };
    let cross =
        |u: [f32; 3], v: [f32; 3]| [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
    let wp = cross(w, p);
    let wwp = cross(w, wp);
    std::array::from_fn(|i| p[i] + a * wp[i] + b * wwp[i])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::{Level, Task, run_at};

    /// Densities' opacities and sigmoids of sixteen numbers.
    struct Each([f32; 16]);

    impl Task for Each {
        type Output = [[f32; 16]; 3];

        #[inline(always)]
        fn run<S: Simd>(self) -> Self::Output {
            let mut out = [[0.0; 16]; 3];
            // SAFETY: arrays of 16.
            unsafe {
                let x = S::load(self.0.as_ptr());
                S::store(out[0].as_mut_ptr(), exp_each::<S>(x));
                S::store(out[1].as_mut_ptr(), sigmoid_each::<S>(x));
                S::store(out[2].as_mut_ptr(), opacity_each::<S>(x, 0.03));
            }
            out
        }
    }

    #[test]
    fn sixteen_side_by_side_are_each_by_itself_to_the_bit() {
        let hard = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, f32::MIN, -1e9, 1e9, 0.0, -0.0, 1e-30];
        let mut all: Vec<f32> = (0..1590).map(|i| (i as f32 - 800.0) * 0.173).collect();
        all.extend(hard);
        for level in [Level::Scalar, Level::Avx2, Level::Avx512] {
            for x in all.as_chunks::<16>().0 {
                let found = run_at(level, Each(*x));
                for (i, &x) in x.iter().enumerate() {
                    let expected = [exp(x), sigmoid(x), 1.0 - exp(-density(x) * 0.03)];
                    for (found, expected) in found.iter().zip(expected) {
                        let same = found[i].to_bits() == expected.to_bits() || (found[i].is_nan() && expected.is_nan());
                        assert!(same, "{level:?} {x}: {} {expected}", found[i]);
                    }
                }
            }
        }
    }

    #[test]
    fn exp_and_density_stay_finite_and_right() {
        for x in [-87.0f32, -3.2, -0.4, 0.0, 0.1, 1.0, 7.7, 80.0] {
            let expected = f64::from(x).exp();
            assert!((f64::from(exp(x)) / expected - 1.0).abs() < 1e-5, "{x}: {}", exp(x));
        }
        for raw in [f32::MIN, -1e9, 0.0, 9.0, 88.0, 1e9, f32::MAX, f32::INFINITY, f32::NEG_INFINITY] {
            let d = density(raw);
            assert!(d.is_finite() && d >= 0.0, "{raw}: {d}");
            assert!((0.0..=1.0).contains(&sigmoid(raw)), "{raw}");
        }
        assert!(density(-1e9) < 1e-30);
    }

    #[test]
    fn turning_keeps_lengths_and_undoes_itself() {
        let p = [0.3, -1.2, 0.7];
        for w in [[0.0; 3], [1e-6, 0.0, 0.0], [0.02, -0.5, 0.3], [3.0, 1.0, -2.0]] {
            let q = rotate(w, p);
            assert!((dot(q, q) - dot(p, p)).abs() < 1e-5);
            let back = rotate(w.map(|v| -v), q);
            assert!((0..3).all(|a| (back[a] - p[a]).abs() < 1e-5), "{w:?}");
        }
    }
}
