//! The tracker's table of a video, as OpenFace would write it, with seeded noise.

use glam::DVec3;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use risorius_formats::au::OPENFACE_INTENSITIES;
use risorius_formats::track::HeadPose;
use risorius_formats::{Camera, FrameIndex, Isometry, Landmarks68, Track, TrackRow};

use crate::expression::Expression;
use crate::landmarks::openface_pose;
use crate::scene::Scene;

/// How noisy a table is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Noise {
    /// Standard deviation of a landmark's coordinate, pixels.
    pub landmark_sigma_px: f64,
    /// Standard deviation of an intensity.
    pub au_sigma: f64,
    /// Share of frames without a face.
    pub lost_share: f64,
}

impl Noise {
    /// None at all.
    pub const OFF: Self = Self { landmark_sigma_px: 0.0, au_sigma: 0.0, lost_share: 0.0 };
    /// What a good tracker does.
    pub const ON: Self = Self { landmark_sigma_px: 0.3, au_sigma: 0.1, lost_share: 0.01 };
}

/// A number with mean 0 and deviation 1 (Box–Muller).
fn gauss(rng: &mut ChaCha8Rng) -> f64 {
    let (a, b): (f64, f64) = (rng.random_range(1e-12..1.0), rng.random_range(0.0..std::f64::consts::TAU));
    (-2.0 * a.ln()).sqrt() * b.cos()
}

/// One frame of a video: who looks how from where.
#[derive(Clone, Copy, Debug)]
pub struct Shot {
    /// The camera.
    pub camera: Camera,
    /// The expression.
    pub expression: Expression,
    /// The head's place.
    pub world_from_head: Isometry,
}

/// The landmarks of a shot in camera space, metres.
pub fn landmarks_in_camera(scene: &Scene, shot: &Shot) -> [DVec3; 68] {
    let camera_from_head = shot.camera.camera_from_world.compose(&shot.world_from_head);
    scene.landmarks(&shot.expression).map(|p| camera_from_head.transform_point(p))
}

/// The table of a video. 3-D landmarks and head poses are exact; 2-D landmarks and intensities carry the noise.
pub fn track(scene: &Scene, shots: &[Shot], fps: f64, noise: &Noise, seed: u64) -> Track {
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0xd3);
    let lost = lost_frames(shots.len(), noise.lost_share, &mut rng);
    let rows = shots
        .iter()
        .enumerate()
        .map(|(i, shot)| {
            let success = !lost[i];
            let points = landmarks_in_camera(scene, shot);
            let points_px = points.map(|p| {
                let pixel = shot.camera.intrinsics.project(p);
                [pixel.x, pixel.y].map(|v| (v + noise.landmark_sigma_px * gauss(&mut rng)) as f32)
            });
            let intensities: Vec<f32> = shot
                .expression
                .intensities()
                .iter()
                .map(|&v| (f64::from(v) + noise.au_sigma * gauss(&mut rng)).clamp(0.0, 5.0) as f32)
                .collect();
            let pose = openface_pose(&shot.camera.camera_from_world, &shot.world_from_head);
            let millimetres = points.map(|p| (p * 1000.0).as_vec3().to_array());
            TrackRow {
                frame: FrameIndex(i as u32),
                face_id: 0,
                timestamp_secs: Some(i as f64 / fps),
                confidence: if success { 0.98 } else { 0.0 },
                success,
                presences: intensities.iter().map(|&v| Some(success && v >= 1.0)).collect(),
                intensities: intensities.iter().map(|&v| Some(if success { v } else { 0.0 })).collect(),
                landmarks: success.then(|| Box::new(Landmarks68 { points_px })),
                landmarks_in_camera_mm: success.then(|| Box::new(millimetres)),
                head_pose: success.then(|| HeadPose::from_isometry(&pose)),
            }
        })
        .collect();
    Track { units: OPENFACE_INTENSITIES.to_vec(), presence_units: OPENFACE_INTENSITIES.to_vec(), rows }
}

/// Which frames have no face: a fixed number of them, so that a short video has some too; never the first.
fn lost_frames(count: usize, share: f64, rng: &mut ChaCha8Rng) -> Vec<bool> {
    let mut lost = vec![false; count];
    let mut left = if share > 0.0 && count > 20 { ((count as f64 * share).round() as usize).max(1) } else { 0 };
    while left > 0 {
        let i = rng.random_range(1..count);
        if !lost[i] {
            lost[i] = true;
            left -= 1;
        }
    }
    lost
}
