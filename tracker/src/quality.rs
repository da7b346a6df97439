//! How good a track is: lost runs, ranges of AUs, noise of landmarks.

use risorius_formats::au::OPENFACE_INTENSITIES;
use risorius_formats::{ActionUnit, Track, TrackRow};
use serde::Serialize;

use crate::aus::UNITS;
use crate::poses::triangulate::median;
use crate::sureness::Sureness;

/// An AU that moves less than this over a whole take says nothing, 0–5 scale.
pub const STILL_AU_RANGE: f32 = 0.1;
/// From this intensity on an AU stands at the end of its scale.
pub const SATURATED_FROM: f32 = 4.9;

/// What one AU did in a take.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct UnitRange {
    /// The action unit.
    pub unit: ActionUnit,
    /// Smallest intensity over the valid frames, 0–5; `None` where no valid row has a value.
    pub min: Option<f32>,
    /// Median intensity.
    pub median: Option<f32>,
    /// 99th percentile of the intensity.
    pub p99: Option<f32>,
    /// Largest intensity.
    pub max: Option<f32>,
    /// Share of the valid frames with an intensity of [`SATURATED_FROM`] or more, 0–1.
    pub saturated_share: f32,
    /// Mean confidence over the valid frames, 0–1; `None` where the AUs do not come from the tracker's own readout.
    pub confidence: Option<f32>,
    /// The confidence in words.
    pub sureness: Option<Sureness>,
    /// Whether it moves at all (by [`STILL_AU_RANGE`] or more).
    pub moves: bool,
}

/// The quality of a track.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TrackQuality {
    /// Frames of the take.
    pub frames: usize,
    /// Frames with a trustworthy row.
    pub valid_frames: usize,
    /// The rest.
    pub lost_frames: usize,
    /// The rest as inclusive runs.
    pub lost_runs: Vec<[u32; 2]>,
    /// Range of each AU.
    pub units: Vec<UnitRange>,
    /// Share of the valid frames in which any AU stands at [`SATURATED_FROM`] or more, 0–1.
    pub saturated_share: f32,
    /// AUs that never move.
    pub still_units: Vec<ActionUnit>,
    /// Noise of a landmark coordinate (standard deviation), pixels: from second differences over neighbouring frames, in
    /// which even motion cancels. `None` without landmarks in three neighbouring frames.
    pub landmark_jitter_px: Option<f64>,
    /// The same for AU intensities, 0–5 scale.
    pub au_jitter: Option<f64>,
    /// Median distance of the outer eye corners, pixels: the size of the face.
    pub outer_eye_distance_px: Option<f64>,
}

/// Measures `track`, whose rows belong to a take of `frames` frames.
pub fn measure(track: &Track, frames: usize, min_confidence: f32) -> TrackQuality {
    let mut by_frame: Vec<Option<&TrackRow>> = vec![None; frames];
    for row in &track.rows {
        if let Some(slot) = by_frame.get_mut(row.frame.0 as usize)
            && row.is_valid(min_confidence)
        {
            slot.get_or_insert(row);
        }
    }
    let valid_frames = by_frame.iter().flatten().count();
    let units: Vec<UnitRange> =
        track.units.iter().enumerate().map(|(k, &unit)| unit_range(unit, k, &by_frame)).collect();
    let is_saturated = |row: &TrackRow| row.intensities.iter().flatten().any(|v| *v >= SATURATED_FROM);
    let saturated = by_frame.iter().flatten().filter(|r| is_saturated(r)).count();
    let still_units = units.iter().filter(|u| !u.moves).map(|u| u.unit).collect();
    let mut eye: Vec<f64> = by_frame
        .iter()
        .flatten()
        .filter_map(|r| r.landmarks.as_ref().map(|l| f64::from(l.outer_eye_distance_px())))
        .collect();
    let landmark = |row: &TrackRow, i: usize| row.landmarks.as_ref().map(|l| l.points_px[i / 2][i % 2]);
    let intensity = |row: &TrackRow, i: usize| row.intensities[i];
    TrackQuality {
        frames,
        valid_frames,
        lost_frames: frames - valid_frames,
        lost_runs: runs(by_frame.iter().enumerate().filter(|(_, r)| r.is_none()).map(|(i, _)| i as u32)),
        units,
        saturated_share: saturated as f32 / valid_frames.max(1) as f32,
        still_units,
        landmark_jitter_px: jitter(&by_frame, 136, &landmark),
        au_jitter: jitter(&by_frame, track.units.len(), &intensity),
        outer_eye_distance_px: median(&mut eye),
    }
}

