//! The three scales of an AU's strength, and the only place that converts between them.
//!
//! ```text
//! intensity    0–5        what coders and trackers give
//! attribute    −1..1      eq. 1 of the paper: min((I − I_min) / (s · I_max − I_min) · 2 − 1, 1)
//! activation   0, 1, …    (eq. 1 without its cap + 1) / 2: 0 is the least and 1 is 80 % of the most that the capture shows
//! ```

use serde::{Deserialize, Serialize};

use crate::AttributeSpec;

/// An AU's intensity, 0–5.
#[derive(Clone, Copy, Debug, Default, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Intensity(pub f32);

/// An AU's attribute, −1..1.
#[derive(Clone, Copy, Debug, Default, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Attribute(pub f32);

/// An AU's activation: 0 where it rests, 1 at 80 % of the capture's most; it may exceed 1.
#[derive(Clone, Copy, Debug, Default, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Activation(pub f32);

/// Activations below this are noise of the tracker and count as 0.
const LEAST_ACTIVATION: f32 = 0.02;

/// Converts between the scales of one AU of a capture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AuScale {
    least: f32,
    most: f32,
    /// Width of eq. 1's range, intensity.
    width: f32,
    neutral: f32,
    active: bool,
}

impl AuScale {
    /// The scale of an AU whose range was measured on a capture.
    pub fn new(spec: &AttributeSpec) -> Self {
        Self {
            least: spec.au_min,
            most: spec.au_max,
            width: spec.au_max_scale * spec.au_max - spec.au_min,
            neutral: spec.neutral,
            active: spec.active,
        }
    }

    /// Eq. 1 without its cap, and with the capture's most as its end. NaN for what does not move or is no number.
    fn uncapped(&self, intensity: Intensity) -> f32 {
        if !self.active || !intensity.0.is_finite() {
            return f32::NAN;
        }
        (intensity.0.min(self.most).max(self.least) - self.least) / self.width * 2.0 - 1.0
    }

    /// Eq. 1. AUs that never moved and intensities that are no number give −1.
    pub fn attribute(&self, intensity: Intensity) -> Attribute {
        let uncapped = self.uncapped(intensity);
        Attribute(if uncapped.is_nan() { -1.0 } else { uncapped.clamp(-1.0, 1.0) })
    }

    /// The activation. It goes on rising between 80 % of the capture's most and its most (to 1.25 for an AU that starts at
    /// 0), where eq. 1 is capped, so that the strongest expressions stay apart; it saturates there. AUs that never moved and
    /// intensities that are no number give 0.
    pub fn activation(&self, intensity: Intensity) -> Activation {
        significant((self.uncapped(intensity) + 1.0) * 0.5)
    }

    /// The activation of an attribute, for captures whose intensities are not known.
    pub fn activation_from_attribute(&self, attribute: Attribute) -> Activation {
        if !self.active {
            return Activation(0.0);
        }
        significant((attribute.0 + 1.0) * 0.5)
    }

    /// The inverse of eq. 1 inside its range. AUs that never moved give the neutral intensity.
    pub fn intensity(&self, attribute: Attribute) -> Intensity {
        if !self.active {
            return Intensity(self.neutral);
        }
        Intensity(self.least + (attribute.0.clamp(-1.0, 1.0) + 1.0) * 0.5 * self.width)
    }

    /// The intensity that stands in the range of `to` where `intensity` stands in this one: a driver's strongest smile
    /// becomes an avatar's strongest. Intensities beyond this range count as its ends.
    pub fn carried_to(&self, to: &Self, intensity: Intensity) -> Intensity {
        let share = (self.uncapped(intensity) + 1.0) * 0.5;
        if share.is_nan() || !to.active {
            return Intensity(to.neutral);
        }
        Intensity((to.least + share * to.width).min(to.most))
    }

    /// By how much an intensity lies above the most that the capture shows; `None` where it does not.
    pub fn excess(&self, intensity: Intensity) -> Option<f32> {
        let excess = intensity.0 - self.most;
        (self.active && excess > 0.0).then_some(excess)
    }

