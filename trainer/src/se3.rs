//! The exponential map of SE(3), finite everywhere (fact sheet §1.5 and §8.1).
//!
//! ```text
//! θ² = w·w      A = sin θ / θ     B = (1 − cos θ) / θ²     C = (θ − sin θ) / θ³
//! x' = x + A (w × x) + B (w × (w × x)) + v + B (w × v) + C (w × (w × v))
//! ```
//!
//! Below θ² = 1e-2 the three factors come from their series in θ²: there 1 − cos θ loses its digits, and the gradient
//! of θ = √θ² at 0 is not a number. Both branches are fed a value they can digest before one is chosen.

use burn::tensor::Tensor;

/// Below this θ² the series are used.
const SMALL: f32 = 1e-2;

/// a × b, row by row.
fn cross(a: &Tensor<2>, b: &Tensor<2>) -> Tensor<2> {
    let col = |t: &Tensor<2>, i: usize| t.clone().narrow(1, i, 1);
    let part = |i: usize, j: usize| col(a, i) * col(b, j) - col(a, j) * col(b, i);
    Tensor::cat(vec![part(1, 2), part(2, 0), part(0, 1)], 1)
}

/// x' of every row.
///
/// # Shapes
/// `w` (rotation), `v` (translation) and `x`: `[n, 3]`, result: `[n, 3]`
pub fn transform(w: &Tensor<2>, v: &Tensor<2>, x: Tensor<2>) -> Tensor<2> {
    let theta2 = w.clone().powi_scalar(2).sum_dim(1);
    let is_small = theta2.clone().lower_scalar(SMALL);
    let series = |c: [f32; 3]| {
        let t = theta2.clone().mask_fill(is_small.clone().bool_not(), 0.0);
        (t.clone() * c[2] + c[1]) * t + c[0]
    };
    let (a_small, b_small, c_small) = (
        series([1.0, -1.0 / 6.0, 1.0 / 120.0]),
        series([0.5, -1.0 / 24.0, 1.0 / 720.0]),
        series([1.0 / 6.0, -1.0 / 120.0, 1.0 / 5040.0]),
    );
    let safe2 = theta2.mask_fill(is_small.clone(), 1.0);
    let theta = safe2.clone().sqrt();
    let (sin, cos) = (theta.clone().sin(), theta.clone().cos());
    let a = (sin.clone() / theta.clone()).mask_where(is_small.clone(), a_small);
    let b = ((cos.neg() + 1.0) / safe2.clone()).mask_where(is_small.clone(), b_small);
    let c = ((theta.clone() - sin) / (safe2 * theta)).mask_where(is_small, c_small);
    let (wx, wv) = (cross(w, &x), cross(w, v));
    let (wwx, wwv) = (cross(w, &wx), cross(w, &wv));
    // The motion is added to x as a small difference, which keeps the digits of x.
    x + (a * wx + b.clone() * wwx + v.clone() + b * wv + c * wwv)
}

#[cfg(test)]
#[allow(clippy::excessive_precision, reason = "check values are kept as published")]
mod tests {
    use burn::tensor::{Device, TensorData};

    use super::*;

    fn row(values: [f32; 3], device: &Device) -> Tensor<2> {
        Tensor::from_data(TensorData::new(values.to_vec(), [1, 3]), device)
    }

    fn values(t: Tensor<2>) -> Vec<f32> {
        t.into_data().try_to_vec::<f32>().unwrap()
    }

    #[test]
    fn it_matches_the_check_vectors() {
        let device = Device::flex();
        let x = [0.3, 0.4, 0.5];
        for (w, v, expected) in [
            ([0.4, -0.3, 0.2], [0.1, -0.2, 0.05], [0.172_683_86, -0.000_476_91, 0.703_916_92]),
            ([1e-4, 2e-5, -5e-5], [3e-5, -1e-5, 8e-5], [0.3 + 5.9999e-5, 0.4 - 7.5007e-5, 0.5 + 1.139_96e-4]),
        ] {
            let got = values(transform(&row(w, &device), &row(v, &device), row(x, &device)));
            for (g, e) in got.iter().zip(expected) {
                assert!((g - e).abs() < 1e-7, "{got:?} {expected:?}");
            }
        }
    }

    #[test]
    fn the_gradient_at_rest_is_finite_and_right() {
        let device = Device::flex().autodiff();
        let w = row([0.0; 3], &device).require_grad();
        let v = row([0.0; 3], &device).require_grad();
        let out = transform(&w, &v, row([0.3, 0.4, 0.5], &device));
        // d(x'₀)/dw = (0, x₂, −x₁), d(x'₀)/dv = (1, 0, 0).
        let grads = out.narrow(1, 0, 1).sum().backward();
        assert_eq!(values(w.grad(&grads).unwrap()), [0.0, 0.5, -0.4]);
        assert_eq!(values(v.grad(&grads).unwrap()), [1.0, 0.0, 0.0]);
    }
}