impl TrackQuality {
    /// Adds the mean confidences of AUs; those that are not in `confidences` stay unknown.
    pub fn add_confidences(&mut self, confidences: &[(ActionUnit, f32)]) {
        for unit in &mut self.units {
            unit.confidence = confidences.iter().find(|(u, _)| *u == unit.unit).map(|(_, c)| *c);
            unit.sureness = unit.confidence.map(Sureness::of);
        }
    }
}

/// Measures a track that passes by row by row, without keeping all of it.
#[derive(Debug)]
pub struct QualityMeter {
    slim: Track,
    frames: usize,
    /// Sums of the confidences, and of how many rows.
    confidences: ([f64; UNITS], usize),
}

impl QualityMeter {
    /// A meter for a take of `frames` frames.
    pub fn new(units: &[ActionUnit], frames: usize) -> Self {
        let slim = Track { units: units.to_vec(), ..Track::default() };
        Self { slim, frames, confidences: ([0.0; UNITS], 0) }
    }

    /// Takes the next row: its AUs, and of the landmarks, which are a hundred times as many, a run of 8 frames in 64.
    /// `confidences` are those of [`OPENFACE_INTENSITIES`].
    pub fn push(&mut self, row: &TrackRow, confidences: Option<&[f32; UNITS]>) {
        if let Some(confidences) = confidences.filter(|_| row.success) {
            let (sums, rows) = &mut self.confidences;
            sums.iter_mut().zip(confidences).for_each(|(sum, c)| *sum += f64::from(*c));
            *rows += 1;
        }
        let landmarks = row.landmarks.clone().filter(|_| row.frame.0 % 64 < 8);
        self.slim.rows.push(TrackRow {
            intensities: row.intensities.clone(),
            presences: Vec::new(),
            landmarks,
            landmarks_in_camera_mm: None,
            ..*row
        });
    }

    /// The quality of what passed by.
    pub fn finish(self) -> TrackQuality {
        let mut quality = measure(&self.slim, self.frames, 0.0);
        let (sums, rows) = self.confidences;
        if rows > 0 {
            let means = OPENFACE_INTENSITIES.iter().zip(sums).map(|(u, sum)| (*u, (sum / rows as f64) as f32));
            quality.add_confidences(&means.collect::<Vec<_>>());
        }
        quality
    }
}

fn unit_range(unit: ActionUnit, k: usize, by_frame: &[Option<&TrackRow>]) -> UnitRange {
    let mut values: Vec<f64> = by_frame.iter().flatten().filter_map(|r| r.intensities[k].map(f64::from)).collect();
    let min = values.iter().copied().reduce(f64::min).map(|v| v as f32);
    let max = values.iter().copied().reduce(f64::max).map(|v| v as f32);
    let moves = min.zip(max).is_some_and(|(lo, hi)| hi - lo >= STILL_AU_RANGE);
    let saturated = values.iter().filter(|v| **v >= f64::from(SATURATED_FROM)).count();
    let at = values.len() * 99 / 100;
    let p99 = (at < values.len()).then(|| *values.select_nth_unstable_by(at, f64::total_cmp).1 as f32);
    let saturated_share = saturated as f32 / values.len().max(1) as f32;
    let median = median(&mut values).map(|v| v as f32);
    UnitRange { unit, min, median, p99, max, saturated_share, confidence: None, sureness: None, moves }
}

/// White noise of deviation σ has second differences of deviation σ√6; 0.6745 σ is the median of its absolute value.
fn jitter(
    by_frame: &[Option<&TrackRow>],
    channels: usize,
    value: &dyn Fn(&TrackRow, usize) -> Option<f32>,
) -> Option<f64> {
    let mut differences = Vec::new();
    for window in by_frame.windows(3) {
        let [Some(a), Some(b), Some(c)] = window else { continue };
        for i in 0..channels {
            if let (Some(a), Some(b), Some(c)) = (value(a, i), value(b, i), value(c, i)) {
                // Exact zeros are AUs clamped at rest, not a noiseless sensor.
                let d = f64::from(a) - 2.0 * f64::from(b) + f64::from(c);
                if d != 0.0 {
                    differences.push(d.abs());
                }
            }
        }
    }
    median(&mut differences).map(|m| m / 0.6745 / 6f64.sqrt())
}

