//! From how many sides the head is seen, by the head poses of a track.

use risorius_formats::openface::{self, ReadOptions};
use risorius_formats::{Silent, Take};
use serde::Serialize;

use crate::Result;
use crate::timing::quantile;

/// Width of a view, degrees.
const VIEW_DEGREES: f64 = 10.0;
/// A view counts when it is held for this long, seconds.
const HELD_SECS: f64 = 0.1;
/// Rows below this are lost faces.
const LEAST_CONFIDENCE: f32 = 0.5;

/// The sides from which the head is seen.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Orbit {
    /// Share of the frames in which the head was found, 0–1.
    pub tracked_share: f64,
    /// From the furthest left to the furthest right view, degrees, 2.5 % at each end left out.
    pub yaw_range_degrees: f64,
    /// The same up and down.
    pub pitch_range_degrees: f64,
    /// Middles of the 10° views between the ends that were not held, degrees.
    pub missing_views_degrees: Vec<f64>,
    /// How far the face leans clockwise, by its eyes, degrees; near ±90 or 180 the clip lies on its side or stands on its
    /// head. `None` for tables without landmarks.
    pub roll_degrees: Option<f64>,
}

/// The orbit of a take that was tracked; `None` for one that was not.
pub(super) fn orbit(take: &Take) -> Result<Option<Orbit>> {
    let path = take.openface_path();
    if !path.is_file() {
        return Ok(None);
    }
    let track = openface::read(path, &ReadOptions::default(), &Silent)?;
    let poses: Vec<(f64, f64)> = track
        .rows
        .iter()
        .filter(|r| r.is_valid(LEAST_CONFIDENCE))
        .filter_map(|r| r.head_pose.as_ref())
        .map(|p| (p.rotation_rad.y.to_degrees(), p.rotation_rad.x.to_degrees()))
        .filter(|(yaw, pitch)| yaw.is_finite() && pitch.is_finite())
        .collect();
    let eyes = track.rows.iter().filter(|r| r.is_valid(LEAST_CONFIDENCE)).filter_map(|r| r.landmarks.as_ref());
    let roll_degrees = roll(eyes.map(|l| (l.points_px[OUTER_EYES.0], l.points_px[OUTER_EYES.1])));
    Ok(coverage(&poses, take.frames.len(), take.fps()).map(|o| Orbit { roll_degrees, ..o }))
}

/// The outer corners of the eyes among the 68 landmarks: the person's right one is left in the picture.
const OUTER_EYES: (usize, usize) = (36, 45);

/// The mean direction from one outer corner to the other, clockwise from the picture's right, degrees.
fn roll(eyes: impl Iterator<Item = ([f32; 2], [f32; 2])>) -> Option<f64> {
    let sum = eyes.fold((0.0, 0.0), |(x, y), (a, b)| {
        let (dx, dy) = (f64::from(b[0] - a[0]), f64::from(b[1] - a[1]));
        let length = dx.hypot(dy).max(1e-9);
        (x + dx / length, y + dy / length)
    });
    (sum != (0.0, 0.0)).then(|| sum.1.atan2(sum.0).to_degrees())
}

/// The coverage by (yaw, pitch) in degrees of the frames in which a head was found.
fn coverage(poses: &[(f64, f64)], frames: usize, fps: f64) -> Option<Orbit> {
    let yaw: Vec<f64> = poses.iter().map(|p| p.0).collect();
    let pitch: Vec<f64> = poses.iter().map(|p| p.1).collect();
    let ends = |v: &[f64]| Some((quantile(v, 0.025)?, quantile(v, 0.975)?));
    let ((left, right), (up, down)) = (ends(&yaw)?, ends(&pitch)?);
    let view = |degrees: f64| (degrees / VIEW_DEGREES).round() as i64;
    let held = |v: i64| yaw.iter().filter(|y| view(**y) == v).count() as f64 / fps >= HELD_SECS;
    let missing = (view(left)..=view(right)).filter(|v| !held(*v)).map(|v| v as f64 * VIEW_DEGREES);
    Some(Orbit {
        tracked_share: poses.len() as f64 / frames.max(1) as f64,
        yaw_range_degrees: right - left,
        pitch_range_degrees: down - up,
        missing_views_degrees: missing.collect(),
        roll_degrees: None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_orbit_has_its_range_and_its_holes() {
        // From −40° to 40° and back, but from 15° to 25° in a single frame.
        let poses: Vec<(f64, f64)> = (0..1000)
            .map(|i| (-40.0 + 80.0 * (1.0 - (f64::from(i) / 500.0 - 1.0).abs()), 3.0))
            .filter(|(yaw, _)| !(15.0..25.0).contains(yaw))
            .collect();
        let orbit = coverage(&poses, 1000, 100.0).unwrap();
        assert!((orbit.yaw_range_degrees - 76.0).abs() < 4.0 && orbit.pitch_range_degrees == 0.0, "{orbit:?}");
        assert_eq!(orbit.missing_views_degrees, [20.0]);
        assert!((orbit.tracked_share - 0.875).abs() < 0.01);
        assert_eq!(coverage(&[], 10, 100.0), None);
    }

    #[test]
    fn a_face_on_its_side_has_its_eyes_above_each_other() {
        let eyes = |dx: f32, dy: f32| std::iter::once(([100.0, 100.0], [100.0 + dx, 100.0 + dy]));
        assert!(roll(eyes(80.0, 4.0)).unwrap().abs() < 5.0);
        assert!((roll(eyes(2.0, 80.0)).unwrap() - 90.0).abs() < 5.0);
        assert!((roll(eyes(0.0, -80.0)).unwrap() + 90.0).abs() < 5.0);
        assert_eq!(roll(std::iter::empty()), None);
    }
}