    /// The intensity of the capture's neutral face.
    pub fn neutral(&self) -> Intensity {
        Intensity(self.neutral)
    }

    /// The most that the capture shows.
    pub fn most(&self) -> Intensity {
        Intensity(self.most)
    }

    /// Whether the AU moved enough to be learned.
    pub fn is_active(&self) -> bool {
        self.active
    }
}

/// Floored at 0, and 0 for what is lost in noise.
fn significant(activation: f32) -> Activation {
    Activation(if activation >= LEAST_ACTIVATION { activation } else { 0.0 })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::ActionUnit;
    use crate::attribute::AU_MAX_SCALE;

    fn scale(au_min: f32, au_max: f32) -> AuScale {
        AuScale::new(&AttributeSpec::from_range(ActionUnit(12), 2, au_min, au_max, au_min))
    }

    #[test]
    fn eq_1_matches_the_check_values() {
        for (au, lo, hi, expected) in
            [(2.0, 0.0, 5.0, 0.0), (4.0, 0.0, 5.0, 1.0), (4.5, 0.0, 5.0, 1.0), (1.2, 0.3, 3.1, -0.174_311_93)]
        {
            let got = scale(lo, hi).attribute(Intensity(au)).0;
            assert!((got - expected).abs() < 1e-6, "{au} in {lo}..{hi}: {got}");
        }
    }

    #[test]
    fn an_au_that_never_moves_rests() {
        for (lo, hi) in [(0.0, 0.0), (2.0, 2.2), (0.0, 0.12)] {
            let s = scale(lo, hi);
            assert!(!s.is_active());
            assert_eq!(s.attribute(Intensity(3.0)), Attribute(-1.0));
            assert_eq!(s.activation(Intensity(3.0)), Activation(0.0));
            assert_eq!(s.activation_from_attribute(Attribute(1.0)), Activation(0.0));
            assert_eq!(s.intensity(Attribute(0.3)), s.neutral());
        }
    }

    #[test]
    fn what_is_no_number_rests() {
        let s = scale(0.0, 5.0);
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            assert_eq!((s.attribute(Intensity(bad)), s.activation(Intensity(bad))), (Attribute(-1.0), Activation(0.0)));
        }
        assert_eq!(s.activation_from_attribute(Attribute(f32::NAN)), Activation(0.0));
    }

    #[test]
    fn strong_expressions_stay_apart_and_saturate() {
        let s = scale(0.0, 5.0);
        for (au, expected) in
            [(0.0, 0.0), (0.05, 0.0), (2.0, 0.5), (4.0, 1.0), (4.5, 1.125), (5.0, 1.25), (9.0, 1.25), (-1.0, 0.0)]
        {
            assert!((s.activation(Intensity(au)).0 - expected).abs() < 1e-6, "{au}");
        }
        assert_eq!(s.excess(Intensity(5.5)), Some(0.5));
        assert_eq!(s.excess(Intensity(5.0)), None);
    }

    #[test]
    fn a_driver_s_most_becomes_the_avatar_s_most() {
        let (driver, avatar) = (scale(0.0, 2.0), scale(0.5, 4.5));
        for (from, to) in [(0.0, 0.5), (1.6, 3.6), (2.0, 4.375), (9.0, 4.375)] {
            let got = driver.carried_to(&avatar, Intensity(from)).0;
            assert!((got - to).abs() < 1e-5, "{from}: {got}");
        }
    }

    proptest! {
        #[test]
        fn the_inverse_undoes_eq_1_inside_the_range(lo in 0f32..1.0, width in 0.2f32..4.0, t in 0f32..1.0) {
            let s = scale(lo, (lo + width) / AU_MAX_SCALE);
            let au = lo + t * width;
            prop_assert!((s.intensity(s.attribute(Intensity(au))).0 - au).abs() < 1e-4);
            let by_attribute = s.activation_from_attribute(s.attribute(Intensity(au))).0;
            prop_assert!((by_attribute - s.activation(Intensity(au)).0).abs() < 1e-5 || by_attribute < 0.03);
        }
    }
}
