//! The loss terms (eq. 14–17; fact sheet §2.1), always unweighted; weights are applied in one place, [`LossTerms::total`].

use burn::tensor::Tensor;
use burn::tensor::activation::softplus;

use crate::config::LossWeights;
use crate::fields::BETA_FLOOR;

/// Exponent of the focal loss.
pub const FOCAL_GAMMA: f64 = 1.5;
/// Weight of both classes in the focal loss.
pub const FOCAL_ALPHA: f64 = 0.5;

/// The terms of one level, each a single number.
#[derive(Clone, Debug)]
pub struct LossTerms {
    /// L_recon: mean squared error over rays and channels.
    pub reconstruction: Tensor<1>,
    /// L_mask: mean focal loss over given (ray, region) pairs.
    pub mask: Tensor<1>,
    /// L_attr, where it counts.
    pub attribute: Option<Tensor<1>>,
    /// L_lat: mean over rays of ‖ω‖².
    pub latent: Tensor<1>,
}

impl LossTerms {
    /// The weighted sum.
    pub fn total(&self, weights: &LossWeights, attribute_weight: f64) -> Tensor<1> {
        let Self { reconstruction, mask, attribute, latent } = self;
        let sum = reconstruction.clone() + mask.clone() * weights.mask + latent.clone() * weights.latent;
        match attribute {
            Some(attribute) => sum + attribute.clone() * attribute_weight,
            None => sum,
        }
    }
}

/// L_recon.
///
/// # Shapes
/// both `[r, 3]`
pub fn reconstruction(rendered: Tensor<2>, truth: Tensor<2>) -> Tensor<1> {
    (rendered - truth).powi_scalar(2).mean()
}

/// Σ given · value / (Σ given + 1e-7): no given entry gives 0, not 0/0.
fn mean_where_given<const D: usize>(value: Tensor<D>, given: Tensor<D>) -> Tensor<1> {
    (value * given.clone()).sum() / (given.sum() + 1e-7)
}

/// The focal loss from logits, entry by entry.
///
/// ```text
/// −[½ (1 − p)^γ y ln p + ½ p^γ (1 − y) ln(1 − p)]      ln p = −softplus(−z)   ln(1 − p) = −softplus(z)
/// ```
///
/// From logits there is nothing to clip: a clipped probability has no gradient, and a mask that is sure and wrong would
/// stay so (fact sheet §8.10).
pub fn focal(logits: Tensor<2>, truth: Tensor<2>) -> Tensor<2> {
    let not_p = softplus(logits.clone(), 1.0); // −ln(1 − p)
    let p = softplus(logits.neg(), 1.0); // −ln p
    let positive = (not_p.clone() * -FOCAL_GAMMA).exp() * truth.clone() * p.clone();
    let negative = (p * -FOCAL_GAMMA).exp() * (truth.neg() + 1.0) * not_p;
    (positive + negative) * FOCAL_ALPHA
}

/// L_mask.
///
/// # Shapes
/// `logits` (rendered), `truth` and `given` (0 or 1): `[r, N]`
pub fn mask(logits: Tensor<2>, truth: Tensor<2>, given: Tensor<2>) -> Tensor<1> {
    mean_where_given(focal(logits, truth), given)
}

/// L_attr (eq. 17): `(α − α_gt)² / 2β² + (ln β)² / 2`.
///
/// # Shapes
/// `alpha`, `truth`, `beta` (rendered), `given`: `[r, K]`
pub fn attribute(alpha: Tensor<2>, truth: Tensor<2>, beta: Tensor<2>, given: Tensor<2>) -> Tensor<1> {
    // A ray that stays transparent renders less than the floor (fact sheet §8.4).
    let beta = beta.clamp_min(BETA_FLOOR);
    let ln_beta = beta.clone().log();
    let error = (alpha - truth) / beta;
    mean_where_given((error.powi_scalar(2) + ln_beta.powi_scalar(2)) * 0.5, given)
}

/// L_lat.
///
/// # Shapes
/// `omega`: `[r, latent]`
pub fn latent(omega: Tensor<2>) -> Tensor<1> {
    omega.powi_scalar(2).sum_dim(1).mean()
}

#[cfg(test)]
#[allow(clippy::excessive_precision, reason = "check values are kept as published")]
mod tests {
    use burn::tensor::{Device, TensorData};

    use super::*;

    fn one(value: f32, device: &Device) -> Tensor<2> {
        Tensor::from_data(TensorData::new(vec![value], [1, 1]), device)
    }

    fn number<const D: usize>(t: Tensor<D>) -> f32 {
        t.into_data().try_to_vec::<f32>().unwrap()[0]
    }

    #[test]
    fn focal_matches_the_check_values() {
        let device = Device::flex();
        let logit = |p: f32| (p / (1.0 - p)).ln();
        for (p, y, expected) in
            [(0.9, 1.0, 0.001_665_90), (0.9, 0.0, 0.982_990_81), (0.5, 0.7, 0.122_532_27), (0.3, 0.4, 0.158_606_53)]
        {
            let got = number(focal(one(logit(p), &device), one(y, &device)));
            assert!((got - expected).abs() < 2e-6, "p {p} y {y}: {got}");
        }
    }

    #[test]
    fn a_sure_and_wrong_mask_still_has_a_gradient() {
        let device = Device::flex().autodiff();
        for z in [-60.0, -20.0, 20.0, 60.0] {
            let logits = one(z, &device).require_grad();
            let truth = one(f32::from(u8::from(z < 0.0)), &device);
            let grads = focal(logits.clone(), truth).sum().backward();
            let g = number(logits.grad(&grads).unwrap());
            assert!(g.is_finite() && g.abs() > 0.4, "z {z}: {g}");
        }
    }

    #[test]
    fn eq_17_matches_the_check_values() {
        let device = Device::flex();
        for (e, beta, expected) in
            [(0.5, 1.0, 0.125), (0.5, 1.2, 0.103_426_31), (0.0, 0.03, 6.147_974), (2.0, 1.5, 0.971_089_87)]
        {
            let t = |v: f32| one(v, &device);
            let got = number(attribute(t(e), t(0.0), t(beta), t(1.0)));
            assert!((got - expected).abs() < 2e-6 * expected.max(1.0), "e {e} β {beta}: {got}");
            assert_eq!(number(attribute(t(e), t(0.0), t(beta), t(0.0))), 0.0);
        }
    }
}
