//! How far a track is from the truth.

use glam::{DMat3, DQuat};
use risorius_formats::au::OPENFACE_INTENSITIES;
use risorius_formats::{Track, TrackRow};
use risorius_trainer::eval::icc::icc;
use serde::Serialize;

/// What is true of every frame.
#[derive(Clone, Debug, Default)]
pub(crate) struct Truth {
    /// The 68 points, pixels, the centre of the first pixel at (0.5, 0.5).
    pub(crate) landmarks_px: Vec<[[f64; 2]; 68]>,
    /// The 17 intensities in OpenFace's order, 0–5.
    pub(crate) intensities: Vec<[f64; 17]>,
    /// `camera_from_head` rotation in OpenFace's axes; empty where it is not known.
    pub(crate) head_rotations: Vec<DMat3>,
    /// Yaw to the image's right and pitch up against the head, degrees; empty where they are not known.
    pub(crate) gaze_deg: Vec<[f64; 2]>,
}

/// The errors of one track.
#[derive(Clone, Debug, Default, Serialize)]
pub(crate) struct Errors {
    /// Share of the frames with a face.
    pub(crate) found_share: f64,
    /// Mean distance of the inner 51 points, % of the outer-eye distance.
    pub(crate) landmarks_percent: f64,
    /// The same after removing each point's median offset over the video.
    pub(crate) landmarks_without_offset_percent: f64,
    /// ICC(3,1) of each AU whose truth moves.
    pub(crate) icc31: Vec<(String, f64)>,
    /// Mean of these.
    pub(crate) icc31_mean: f64,
    /// Smallest of these.
    pub(crate) icc31_min: f64,
    /// F1 of each AU's presence against a truth of at least 1 (FACS A).
    pub(crate) f1: Vec<(String, f64)>,
    /// Mean of these.
    pub(crate) f1_mean: f64,
    /// Mean angle between the head rotations, degrees.
    pub(crate) head_rotation_deg: Option<f64>,
}

/// Compares the rows of a track with the truth of their frames.
pub(crate) fn compare(track: &Track, truth: &Truth) -> Errors {
    let frames = truth.landmarks_px.len();
    let rows: Vec<(usize, &TrackRow)> =
        track.rows.iter().filter(|r| r.success).map(|r| (r.frame.0 as usize, r)).filter(|r| r.0 < frames).collect();
    let mut errors = Errors { found_share: rows.len() as f64 / frames.max(1) as f64, ..Errors::default() };
    (errors.landmarks_percent, errors.landmarks_without_offset_percent) = landmarks(&rows, truth);
    for (j, unit) in OPENFACE_INTENSITIES.into_iter().enumerate() {
        let Some(k) = track.unit_index(unit) else { continue };
        let pairs: Vec<(f64, f64)> = rows
            .iter()
            .filter_map(|(i, r)| Some((f64::from(r.intensities[k]?), truth.intensities.get(*i)?[j])))
            .collect();
        // An AU that never comes says nothing about a tracker.
        if !pairs.iter().any(|p| p.1 >= 1.0) {
            continue;
        }
        errors.icc31.push((unit.to_string(), icc31(&pairs)));
        let Some(k) = track.presence_units.iter().position(|u| *u == unit) else { continue };
        let found: Vec<(bool, bool)> =
            rows.iter().filter_map(|(i, r)| Some((r.presences[k]?, truth.intensities.get(*i)?[j] >= 1.0))).collect();
        errors.f1.push((unit.to_string(), f1(&found)));
    }
    let mean = |list: &[(String, f64)]| list.iter().map(|e| e.1).sum::<f64>() / list.len().max(1) as f64;
    errors.icc31_mean = mean(&errors.icc31);
    errors.icc31_min = errors.icc31.iter().map(|e| e.1).fold(f64::INFINITY, f64::min);
    errors.f1_mean = mean(&errors.f1);
    let angles: Vec<f64> = rows
        .iter()
        .filter_map(|(i, r)| Some(angle_deg(&r.head_pose?.camera_from_head().rotation, truth.head_rotations.get(*i)?)))
        .collect();
    errors.head_rotation_deg = (!angles.is_empty()).then(|| angles.iter().sum::<f64>() / angles.len() as f64);
    errors
}

