//! What happens when: the expression of each frame and the way of the camera, independent of each other.

use glam::{DMat3, DVec3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use risorius_formats::au::OPENFACE_INTENSITIES;
use risorius_formats::{ActionUnit, Camera, Intrinsics, Isometry};
use serde::Serialize;

use crate::expression::Expression;

/// A rise to some intensities, a pause and the way back.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Segment {
    /// First frame.
    pub start: u32,
    /// The frame after the last one.
    pub end: u32,
    /// The peak intensities, 0–5.
    pub aus: Vec<(ActionUnit, f32)>,
}

impl Segment {
    /// How far the segment has risen at a frame, 0..1.
    fn envelope(&self, frame: u32) -> f32 {
        if frame < self.start || frame >= self.end {
            return 0.0;
        }
        let t = (frame - self.start) as f32 / (self.end - self.start).max(1) as f32;
        let edge = (t.min(1.0 - t) / 0.38).min(1.0);
        0.5 - 0.5 * (std::f32::consts::PI * edge).cos()
    }
}

/// The expressions of a video.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Script {
    /// Single AUs first, one by one, then combinations; blinks lie over them.
    pub segments: Vec<Segment>,
}

/// Combinations that are seen in the video.
const COMBINATIONS: [&[u8]; 8] =
    [&[6, 12], &[20, 25], &[15, 17], &[12, 25, 26], &[1, 2, 5, 26], &[4, 7, 23], &[4, 9, 10], &[1, 4, 15]];
/// Combinations that are not.
const UNSEEN: [&[u8]; 8] =
    [&[2, 12], &[4, 25], &[1, 20], &[5, 15], &[7, 12, 25], &[2, 10, 26], &[14, 45], &[9, 12, 17]];
const BLINK: ActionUnit = ActionUnit(45);

fn peaks(units: &[u8], rng: &mut ChaCha8Rng) -> Vec<(ActionUnit, f32)> {
    units.iter().map(|&u| (ActionUnit(u), rng.random_range(3.6f32..5.0))).collect()
}

impl Script {
    /// The capture: every AU alone, then combinations, with blinks.
    pub fn capture(frames: u32, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0xa0);
        let singles: Vec<Vec<u8>> = OPENFACE_INTENSITIES.iter().map(|u| vec![u.0]).collect();
        let together = COMBINATIONS.iter().map(|c| c.to_vec());
        let all: Vec<Vec<u8>> = singles.into_iter().chain(together).collect();
        Self::lay_out(&all, frames, &mut rng)
    }

    /// The driver: fewer, stronger and mixed.
    pub fn driver(frames: u32, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0xb1);
        let all: Vec<Vec<u8>> =
            [&[12u8, 6][..], &[1, 2], &[26, 25], &[4, 7], &[15, 17], &[2, 12, 25], &[20, 5], &[10, 4]]
                .map(<[u8]>::to_vec)
                .to_vec();
        Self::lay_out(&all, frames, &mut rng)
    }

    fn lay_out(all: &[Vec<u8>], frames: u32, rng: &mut ChaCha8Rng) -> Self {
        // A little rest at both ends; the segments share the rest evenly.
        let rest = frames as f32 * 0.02;
        let share = (frames as f32 - 2.0 * rest) / all.len() as f32;
        let mut segments: Vec<Segment> = all
            .iter()
            .enumerate()
            .map(|(i, units)| {
                let start = (rest + share * i as f32).round() as u32;
                let end = (rest + share * (i + 1) as f32).round() as u32;
                Segment { start, end, aus: peaks(units, rng) }
            })
            .collect();
        // A blink every 70 frames or so; not over a segment that has its own.
        let mut at = rng.random_range(20..45);
        while at + 10 < frames {
            let over = segments.iter().any(|s| s.start < at + 10 && at < s.end && s.aus.iter().any(|a| a.0 == BLINK));
            if !over {
                segments.push(Segment { start: at, end: at + 10, aus: vec![(BLINK, 5.0)] });
            }
            at += rng.random_range(55..90);
        }
        Self { segments }
    }

    /// The expression of a frame: of overlapping segments the stronger one counts.
    pub fn expression(&self, frame: u32) -> Expression {
        let mut expression = Expression::NEUTRAL;
        for segment in &self.segments {
            let rise = segment.envelope(frame);
            for &(unit, peak) in &segment.aus {
                expression = expression.with(unit, expression.intensity(unit).max(peak * rise));
            }
        }
        expression
    }
}

/// The `index`-th combination that no frame of the capture shows.
pub(crate) fn unseen_expression(index: usize, rng: &mut ChaCha8Rng) -> Expression {
    let units = UNSEEN[index % UNSEEN.len()];
    units.iter().fold(Expression::NEUTRAL, |e, &u| e.with(ActionUnit(u), rng.random_range(2.5f32..4.8)))
}

