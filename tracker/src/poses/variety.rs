//! What tells the frames of a take apart besides time: from where the head is seen, and with which expression.
//!
//! Both come from the track: no pictures are read. The camera's place about the head is the median over short windows,
//! so that a noisy head pose does not pass for a path.

use std::collections::BTreeMap;

use glam::DVec3;
use risorius_formats::{FrameRecord, Track};

use super::triangulate::median;

/// Length of a window, seconds.
const WINDOW_SECS: f64 = 0.25;
/// From one window to the next, less than this is noise, radians.
const NOISE_RAD: f64 = 0.005;
/// A path shorter than this is none: frames are then told apart by time alone, radians.
const LEAST_PATH_RAD: f64 = 0.05;
/// How much of the way is the path's; the rest is time's, so that nothing between two key frames lasts more than
/// 1 / (1 − this) times the mean.
const PATH_SHARE: f64 = 0.5;

/// What is known of each frame.
#[derive(Clone, Debug, Default)]
pub(crate) struct Variety {
    /// How far along the take each frame is, 0–1, ascending: by time and by the way of the camera about the head.
    pub(crate) way: Vec<f64>,
    /// AU intensities of frames whose face was found.
    expressions: BTreeMap<u32, Vec<f32>>,
}

impl Variety {
    pub(crate) fn of(frames: &[FrameRecord], track: &Track) -> Self {
        let expressions = track
            .rows
            .iter()
            .filter(|row| row.success && row.intensities.iter().all(|v| v.is_some_and(f32::is_finite)))
            .map(|row| (row.frame.0, row.intensities.iter().flatten().copied().collect()))
            .collect();
        Self { way: way(frames, track), expressions }
    }

    /// How much the expression of `frame` differs from the nearest of `chosen`, intensities; `None` where it is unknown.
    pub(crate) fn news(&self, frame: u32, chosen: &[u32]) -> Option<f32> {
        let here = self.expressions.get(&frame).filter(|e| !e.is_empty())?;
        let apart = |other: &Vec<f32>| here.iter().zip(other).map(|(a, b)| (a - b).powi(2)).sum::<f32>().sqrt();
        chosen.iter().filter_map(|f| self.expressions.get(f)).map(apart).min_by(f32::total_cmp)
    }
}

/// Way of each frame, 0–1.
fn way(frames: &[FrameRecord], track: &Track) -> Vec<f64> {
    let Some((first, last)) = frames.first().zip(frames.last()) else { return Vec::new() };
    let secs_of = |f: &FrameRecord| (f.timestamp_nanos - first.timestamp_nanos) as f64 * 1e-9;
    let duration = secs_of(last).max(1e-9);
    let path = path(frames, track, &secs_of);
    let length = path.last().map_or(0.0, |(_, along)| *along);
    let share = if length < LEAST_PATH_RAD { 0.0 } else { PATH_SHARE };
    frames
        .iter()
        .map(|frame| {
            let secs = secs_of(frame);
            let along = if share > 0.0 { interpolate(&path, secs) / length } else { 0.0 };
            (1.0 - share) * secs / duration + share * along
        })
        .collect()
}

/// Time and length of the camera's way about the head, radians: turns about it, and ratios of the distance.
fn path(frames: &[FrameRecord], track: &Track, secs_of: &impl Fn(&FrameRecord) -> f64) -> Vec<(f64, f64)> {
    let mut windows: BTreeMap<u64, Vec<(f64, DVec3)>> = BTreeMap::new();
    for row in track.rows.iter().filter(|row| row.success) {
        let (Some(frame), Some(pose)) = (frames.get(row.frame.0 as usize), row.head_pose) else { continue };
        let eye = pose.camera_from_head().inverse().translation;
        if eye.is_finite() && eye.length() > 0.0 {
            let secs = secs_of(frame);
            windows.entry((secs / WINDOW_SECS) as u64).or_default().push((secs, eye));
        }
    }
    let mut path: Vec<(f64, f64)> = Vec::new();
    let mut before: Option<DVec3> = None;
    for seen in windows.values() {
        let middle =
            |axis: usize| median(&mut seen.iter().map(|(_, eye)| eye[axis]).collect::<Vec<_>>()).unwrap_or(0.0);
        let eye = DVec3::new(middle(0), middle(1), middle(2));
        let secs = seen.iter().map(|(secs, _)| secs).sum::<f64>() / seen.len() as f64;
        let step = before.map_or(0.0, |b| b.angle_between(eye) + (eye.length() / b.length()).ln().abs());
        let step = if step.is_finite() && step >= NOISE_RAD { step } else { 0.0 };
        path.push((secs, path.last().map_or(0.0, |(_, along)| *along) + step));
        before = Some(eye);
    }
    path
}

