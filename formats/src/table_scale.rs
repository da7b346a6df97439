//! The scale of a table's AU values: 0–5 (FACS intensities), 0–1 (probabilities, ARKit), 0–100 (percent), or none at all.
//!
//! Values say which one it is. Above 5 they are percent. Confidences or presences above 1 beside them are the mark of a
//! spreadsheet that took decimal points for separators of thousands: 1.25 became 125, and what is lost stays lost. That
//! nothing exceeds 1 may be a calm face, or a table of 0–1: several AUs that come near 1 decide.

use std::str::FromStr;

use crate::au::MAX_INTENSITY;
use crate::{ErrorKind, FormatError, Result};

/// Values above this are percent, and not what a killed run leaves.
const MOST_STRAY: f32 = 10.0;
/// As long as fewer values than one in this many are above 5, these are strays.
const STRAYS: u64 = 100;
/// So many AUs that come near 1, and none above it, are a table of 0–1.
const NEAR_ONE: f32 = 0.8;
const SEVERAL: usize = 4;
/// Tables of fewer rows say nothing about it.
const LEAST_ROWS: u64 = 20;
/// Confidences and presences above this are no shares.
const MOST_SHARE: f32 = 1.5;

/// The largest value of a scale of AU values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TableScale {
    /// 0–1.
    One,
    /// 0–5, as OpenFace has it.
    Five,
    /// 0–100.
    Hundred,
}

impl TableScale {
    /// What makes an intensity 0–5 of a value.
    pub fn factor(self) -> f32 {
        match self {
            Self::One => MAX_INTENSITY,
            Self::Five => 1.0,
            Self::Hundred => MAX_INTENSITY / 100.0,
        }
    }

    /// The largest value, for messages.
    pub fn largest(self) -> u32 {
        match self {
            Self::One => 1,
            Self::Five => 5,
            Self::Hundred => 100,
        }
    }
}

impl FromStr for TableScale {
    type Err = FormatError;

    /// Reads the largest value: `1`, `5` or `100`.
    fn from_str(text: &str) -> Result<Self> {
        let known = [Self::One, Self::Five, Self::Hundred];
        let found = known.into_iter().find(|s| s.largest().to_string() == text.trim());
        found.ok_or_else(|| FormatError::syntax(format!("`{text}` is no scale of AUs, expected 1, 5 or 100")))
    }
}

/// What the values of a table come to.
#[derive(Clone, Debug, Default)]
pub(crate) struct Values {
    /// The largest value of each AU.
    pub(crate) largest: Vec<f32>,
    /// All values, and those above 5.
    pub(crate) count: u64,
    pub(crate) above_5: u64,
    /// The largest confidence and presence, where the table has them.
    pub(crate) confidence: f32,
    pub(crate) presence: f32,
}

/// What the scale of a table is taken for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Judged {
    /// It is 0–5 beyond doubt, or as far as anyone can tell.
    Plain,
    /// It is another one.
    Other(TableScale),
    /// No value exceeds 1, which may be a calm face or a table of 0–1.
    Small,
}

impl Values {
    /// Counts a value of the AU in column `unit`.
    pub(crate) fn add(&mut self, unit: usize, value: f32) {
        if self.largest.len() <= unit {
            self.largest.resize(unit + 1, 0.0);
        }
        self.largest[unit] = self.largest[unit].max(value);
        self.count += 1;
        self.above_5 += u64::from(value > MAX_INTENSITY);
    }

    /// The largest value of all.
    pub(crate) fn most(&self) -> f32 {
        self.largest.iter().copied().fold(0.0, f32::max)
    }

    /// The scale of the values; an error for a table whose decimal points are lost.
    pub(crate) fn judge(&self) -> Result<Judged> {
        let most = self.most();
        let many = most > MOST_STRAY && self.above_5 * STRAYS >= self.count;
        let beside = self.confidence.max(self.presence) > MOST_SHARE;
        if (many && (beside || most > 100.0)) || self.presence > MOST_SHARE {
            return Err(self.lost_points());
        }
        if many {
            return Ok(Judged::Other(TableScale::Hundred));
        }
        let rows = self.count / self.largest.len().max(1) as u64;
        if !(most > 0.0 && most <= 1.0) || rows < LEAST_ROWS {
            return Ok(Judged::Plain);
        }
        let near = self.largest.iter().filter(|v| **v >= NEAR_ONE).count();
        Ok(if near >= SEVERAL { Judged::Other(TableScale::One) } else { Judged::Small })
    }

    fn lost_points(&self) -> FormatError {
        let mut found = vec![format!("intensities up to {}", self.most())];
        if self.confidence > MOST_SHARE {
            found.push(format!("confidence {}", self.confidence));
        } else if self.presence > MOST_SHARE {
            found.push(format!("presence {}", self.presence));
        }
        let message = format!("{}: the decimal points were lost in a spreadsheet", found.join(", "));
        FormatError::new(ErrorKind::Inconsistent, message)
            .with_hint("use the file that OpenFace wrote; a spreadsheet with decimal commas must import it with `.` as the decimal mark, not open it")
    }
}

/// What to say about a table whose scale was converted.
pub(crate) fn converted(scale: TableScale, most: f32) -> String {
    format!(
        "AU values reach {most}: taken as a 0–{} scale and multiplied by {} to intensities 0–5",
        scale.largest(),
        scale.factor()
    )
}

/// What to say about a table that may be of 0–1. `option` sets the scale.
pub(crate) fn small(most: f32, option: &str) -> String {
    format!(
        "no AU value exceeds {most}: a calm face, or a table of 0–1? `{option} 1` multiplies it by 5, `{option} 5` says that it is right"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn values(all: &[f32]) -> Values {
        let mut values = Values { confidence: 0.98, presence: 1.0, ..Values::default() };
        for _ in 0..LEAST_ROWS {
            all.iter().enumerate().for_each(|(unit, v)| values.add(unit, *v));
        }
        values
    }

    #[test]
    fn the_values_tell_their_scale() {
        let judge = |all: &[f32]| values(all).judge().unwrap();
        assert_eq!(judge(&[0.2, 3.0, 4.9]), Judged::Plain);
        // What a killed run of OpenFace leaves.
        assert_eq!(judge(&[0.2, 7.0, 5.1]), Judged::Plain);
        assert_eq!(judge(&[20.0, 70.0, 12.0]), Judged::Other(TableScale::Hundred));
        assert_eq!(judge(&[0.85, 0.9, 1.0, 0.99, 0.1]), Judged::Other(TableScale::One));
        assert_eq!(judge(&[0.9, 0.3, 0.1]), Judged::Small);
        assert_eq!(judge(&[0.0, 0.0]), Judged::Plain);
        // One stray value among many is no scale, and a picture or two are no table of 0–1.
        let mut many = vec![1.0; 500];
        many.push(80.0);
        assert_eq!(judge(&many), Judged::Plain);
        let mut short = Values::default();
        (0..9).for_each(|unit| short.add(unit, 0.95));
        assert_eq!(short.judge().unwrap(), Judged::Plain);
    }

    #[test]
    fn lost_decimal_points_are_refused() {
        let damaged = Values { confidence: 98.0, ..values(&[125.0, 454.0, 3.0]) };
        let text = damaged.judge().unwrap_err().to_string();
        assert!(text.contains("intensities up to 454, confidence 98") && text.contains("decimal points"), "{text}");
        assert!(values(&[125.0, 454.0]).judge().is_err());
        assert!(Values { presence: 100.0, ..values(&[2.0, 1.0]) }.judge().is_err());
    }
}
