//! The loss terms (eq. 14–17; fact sheet §2.1), always unweighted; weights are applied in one place, [`LossTerms::total`].

use burn::tensor::Tensor;
use burn::tensor::activation::softplus;

use crate::config::LossWeights;
use crate::fields::BETA_FLOOR;

/// Exponent of the focal loss.
pub const FOCAL_GAMMA: f64 = 1.5;
/// Weight of both classes in the focal loss.
pub const FOCAL_ALPHA: f64 = 0.5;

/// What the means of a batch are taken over. A part of the batch is summed and divided by the whole batch's counts, so
/// that the parts' losses, and their gradients, add up to the whole's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Counts {
    /// Rays.
    pub rays: f64,
    /// Σδ of L_mask: (ray, mask) pairs with a given mask.
    pub masks: f64,
    /// Σδ of L_attr: (ray, attribute) pairs with a given attribute.
    pub attributes: f64,
}

/// Keeps a batch without annotations at 0 instead of 0/0.
const NO_COUNT: f64 = 1e-7;

/// The terms of one level, each a single number.
#[derive(Clone, Debug)]
pub struct LossTerms {
    /// L_recon: mean squared error over rays and channels.
    pub reconstruction: Tensor<1>,
    /// L_mask, where there are masks: mean focal loss over given (ray, mask) pairs.
    pub mask: Option<Tensor<1>>,
    /// L_attr, where it counts.
    pub attribute: Option<Tensor<1>>,
    /// L_lat, where there are codes: mean over rays of ‖ω‖².
    pub latent: Option<Tensor<1>>,
}

impl LossTerms {
    /// The weighted sum.
    pub fn total(&self, weights: &LossWeights, attribute_weight: f64) -> Tensor<1> {
        let Self { reconstruction, mask, attribute, latent } = self;
        [(mask, weights.mask), (latent, weights.latent), (attribute, attribute_weight)]
            .into_iter()
            .filter_map(|(term, weight)| Some(term.clone()? * weight))
            .fold(reconstruction.clone(), |sum, term| sum + term)
    }
}

/// L_recon.
///
/// # Shapes
/// both `[r, 3]`
pub fn reconstruction(rendered: Tensor<2>, truth: Tensor<2>, counts: Counts) -> Tensor<1> {
    (rendered - truth).powi_scalar(2).sum() / (3.0 * counts.rays)
}

/// Σ given · value / (Σ given + 1e-7) with the whole batch's Σ given.
fn mean_where_given<const D: usize>(value: Tensor<D>, given: Tensor<D>, count: f64) -> Tensor<1> {
    (value * given).sum() / (count + NO_COUNT)
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
pub fn mask(logits: Tensor<2>, truth: Tensor<2>, given: Tensor<2>, counts: Counts) -> Tensor<1> {
    mean_where_given(focal(logits, truth), given, counts.masks)
}

/// Logits of rendered probabilities, for [`mask`]; beyond 1e-6 from 0 and 1 they have no gradient.
///
/// # Shapes
/// `[r, masks]`
pub fn logits_of(probabilities: Tensor<2>) -> Tensor<2> {
    let p = probabilities.clamp(1e-6, 1.0 - 1e-6);
    p.clone().log() - (p.neg() + 1.0).log()
}

/// L_attr (eq. 17): `(α − α_gt)² / 2β² + (ln β)² / 2`.
///
/// # Shapes
/// `alpha`, `truth`, `beta` (rendered), `given`: `[r, K]`
pub fn attribute(alpha: Tensor<2>, truth: Tensor<2>, beta: Tensor<2>, given: Tensor<2>, counts: Counts) -> Tensor<1> {
    // A ray that stays transparent renders less than the floor (fact sheet §8.4).
    let beta = beta.clamp_min(BETA_FLOOR);
    let ln_beta = beta.clone().log();
    let error = (alpha - truth) / beta;
    mean_where_given((error.powi_scalar(2) + ln_beta.powi_scalar(2)) * 0.5, given, counts.attributes)
}

/// L_attr of models without an uncertainty: `(α − α_gt)²`.
///
/// # Shapes
/// as [`attribute`]
pub fn plain_attribute(alpha: Tensor<2>, truth: Tensor<2>, given: Tensor<2>, counts: Counts) -> Tensor<1> {
    mean_where_given((alpha - truth).powi_scalar(2), given, counts.attributes)
}

/// L_lat.
///
/// # Shapes
/// `omega`: `[r, latent]`
pub fn latent(omega: Tensor<2>, counts: Counts) -> Tensor<1> {
    omega.powi_scalar(2).sum() / counts.rays
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
        // The last but one is where the released code clips, and what it gives beyond.
        for (p, y, expected) in [
            (0.9, 1.0, 0.001_665_90),
            (0.9, 0.0, 0.982_990_81),
            (0.5, 0.0, 0.122_532_27),
            (0.5, 0.7, 0.122_532_27),
            (0.5, 1.0, 0.122_532_27),
            (1e-4, 1.0, 4.604_479_43),
            (0.3, 0.4, 0.158_606_53),
        ] {
            let got = number(focal(one(logit(p), &device), one(y, &device)));
            assert!((got - expected).abs() < 2e-6, "p {p} y {y}: {got}");
            let back = number(focal(logits_of(one(p, &device)), one(y, &device)));
            assert!((back - expected).abs() < 1e-5, "p {p} y {y} from a probability: {back}");
        }
    }

    #[test]
    fn the_best_uncertainty_of_an_error_is_the_tables() {
        // Eq. 17 as printed is least at β² ln β = e² (fact sheet §8).
        let device = Device::flex();
        let counts = Counts { rays: 1.0, masks: 1.0, attributes: 1.0 };
        let loss = |e: f32, beta: f32| {
            let t = |v: f32| one(v, &device);
            number(attribute(t(e), t(0.0), t(beta), t(1.0), counts))
        };
        for (e, beta, least) in [
            (0.1, 1.009_854, 0.004_951),
            (0.5, 1.192_279, 0.103_398),
            (1.0, 1.531_584, 0.304_018),
            (2.0, 2.232_018, 0.723_782),
        ] {
            assert!((loss(e, beta) - least).abs() < 2e-6, "e {e}: {}", loss(e, beta));
            assert!(loss(e, beta * 0.99) > loss(e, beta) && loss(e, beta * 1.01) > loss(e, beta), "e {e}");
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
            let one = Counts { rays: 1.0, masks: 1.0, attributes: 1.0 };
            let got = number(attribute(t(e), t(0.0), t(beta), t(1.0), one));
            assert!((got - expected).abs() < 2e-6 * expected.max(1.0), "e {e} β {beta}: {got}");
            let none = Counts { attributes: 0.0, ..one };
            assert_eq!(number(attribute(t(e), t(0.0), t(beta), t(0.0), none)), 0.0);
        }
    }
}
