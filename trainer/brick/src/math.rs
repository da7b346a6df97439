//! Small functions of the innermost loops.

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
