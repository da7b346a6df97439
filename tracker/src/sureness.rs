//! How sure the curve of an AU is, in words, and what to do about it.
//!
//! The thresholds on the mean confidence are chosen on the development clips: see `docs/tracking.md`.

use serde::Serialize;

use crate::quality::UnitRange;

/// Mean confidence from which an AU is sure.
pub const SURE_FROM: f32 = 0.5;
/// Mean confidence from which an AU is fairly sure.
pub const FAIRLY_SURE_FROM: f32 = 0.3;
/// An AU whose 99th percentile stays below this intensity hardly moves: there is nothing to judge it by.
pub const MOVES_FROM: f32 = 0.5;
/// More saturated frames than this share are too many.
const SATURATED: f32 = 0.03;
/// An AU whose median is above this intensity has no rest in the take, or a wrong one.
const RESTS_BELOW: f32 = 1.0;

/// How sure an AU is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Sureness {
    /// Do not build on it.
    NotSure,
    /// Look at its peaks before you build on it.
    FairlySure,
    /// Build on it.
    Sure,
}

impl Sureness {
    /// Of a mean confidence, 0–1.
    pub fn of(confidence: f32) -> Self {
        if confidence >= SURE_FROM {
            Self::Sure
        } else if confidence >= FAIRLY_SURE_FROM {
            Self::FairlySure
        } else {
            Self::NotSure
        }
    }

    /// In words.
    pub fn word(self) -> &'static str {
        match self {
            Self::NotSure => "not sure",
            Self::FairlySure => "fairly sure",
            Self::Sure => "sure",
        }
    }
}

/// What to do about an AU, one sentence or two; empty where there is nothing to do.
pub fn advice(unit: &UnitRange) -> String {
    let Some(median) = unit.median else {
        return "Not known: the models in use do not give it.".to_owned();
    };
    let mut lines: Vec<String> = Vec::new();
    if unit.saturated_share > SATURATED {
        lines.push(format!(
            "It stands at the end of the scale in {:.0} % of the frames: trust the order of the frames, not the level.",
            100.0 * unit.saturated_share
        ));
    }
    if median > RESTS_BELOW {
        lines.push("It stands above 1 half of the time: show a resting face for most of the take.".to_owned());
    }
    if hardly_moves(unit) {
        lines.push("It hardly moves in this take: show it on purpose, or leave it out.".to_owned());
    } else {
        match unit.sureness {
            Some(Sureness::NotSure) => lines.push(
                "Its two readouts disagree or it is hard to see: do not steer by it before its peaks look right; a larger, sharper, evenly lit face helps."
                    .to_owned(),
            ),
            Some(Sureness::FairlySure) => lines.push("Look at its peaks before you build on it.".to_owned()),
            Some(Sureness::Sure) | None => {}
        }
    }
    lines.join(" ")
}

/// The AUs that move and are not sure, in one line; `None` where there are none.
pub fn not_sure(units: &[UnitRange]) -> Option<String> {
    listed(units.iter().filter(|u| u.sureness == Some(Sureness::NotSure) && !hardly_moves(u)))
}

/// The AUs that hardly move, in one line; `None` where there are none.
pub fn still(units: &[UnitRange]) -> Option<String> {
    listed(units.iter().filter(|u| hardly_moves(u)))
}

/// Whether an AU is known and moves too little to be judged.
fn hardly_moves(unit: &UnitRange) -> bool {
    unit.p99.is_some_and(|p| p < MOVES_FROM)
}

fn listed<'a>(units: impl Iterator<Item = &'a UnitRange>) -> Option<String> {
    let names: Vec<String> = units.map(|u| u.unit.to_string()).collect();
    (!names.is_empty()).then(|| names.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;
    use risorius_formats::ActionUnit;

    fn unit(median: f32, p99: f32, confidence: f32) -> UnitRange {
        UnitRange {
            unit: ActionUnit(12),
            min: Some(0.0),
            median: Some(median),
            p99: Some(p99),
            max: Some(p99),
            saturated_share: 0.0,
            confidence: Some(confidence),
            sureness: Some(Sureness::of(confidence)),
            moves: true,
        }
    }

    #[test]
    fn advice_names_the_cause() {
        assert_eq!(advice(&unit(0.1, 3.0, 0.8)), "");
        assert!(advice(&unit(0.1, 3.0, 0.1)).contains("disagree"));
        assert!(advice(&unit(0.1, 0.2, 0.1)).contains("hardly moves"));
        assert!(advice(&unit(1.5, 3.0, 0.8)).contains("resting face"));
        assert!(advice(&UnitRange { saturated_share: 0.12, ..unit(0.1, 5.0, 0.4) }).contains("12 %"));
        assert!(advice(&UnitRange { median: None, ..unit(0.1, 5.0, 0.4) }).contains("Not known"));
    }

    #[test]
    fn only_those_that_are_not_sure_are_listed() {
        assert_eq!(not_sure(&[unit(0.0, 1.0, 0.1), unit(0.0, 1.0, 0.9)]).as_deref(), Some("AU12"));
        assert_eq!(not_sure(&[unit(0.0, 1.0, 0.9), unit(0.0, 0.2, 0.1)]), None);
        assert_eq!(still(&[unit(0.0, 1.0, 0.9), unit(0.0, 0.2, 0.1)]).as_deref(), Some("AU12"));
    }
}
