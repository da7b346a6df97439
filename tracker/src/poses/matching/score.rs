//! How well cameras fit the landmarks of the frames that they are given to.
//!
//! Landmarks that hardly move against the skull are triangulated from all frames that have a camera (the mean face); the
//! score is how far they then lie from where they were tracked. Cameras that belong to other frames leave a larger
//! distance, except for what no one could tell: an even orbit about a still head, seen one frame later, is the same orbit.

use std::collections::BTreeMap;

use glam::DVec2;
use rayon::prelude::*;
use risorius_formats::{Camera, Track};

use crate::poses::triangulate::{MIN_PARALLAX_RAD, View, median, triangulate};

/// Bridge and tip of the nose, nostrils, corners of the eyes: what expressions move least.
const STEADY: [usize; 11] = [27, 28, 29, 30, 31, 35, 33, 36, 39, 42, 45];
/// Fewer frames say nothing.
const LEAST_FRAMES: usize = 4;

/// The landmarks of a take and the cameras of a model.
pub(crate) struct Evidence<'a> {
    /// Steady landmarks by frame, pixels of the take.
    landmarks: BTreeMap<u32, [DVec2; STEADY.len()]>,
    cameras: &'a BTreeMap<u32, Camera>,
}

/// A score: the lower, the better.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Score {
    /// Median distance between the mean face and the tracked landmarks, pixels, averaged over the landmarks.
    pub(crate) error_px: f64,
    /// Frames that took part.
    pub(crate) frames: usize,
}

impl<'a> Evidence<'a> {
    /// The valid landmarks of a track, and the cameras of the model's images at the take's size.
    pub(crate) fn new(track: &Track, min_confidence: f32, cameras: &'a BTreeMap<u32, Camera>) -> Self {
        let landmarks = track.rows.iter().filter(|r| r.is_valid(min_confidence)).filter_map(|row| {
            let points = &row.landmarks.as_ref()?.points_px;
            let pixel = |k: usize| DVec2::new(f64::from(points[k][0]), f64::from(points[k][1]));
            Some((row.frame.0, STEADY.map(pixel)))
        });
        Self { landmarks: landmarks.collect(), cameras }
    }

    /// The score of an assignment (frame → image), with at most `most` of its frames, spread evenly.
    ///
    /// `None` where there are too few frames with landmarks, or cameras that hardly move around the face.
    pub(crate) fn score(&self, frames: &BTreeMap<u32, u32>, most: usize) -> Option<Score> {
        let usable: Vec<(&[DVec2; STEADY.len()], &Camera)> = frames
            .iter()
            .filter_map(|(frame, image)| Some((self.landmarks.get(frame)?, self.cameras.get(image)?)))
            .collect();
        if usable.len() < LEAST_FRAMES {
            return None;
        }
        let count = usable.len().min(most.max(LEAST_FRAMES));
        let chosen: Vec<_> = (0..count).map(|i| usable[i * usable.len() / count]).collect();
        let mut sum = 0.0;
        for k in 0..STEADY.len() {
            let views: Vec<View> = chosen.iter().filter_map(|(points, camera)| View::new(camera, points[k])).collect();
            let found = triangulate(&views).filter(|t| t.parallax_rad >= MIN_PARALLAX_RAD)?;
            sum += found.median_error_px;
        }
        Some(Score { error_px: sum / STEADY.len() as f64, frames: count })
    }

    /// The scores of many assignments.
    pub(crate) fn scores(&self, all: &[BTreeMap<u32, u32>], most: usize) -> Vec<Option<Score>> {
        all.par_iter().map(|frames| self.score(frames, most)).collect()
    }

    /// The median distance between the outer corners of the eyes in the pictures, pixels: how large the face is.
    pub(crate) fn eye_distance_px(&self) -> Option<f64> {
        let of = |points: &[DVec2; STEADY.len()]| points[7].distance(points[10]);
        median(&mut self.landmarks.values().map(of).collect::<Vec<_>>())
    }
}
