//! Whether a track is worth going on with: is there a face, and does it move?

use risorius_console::Failure;
use risorius_formats::openface::{self, ReadOptions};
use risorius_formats::{ActionUnit, Silent, Take};
use risorius_tracker::import::MIN_CONFIDENCE;
use risorius_tracker::quality::{self, TrackQuality};
use serde::{Deserialize, Serialize};

/// An AU whose intensities span this much is an expression; below it, noise and speech look alike. 0–5 scale.
const EXPRESSION_RANGE: f32 = 1.0;
/// Fewer AUs than this make a poor avatar.
const FEW_AUS: usize = 4;
/// Below this share of frames with a face a word is due.
const LOW_SHARE: f64 = 0.8;

/// What one AU did in the video.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct AuCoverage {
    pub(super) unit: String,
    pub(super) name: String,
    /// Intensities, 0–5.
    pub(super) min: f32,
    pub(super) max: f32,
    /// Whether it moves at all (0.1 or more).
    pub(super) moves: bool,
    /// Whether it spans an expression (1 or more).
    pub(super) is_covered: bool,
}

/// The face in a take.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct FaceCoverage {
    pub(super) frames: usize,
    pub(super) frames_with_face: usize,
    pub(super) units: Vec<AuCoverage>,
}

impl FaceCoverage {
    /// Reads the track of a take.
    pub(super) fn of(take: &Take) -> Result<Self, Failure> {
        let track = openface::read(take.openface_path(), &ReadOptions::default(), &Silent)?;
        Ok(Self::from(&quality::measure(&track, take.frames.len(), MIN_CONFIDENCE)))
    }

    pub(super) fn covered(&self) -> impl Iterator<Item = &AuCoverage> {
        self.units.iter().filter(|u| u.is_covered)
    }

    /// Stops where nothing can come of it; otherwise what to know.
    pub(super) fn judge(&self, what: &str) -> Result<Vec<String>, Failure> {
        if self.frames_with_face == 0 {
            return Err(Failure::input(format!("{what}: no face was found in any of its {} frames", self.frames))
                .with_hint(
                    "the video has to show one face, upright, well lit and at least an eighth of the picture high; \
                     `risorius capture record --rotate 90` turns a clip that lies on its side",
                ));
        }
        if !self.units.is_empty() && self.units.iter().all(|u| !u.moves) {
            return Err(Failure::input(format!(
                "{what}: the face does not move: none of its {} AUs changes",
                self.units.len()
            ))
            .with_hint(
                "an avatar learns expressions from a video that shows them: smile, raise and lower the brows, open \
                     the mouth, close the eyes, each some times; `risorius capture record --device ID --script au` \
                     leads through them",
            ));
        }
        let mut words = Vec::new();
        let share = self.frames_with_face as f64 / self.frames.max(1) as f64;
        if share < LOW_SHARE {
            words.push(format!(
                "The face was found in only {:.0} % of the frames; the others are not used.",
                100.0 * share
            ));
        }
        let covered: Vec<&str> = self.covered().map(|u| u.unit.as_str()).collect();
        if covered.len() < FEW_AUS {
            let list = if covered.is_empty() {
                "no AU changes".to_owned()
            } else {
                format!("only {} change", covered.join(", "))
            };
            words.push(format!(
                "There is little expression: {list} by 1 or more of 5. An avatar can show only what the video shows; film a \
                 livelier face for more."
            ));
        }
        let still: Vec<&str> = self.units.iter().filter(|u| !u.moves).map(|u| u.unit.as_str()).collect();
        if !still.is_empty() {
            words.push(format!("These AUs never move, and the avatar cannot show them: {}.", still.join(", ")));
        }
        Ok(words)
    }
}

impl From<&TrackQuality> for FaceCoverage {
    fn from(q: &TrackQuality) -> Self {
        let of = |unit: ActionUnit, min: Option<f32>, max: Option<f32>, moves: bool| {
            let (min, max) = (min?, max?);
            let is_covered = max - min >= EXPRESSION_RANGE;
            let (unit, name) = (unit.to_string(), unit.facs_name().to_owned());
            Some(AuCoverage { unit, name, min, max, moves, is_covered })
        };
        Self {
            frames: q.frames,
            frames_with_face: q.valid_frames,
            units: q.units.iter().filter_map(|u| of(u.unit, u.min, u.max, u.moves)).collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn coverage(ranges: &[f32], with_face: usize) -> FaceCoverage {
        let unit = |(i, &max): (usize, &f32)| AuCoverage {
            unit: format!("AU{:02}", i + 1),
            name: String::new(),
            min: 0.0,
            max,
            moves: max >= 0.1,
            is_covered: max >= EXPRESSION_RANGE,
        };
        FaceCoverage { frames: 100, frames_with_face: with_face, units: ranges.iter().enumerate().map(unit).collect() }
    }

    #[test]
    fn no_face_and_a_still_face_stop_the_work() {
        let stop = |c: FaceCoverage| c.judge("a.mp4").unwrap_err().message().to_owned();
        assert_eq!(stop(coverage(&[], 0)), "a.mp4: no face was found in any of its 100 frames");
        assert!(stop(coverage(&[0.0, 0.05], 100)).contains("does not move"));
    }

    #[test]
    fn little_expression_and_lost_frames_are_warnings() {
        assert!(coverage(&[2.0; 17], 100).judge("a").unwrap().is_empty());
        let words = coverage(&[2.0, 0.5, 0.0], 50).judge("a").unwrap().join(" ");
        assert!(words.contains("50 %") && words.contains("only AU01 change") && words.contains("AU03"), "{words}");
    }
}
