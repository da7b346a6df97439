//! Expressions with names: the AUs of prototypical expressions of emotion (Ekman and Friesen's prototypes, without the
//! AUs that OpenFace tables do not have).

use std::collections::BTreeMap;

use risorius_formats::ActionUnit;
use serde::Serialize;

/// A named expression.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Preset {
    /// What people call it.
    pub name: &'static str,
    /// AU numbers with intensities 0–5.
    pub aus: &'static [(u8, f32)],
}

/// The presets in the order of their keys in the viewer, the resting face first.
pub const PRESETS: [Preset; 10] = [
    Preset { name: "neutral", aus: &[] },
    Preset { name: "smile", aus: &[(6, 3.0), (12, 4.0)] },
    Preset { name: "surprise", aus: &[(1, 4.0), (2, 4.0), (5, 3.0), (25, 3.0), (26, 3.5)] },
    Preset { name: "sadness", aus: &[(1, 3.5), (4, 2.0), (15, 3.5), (17, 1.5)] },
    Preset { name: "anger", aus: &[(4, 4.0), (5, 2.0), (7, 3.5), (23, 3.0)] },
    Preset { name: "fear", aus: &[(1, 3.5), (2, 2.5), (4, 2.0), (5, 4.0), (7, 1.5), (20, 3.5), (25, 2.0), (26, 1.5)] },
    Preset { name: "disgust", aus: &[(9, 4.0), (10, 2.5), (15, 1.5), (17, 2.0)] },
    Preset { name: "contempt", aus: &[(12, 1.0), (14, 4.0)] },
    Preset { name: "eyes closed", aus: &[(45, 5.0)] },
    Preset { name: "open mouth", aus: &[(25, 4.0), (26, 5.0)] },
];

impl Preset {
    /// The preset's intensities by AU.
    pub fn intensities(&self) -> BTreeMap<ActionUnit, f32> {
        self.aus.iter().map(|&(unit, value)| (ActionUnit(unit), value)).collect()
    }

    /// The preset of a name, case apart.
    pub fn named(name: &str) -> Option<&'static Self> {
        PRESETS.iter().find(|p| p.name.eq_ignore_ascii_case(name))
    }
}

#[cfg(test)]
mod tests {
    use risorius_formats::au::OPENFACE_INTENSITIES;

    use super::*;

    #[test]
    fn presets_use_known_aus_in_range() {
        for preset in &PRESETS {
            for (unit, value) in preset.intensities() {
                assert!(OPENFACE_INTENSITIES.contains(&unit), "{} of {}", unit, preset.name);
                assert!((0.0..=5.0).contains(&value));
            }
        }
        assert!(Preset::named("Smile").is_some() && Preset::named("grin").is_none());
    }
}