/// A camera at `distance_m` from the head, from `yaw` (to the subject's left) and `pitch` (from above), radians.
pub fn camera_at(intrinsics: Intrinsics, yaw: f64, pitch: f64, distance_m: f64, target: DVec3, roll: f64) -> Camera {
    let back = DVec3::new(yaw.sin() * pitch.cos(), pitch.sin(), yaw.cos() * pitch.cos());
    let centre = target + back * distance_m;
    let forward = -back;
    let right = forward.cross(DVec3::Y).normalize();
    let down = forward.cross(right);
    let upright = DMat3::from_cols(right, down, forward).transpose();
    let rotation = DMat3::from_rotation_z(roll) * upright;
    Camera { intrinsics, camera_from_world: Isometry::new(rotation, -(rotation * centre)) }
}

/// The lens of every camera here: a 26° wide pinhole.
pub fn lens(width: u32, height: u32) -> Intrinsics {
    Intrinsics::pinhole(width, height, f64::from(width.min(height)) * 2.13)
}

/// What the cameras look at.
const TARGET: DVec3 = DVec3::new(0.0, 0.002, 0.02);

/// The hand-held camera of the capture: an arc of ±30° by ±15° at 0.55 m with a slight sway.
pub fn capture_camera(intrinsics: Intrinsics, frame: u32, frames: u32, seed: u64, still: bool) -> Camera {
    if still {
        return camera_at(intrinsics, 0.0, 0.0, 0.55, TARGET, 0.0);
    }
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0xc2);
    let mut wave = |cycles: f64| {
        let (phase, speed) = (rng.random_range(0.0..std::f64::consts::TAU), rng.random_range(0.9..1.1) * cycles);
        (std::f64::consts::TAU * speed * f64::from(frame) / f64::from(frames.max(2) - 1) + phase).sin()
    };
    let yaw = 29.0f64.to_radians() * wave(1.6) + 0.6f64.to_radians() * wave(9.0);
    let pitch = 14.0f64.to_radians() * wave(2.7) + 0.5f64.to_radians() * wave(11.0);
    let distance = 0.55 + 0.015 * wave(2.1) + 0.002 * wave(8.0);
    let sway = DVec3::new(wave(5.0), wave(6.0), 0.0) * 0.004;
    camera_at(intrinsics, yaw, pitch, distance, TARGET + sway, 0.012 * wave(3.3))
}

/// The driver's still camera.
pub fn driver_camera(intrinsics: Intrinsics) -> Camera {
    camera_at(intrinsics, 0.12, 0.05, 0.58, TARGET, 0.0)
}

/// How the driver's head moves: it turns about the neck.
pub fn driver_head(frame: u32, frames: u32) -> Isometry {
    let t = std::f64::consts::TAU * f64::from(frame) / f64::from(frames.max(1));
    let (yaw, pitch, roll) = (0.14 * t.sin(), 0.06 * (2.0 * t).sin(), 0.04 * (t + 1.0).sin());
    let rotation = DMat3::from_rotation_y(yaw) * DMat3::from_rotation_x(pitch) * DMat3::from_rotation_z(roll);
    let neck = DVec3::new(0.0, -0.11, -0.02);
    Isometry::new(rotation, neck - rotation * neck)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_au_moves_and_each_is_seen_alone() {
        let script = Script::capture(360, 1);
        for unit in OPENFACE_INTENSITIES {
            let peak = (0..360).map(|f| script.expression(f).intensity(unit)).fold(0.0, f32::max);
            assert!(peak > 3.4, "{unit} only reaches {peak}");
        }
        assert_eq!(script.expression(0), Expression::NEUTRAL);
    }

    #[test]
    fn unseen_combinations_are_unseen() {
        for unseen in UNSEEN {
            for seen in COMBINATIONS {
                assert!(!unseen.iter().all(|u| seen.contains(u)), "{unseen:?} is part of {seen:?}");
            }
            assert!(unseen.len() > 1);
        }
    }

    #[test]
    fn the_camera_covers_its_arc_and_stays_rigid() {
        let mut reach = [0.0f64; 2];
        for frame in 0..360 {
            let camera = capture_camera(lens(270, 480), frame, 360, 1, false);
            assert!(camera.camera_from_world.orthonormality_error() < 1e-12);
            let c = camera.center() - TARGET;
            reach = [reach[0].max(c.x.atan2(c.z).abs()), reach[1].max((c.y / c.length()).asin().abs())];
            assert!((0.52..0.58).contains(&c.length()));
        }
        assert!(reach[0] > 0.45 && reach[0] < 0.56 && reach[1] > 0.2 && reach[1] < 0.29, "{reach:?}");
    }
}