/// Ascending numbers as inclusive runs.
pub(crate) fn runs(frames: impl IntoIterator<Item = u32>) -> Vec<[u32; 2]> {
    let mut runs: Vec<[u32; 2]> = Vec::new();
    for frame in frames {
        match runs.last_mut() {
            Some(run) if run[1] + 1 == frame => run[1] = frame,
            _ => runs.push([frame, frame]),
        }
    }
    runs
}

#[cfg(test)]
mod tests {
    use super::*;
    use risorius_formats::{FrameIndex, Landmarks68};

    #[test]
    fn runs_join_neighbours() {
        assert_eq!(runs([0, 1, 2, 5, 7, 8]), [[0, 2], [5, 5], [7, 8]]);
        assert!(runs([]).is_empty());
    }

    fn track(noise: impl Fn(u32, usize) -> f32) -> Track {
        let row = |i: u32| TrackRow {
            frame: FrameIndex(i),
            face_id: 0,
            timestamp_secs: None,
            confidence: 0.95,
            success: i % 10 != 9,
            intensities: vec![Some(1.0), Some(0.01 * i as f32)],
            presences: vec![],
            landmarks: Some(Box::new(Landmarks68 {
                points_px: std::array::from_fn(|k| [100.0 + i as f32 + noise(i, 2 * k), 50.0 + noise(i, 2 * k + 1)]),
            })),
            landmarks_in_camera_mm: None,
            head_pose: None,
        };
        Track { units: vec![ActionUnit(6), ActionUnit(12)], presence_units: vec![], rows: (0..200).map(row).collect() }
    }

    #[test]
    fn the_noise_that_was_added_is_measured_and_steady_motion_is_not() {
        // Twelve uniforms make a normal deviate.
        let uniform = |n: u64| {
            let n = (n + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
            let n = (n ^ (n >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            let n = (n ^ (n >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
            ((n ^ (n >> 31)) >> 40) as f32 / (1u32 << 24) as f32
        };
        let noise = |i: u32, k: usize| {
            let at = (u64::from(i) * 136 + k as u64) * 12;
            0.6 * ((at..at + 12).map(uniform).sum::<f32>() - 6.0)
        };
        let quality = measure(&track(noise), 200, 0.8);
        let jitter = quality.landmark_jitter_px.unwrap();
        assert!((jitter - 0.6).abs() < 0.06, "{jitter}");
        assert_eq!((quality.valid_frames, quality.lost_runs.len()), (180, 20));
        assert_eq!(quality.still_units, [ActionUnit(6)]);
    }

    #[test]
    fn percentile_saturation_and_confidence_of_an_au() {
        let mut track = track(|_, _| 0.0);
        // AU12 stands at the top in 20 of the 180 valid frames.
        for row in track.rows.iter_mut().filter(|r| r.success).take(20) {
            row.intensities[1] = Some(5.0);
        }
        let mut meter = QualityMeter::new(&track.units, 200);
        for row in &track.rows {
            let confidences =
                std::array::from_fn(|k| if OPENFACE_INTENSITIES[k] == ActionUnit(12) { 0.75 } else { 0.25 });
            meter.push(row, Some(&confidences));
        }
        let quality = meter.finish();
        let [au06, au12] = &quality.units[..] else { panic!("two AUs") };
        assert!(
            (au12.saturated_share - 20.0 / 180.0).abs() < 1e-6 && (quality.saturated_share - 20.0 / 180.0).abs() < 1e-6
        );
        assert_eq!((au12.p99, au06.p99, au06.saturated_share), (Some(5.0), Some(1.0), 0.0));
        assert_eq!((au12.confidence, au12.sureness), (Some(0.75), Some(Sureness::Sure)));
        assert_eq!((au06.confidence, au06.sureness), (Some(0.25), Some(Sureness::NotSure)));
        assert_eq!(measure(&track, 200, 0.8).units[0].sureness, None);
    }

    #[test]
    fn frames_without_rows_are_lost() {
        let quality = measure(&track(|_, _| 0.0), 205, 0.8);
        assert_eq!(quality.lost_runs.last(), Some(&[199, 204]));
        assert_eq!(measure(&Track::default(), 3, 0.8).lost_frames, 3);
    }
}
