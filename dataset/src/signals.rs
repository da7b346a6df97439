//! The AU signals of a take: which frames can be trusted, in which unbroken runs, and their smoothed intensities.

use std::ops::Range;

use risorius_formats::smooth::window_for_fps;
use risorius_formats::{ActionUnit, FrameRecord, Track};
use serde::{Deserialize, Serialize};

use crate::rows::FrameState;
use crate::smooth;

/// What became of a take's frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TrackCounts {
    /// Frames of the take.
    pub frames: u32,
    /// Frames with a trusted row.
    pub valid: u32,
    /// Frames without a row, or whose row says that the face was lost.
    pub lost: u32,
    /// Frames below the confidence limit.
    pub low_confidence: u32,
    /// Frames with an intensity or landmark that is missing or not a number.
    pub incomplete: u32,
    /// Rows of frames that the take does not have, and second rows of a frame.
    pub surplus_rows: u32,
    /// Unbroken runs of valid frames.
    pub segments: u32,
}

/// A frame that can be trusted.
#[derive(Clone, Debug, PartialEq)]
pub struct ValidFrame {
    /// Its number.
    pub frame: u32,
    /// Its row in the track.
    pub row: usize,
    /// Smoothed intensity 0–5 of each unit.
    pub intensities: Vec<f32>,
}

/// The signals of a take.
#[derive(Clone, Debug, PartialEq)]
pub struct Signals {
    /// The valid frames in order.
    pub frames: Vec<ValidFrame>,
    /// What became of all frames.
    pub counts: TrackCounts,
    /// The smoothing window, frames.
    pub window: usize,
    /// What became of each frame of the take, as far as the track tells: [`FrameState::Usable`] is trusted.
    pub states: Vec<FrameState>,
    /// The tracker's confidence in each frame of the take.
    pub confidences: Vec<Option<f32>>,
}

/// The units of `wanted` that `track` has numbers for; where it never had the face, those that it has columns for.
pub fn present_units(track: &Track, wanted: &[ActionUnit]) -> Vec<ActionUnit> {
    let never = !track.rows.iter().any(|r| r.success);
    let has_number = |i: usize| track.rows.iter().any(|r| r.intensities.get(i).copied().flatten().is_some());
    let has = |unit: &ActionUnit| track.unit_index(*unit).is_some_and(|i| never || has_number(i));
    wanted.iter().copied().filter(has).collect()
}

/// Smooths the intensities of `units` over every unbroken run of valid frames.
///
/// A run breaks at a frame that is not valid and where `frames` says that frames were dropped: a filter must not reach
/// across a gap. The order of the track's rows does not matter.
pub fn smooth_track(
    track: &Track,
    frames: &[FrameRecord],
    units: &[ActionUnit],
    fps: f64,
    min_confidence: f32,
) -> Signals {
    let columns: Vec<Option<usize>> = units.iter().map(|&u| track.unit_index(u)).collect();
    let mut counts = TrackCounts { frames: frames.len() as u32, ..TrackCounts::default() };
    let mut row_of: Vec<Option<usize>> = vec![None; frames.len()];
    for (index, row) in track.rows.iter().enumerate() {
        match row_of.get_mut(row.frame.0 as usize) {
            Some(slot @ None) => *slot = Some(index),
            _ => counts.surplus_rows += 1,
        }
    }
    let mut states = vec![FrameState::Lost; frames.len()];
    let confidences = row_of.iter().map(|r| r.map(|r| track.rows[r].confidence)).collect();
    let mut valid: Vec<(u32, usize, Vec<f64>)> = Vec::new();
    let mut segments: Vec<Range<usize>> = Vec::new();
    for (frame, slot) in (0u32..).zip(&row_of) {
        let Some(index) = *slot else {
            counts.lost += 1;
            continue;
        };
        let row = &track.rows[index];
        let values: Option<Vec<f64>> = columns
            .iter()
            .map(|c| c.and_then(|c| row.intensities.get(c).copied().flatten()).filter(|v| v.is_finite()).map(f64::from))
            .collect();
        // A confidence that is not a number is no confidence.
        let confident = row.confidence >= min_confidence;
        match values {
            _ if !row.success => counts.lost += 1,
            _ if !confident => {
                counts.low_confidence += 1;
                states[frame as usize] = FrameState::Unsure;
            }
            Some(values) if row.is_valid(min_confidence) => {
                let follows =
                    valid.last().is_some_and(|v| v.0 + 1 == frame) && frames[frame as usize].dropped_before == 0;
                match segments.last_mut() {
                    Some(segment) if follows => segment.end += 1,
                    _ => segments.push(valid.len()..valid.len() + 1),
                }
                valid.push((frame, index, values));
                states[frame as usize] = FrameState::Usable;
            }
            _ => {
                counts.incomplete += 1;
                states[frame as usize] = FrameState::Incomplete;
            }
        }
    }
    counts.valid = valid.len() as u32;
    counts.segments = segments.len() as u32;
    let window = window_for_fps(fps);
    let mut result: Vec<_> = valid
        .iter()
        .map(|&(frame, row, _)| ValidFrame { frame, row, intensities: Vec::with_capacity(units.len()) })
        .collect();
    for unit in 0..units.len() {
        let values: Vec<f64> = valid.iter().map(|v| v.2[unit]).collect();
        for (frame, v) in result.iter_mut().zip(smooth::smooth_segments(&values, &segments, window)) {
            frame.intensities.push(v as f32);
        }
    }
    Signals { frames: result, counts, window, states, confidences }
}