/// The path's length at a time; constant beyond its ends.
fn interpolate(path: &[(f64, f64)], secs: f64) -> f64 {
    let next = path.partition_point(|(s, _)| *s < secs);
    match (next.checked_sub(1).and_then(|i| path.get(i)), path.get(next)) {
        (Some(&(s0, a0)), Some(&(s1, a1))) => a0 + (a1 - a0) * (secs - s0) / (s1 - s0).max(1e-9),
        (Some(&(_, along)), None) | (None, Some(&(_, along))) => along,
        (None, None) => 0.0,
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use risorius_formats::track::HeadPose;
    use risorius_formats::{ActionUnit, FrameIndex, TrackRow};

    use super::*;

    /// A take of `n` frames at 100 per second whose camera is `turn(frame)` radians to the side of a head 0.5 m away, and
    /// whose face shows AU12 at `smile(frame)`.
    pub(crate) fn seen(n: u32, turn: impl Fn(u32) -> f64, smile: impl Fn(u32) -> f32) -> (Vec<FrameRecord>, Track) {
        let frames = (0..n)
            .map(|i| FrameRecord {
                index: FrameIndex(i),
                timestamp_nanos: i64::from(i) * 10_000_000,
                sharpness: Some(1.0),
                ..FrameRecord::default()
            })
            .collect();
        let row = |i: u32| TrackRow {
            frame: FrameIndex(i),
            success: true,
            confidence: 1.0,
            intensities: vec![Some(smile(i))],
            // Noise of a degree, as trackers have it.
            head_pose: Some(HeadPose {
                translation_mm: DVec3::new(0.0, 0.0, 500.0),
                rotation_rad: DVec3::new(0.0, turn(i) + 0.017 * f64::from(i * 7919 % 13) / 6.5 - 0.017, 0.0),
            }),
            face_id: 0,
            timestamp_secs: None,
            presences: Vec::new(),
            landmarks: None,
            landmarks_in_camera_mm: None,
        };
        let units = vec![ActionUnit(12)];
        (frames, Track { units, rows: (0..n).map(row).collect(), ..Track::default() })
    }

    #[test]
    fn a_camera_that_rests_covers_less_way_than_one_that_moves() {
        // At rest for five seconds, then five seconds of turning by 60°.
        let (frames, track) = seen(1000, |i| if i < 500 { 0.0 } else { f64::from(i - 500) / 500.0 }, |_| 0.0);
        let way = Variety::of(&frames, &track).way;
        assert!(way.windows(2).all(|w| w[0] < w[1]));
        assert!(way[0].abs() < 1e-9 && (way[999] - 1.0).abs() < 1e-9);
        assert!((way[500] - 0.25).abs() < 0.03, "{}", way[500]);
    }

    #[test]
    fn noise_of_a_still_head_and_a_lost_face_are_no_way() {
        let (frames, track) = seen(1000, |_| 0.2, |_| 0.0);
        let by_time = |way: &[f64]| way.iter().enumerate().all(|(i, w)| (w - i as f64 / 999.0).abs() < 1e-9);
        assert!(by_time(&Variety::of(&frames, &track).way));
        assert!(by_time(&Variety::of(&frames, &Track::default()).way));
        assert!(Variety::of(&[], &track).way.is_empty());
    }
}