fn angle_deg(a: &DMat3, b: &DMat3) -> f64 {
    DQuat::from_mat3(&(*a * b.transpose())).normalize().w.abs().min(1.0).acos().to_degrees() * 2.0
}

fn landmarks(rows: &[(usize, &TrackRow)], truth: &Truth) -> (f64, f64) {
    let (mut as_is, mut without, mut count) = (0.0, 0.0, 0.0);
    for point in 17..68 {
        // Offset and yardstick of every frame.
        let offsets: Vec<([f64; 2], f64)> = rows
            .iter()
            .filter_map(|(i, r)| {
                let (t, p) = (&truth.landmarks_px[*i], r.landmarks.as_ref()?.points_px[point].map(f64::from));
                let eyes = (t[36][0] - t[45][0]).hypot(t[36][1] - t[45][1]);
                Some(([p[0] - t[point][0], p[1] - t[point][1]], eyes))
            })
            .collect();
        let median = |axis: usize| {
            let mut values: Vec<f64> = offsets.iter().map(|o| o.0[axis]).collect();
            values.sort_unstable_by(f64::total_cmp);
            values.get(values.len() / 2).copied().unwrap_or(0.0)
        };
        let [mx, my] = [median(0), median(1)];
        for ([x, y], eyes) in offsets {
            as_is += x.hypot(y) / eyes;
            without += (x - mx).hypot(y - my) / eyes;
            count += 1.0;
        }
    }
    (100.0 * as_is / f64::max(count, 1.0), 100.0 * without / f64::max(count, 1.0))
}

/// ICC(3,1): two fixed raters, single ratings, consistency; 0 where nothing varies.
pub(crate) fn icc31(pairs: &[(f64, f64)]) -> f64 {
    let ratings: Vec<Vec<f64>> = pairs.iter().map(|p| vec![p.0, p.1]).collect();
    icc(&ratings).map_or(0.0, |i| i.icc_3_1)
}

fn f1(pairs: &[(bool, bool)]) -> f64 {
    let both = pairs.iter().filter(|p| p.0 && p.1).count() as f64;
    let either = pairs.iter().map(|p| f64::from(u8::from(p.0)) + f64::from(u8::from(p.1))).sum::<f64>();
    if either > 0.0 { 2.0 * both / either } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn icc_is_1_for_a_shifted_copy_and_falls_with_noise_and_scale() {
        let truth: Vec<f64> = (0..200).map(|i| f64::from(i % 10) * 0.5).collect();
        let pairs =
            |f: &dyn Fn(usize, f64) -> f64| truth.iter().enumerate().map(|(i, t)| (f(i, *t), *t)).collect::<Vec<_>>();
        assert!((icc31(&pairs(&|_, t| t + 1.0)) - 1.0).abs() < 1e-12);
        // By hand: half the scale gives 2·0.5/(1 + 0.25) = 0.8.
        assert!((icc31(&pairs(&|_, t| 0.5 * t)) - 0.8).abs() < 1e-12);
        assert!(icc31(&pairs(&|i, _| (i * 7919 % 13) as f64)).abs() < 0.2);
        assert!(icc31(&pairs(&|_, t| -t)) < -0.99);
    }

    #[test]
    fn f1_counts_both_kinds_of_error() {
        assert_eq!(f1(&[(true, true), (true, false), (false, true), (false, false)]), 0.5);
        assert_eq!(f1(&[(false, false)]), 0.0);
    }

    #[test]
    fn an_angle_is_an_angle() {
        let turned = DMat3::from_rotation_y(0.1) * DMat3::from_rotation_x(0.3);
        assert!((angle_deg(&(DMat3::from_rotation_z(0.02) * turned), &turned) - 0.02f64.to_degrees()).abs() < 1e-6);
    }
}