#[cfg(test)]
mod tests {
    use super::*;
    use risorius_formats::{FrameIndex, TrackRow};

    fn row(frame: u32, value: Option<f32>) -> TrackRow {
        TrackRow {
            frame: FrameIndex(frame),
            face_id: 0,
            timestamp_secs: None,
            confidence: 0.98,
            success: true,
            intensities: vec![value, Some(1.0)],
            presences: vec![],
            landmarks: None,
            landmarks_in_camera_mm: None,
            head_pose: None,
        }
    }

    fn track(rows: Vec<TrackRow>) -> Track {
        Track { units: vec![ActionUnit(12), ActionUnit(1)], presence_units: vec![], rows }
    }

    fn frames(n: u32) -> Vec<FrameRecord> {
        (0..n).map(|i| FrameRecord { index: FrameIndex(i), ..FrameRecord::default() }).collect()
    }

    #[test]
    fn frames_are_sorted_into_their_lots() {
        let mut rows: Vec<_> = (0..30).filter(|&f| f != 7).map(|f| row(f, Some(2.0))).collect();
        rows[10].success = false;
        rows[12].confidence = 0.5;
        rows[14].intensities[0] = Some(f32::NAN);
        rows[16].intensities[0] = None;
        rows[18].confidence = f32::NAN;
        rows.push(row(99, Some(2.0)));
        rows.push(row(3, Some(5.0)));
        let got = smooth_track(&track(rows), &frames(30), &[ActionUnit(12)], 120.0, 0.8);
        let c = got.counts;
        assert_eq!((c.frames, c.valid, c.lost, c.low_confidence, c.incomplete, c.surplus_rows), (30, 24, 2, 2, 2, 2));
        assert_eq!((c.segments, got.window), (7, 15));
        assert!(got.frames.iter().all(|f| (f.intensities[0] - 2.0).abs() < 1e-6));
    }

    #[test]
    fn the_order_of_rows_does_not_matter() {
        let rows: Vec<_> = (0..60).map(|f| row(f, Some((f as f32 * 0.7).sin() + 2.0))).collect();
        let mut shuffled = rows.clone();
        shuffled.reverse();
        shuffled.swap(3, 40);
        let units = [ActionUnit(12), ActionUnit(1)];
        let a = smooth_track(&track(rows), &frames(60), &units, 120.0, 0.8);
        let b = smooth_track(&track(shuffled), &frames(60), &units, 120.0, 0.8);
        let values = |s: &Signals| s.frames.iter().map(|f| (f.frame, f.intensities.clone())).collect::<Vec<_>>();
        assert_eq!(values(&a), values(&b));
        assert_ne!(a.frames[9].intensities[0], a.frames[10].intensities[0]);
    }

    #[test]
    fn dropped_frames_break_the_filter() {
        let rows: Vec<_> = (0..40).map(|f| row(f, Some(if f < 20 { 1.0 } else { 4.0 }))).collect();
        let mut records = frames(40);
        let smooth = smooth_track(&track(rows.clone()), &records, &[ActionUnit(12)], 120.0, 0.8);
        assert!((smooth.frames[20].intensities[0] - 4.0).abs() > 0.1);
        records[20].dropped_before = 3;
        let broken = smooth_track(&track(rows), &records, &[ActionUnit(12)], 120.0, 0.8);
        assert_eq!((broken.frames[19].intensities[0], broken.frames[20].intensities[0]), (1.0, 4.0));
        assert_eq!(broken.counts.segments, 2);
    }

    #[test]
    fn units_without_any_number_are_left_out() {
        let t = track((0..3).map(|f| row(f, None)).collect());
        assert_eq!(present_units(&t, &[ActionUnit(1), ActionUnit(12), ActionUnit(45)]), [ActionUnit(1)]);
    }
}
