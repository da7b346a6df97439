//! Facial action units (FACS) and their scales. Which AUs a table holds is data; 17 is not hard-wired.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::FormatError;

/// A FACS action unit by its number; shown as `AU04`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct ActionUnit(pub u8);

/// The 17 intensities of an OpenFace table, in its order.
pub const OPENFACE_INTENSITIES: [ActionUnit; 17] = [
    ActionUnit(1),
    ActionUnit(2),
    ActionUnit(4),
    ActionUnit(5),
    ActionUnit(6),
    ActionUnit(7),
    ActionUnit(9),
    ActionUnit(10),
    ActionUnit(12),
    ActionUnit(14),
    ActionUnit(15),
    ActionUnit(17),
    ActionUnit(20),
    ActionUnit(23),
    ActionUnit(25),
    ActionUnit(26),
    ActionUnit(45),
];

/// The largest intensity of the 0–5 scale (FACS A–E).
pub const MAX_INTENSITY: f32 = 5.0;

impl ActionUnit {
    /// The FACS name, such as `lip corner puller`.
    pub fn facs_name(self) -> &'static str {
        match self.0 {
            1 => "inner brow raiser",
            2 => "outer brow raiser",
            4 => "brow lowerer",
            5 => "upper lid raiser",
            6 => "cheek raiser",
            7 => "lid tightener",
            9 => "nose wrinkler",
            10 => "upper lip raiser",
            11 => "nasolabial deepener",
            12 => "lip corner puller",
            13 => "sharp lip puller",
            14 => "dimpler",
            15 => "lip corner depressor",
            16 => "lower lip depressor",
            17 => "chin raiser",
            18 => "lip pucker",
            20 => "lip stretcher",
            22 => "lip funneler",
            23 => "lip tightener",
            24 => "lip pressor",
            25 => "lips part",
            26 => "jaw drop",
            27 => "mouth stretch",
            28 => "lip suck",
            43 => "eyes closed",
            45 => "blink",
            _ => "action unit",
        }
    }
}

impl fmt::Display for ActionUnit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "AU{:02}", self.0)
    }
}

impl FromStr for ActionUnit {
    type Err = FormatError;

    /// Reads `AU4`, `AU04`, `au04` or `04`.
    fn from_str(text: &str) -> Result<Self, FormatError> {
        let digits = text.strip_prefix("AU").or_else(|| text.strip_prefix("au")).unwrap_or(text);
        match digits.parse::<u8>() {
            Ok(n) if n > 0 && digits.len() <= 2 && digits.bytes().all(|b| b.is_ascii_digit()) => Ok(Self(n)),
            _ => Err(FormatError::syntax(format!("`{text}` is not an action unit")).with_hint("write it like `AU12`")),
        }
    }
}

impl TryFrom<String> for ActionUnit {
    type Error = FormatError;
    fn try_from(text: String) -> Result<Self, FormatError> {
        text.parse()
    }
}

impl From<ActionUnit> for String {
    fn from(unit: ActionUnit) -> Self {
        unit.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_read_and_print() {
        for text in ["AU4", "AU04", "au04", "4"] {
            assert_eq!(text.parse::<ActionUnit>().unwrap(), ActionUnit(4), "{text}");
        }
        assert_eq!(ActionUnit(4).to_string(), "AU04");
        for text in ["", "AU", "AU+4", "AU004", "AU0", "A12", "AU12_r"] {
            assert!(text.parse::<ActionUnit>().is_err(), "{text}");
        }
    }
}
