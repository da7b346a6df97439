//! Poses between placed frames, corrected by the tracked landmarks.
//!
//! A hand shakes up to some 5 Hz, key frames come three or four times a second: what the spline cannot know, the landmarks
//! of each frame do. Their distance from the reprojected mean face is known at the placed frames before and after (it is
//! the expression and the tracker's bias); between them it is taken to change evenly, and what is left is the camera's.
//! The pose is the most likely one under that evidence and a prior around the spline. How far either can be trusted is
//! measured on the placed frames themselves: each is predicted from its neighbours.

use std::collections::BTreeMap;

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use risorius_formats::{FrameRecord, Isometry, TrackRow};

use super::interpolate::{Interpolated, interpolate};
use super::model::TakeModel;
use super::refine::{FrameView, Prior, RigidPoint, refine_pose};
use super::smooth::smooth;
use super::triangulate::median;
use crate::se3;

/// The spline's error shrinks at least this much when the gap that it was measured on is halved.
const HALVED_GAP: f64 = 0.5;
/// Landmarks of one frame err together; their noise counts this much more than if each erred alone.
const COMMON_ERROR: f64 = 2.0;
/// Half the window over which corrected poses are smoothed, seconds.
const SMOOTH_SECS: f64 = 0.03;
/// A prior that hardly holds: radians, and shares of the distance to the face.
const LOOSE: f64 = 0.02;
/// Placed frames needed for measuring.
const FEWEST_PLACED: usize = 8;

/// What the correction starts from.
pub(crate) struct Between<'a> {
    /// The placed frames.
    pub(crate) placed: &'a TakeModel,
    /// The frames' times.
    pub(crate) frames: &'a [FrameRecord],
    /// Valid rows with landmarks, by frame.
    pub(crate) rows: &'a BTreeMap<u32, &'a TrackRow>,
    /// The 68 points of the mean face.
    pub(crate) face: &'a [DVec3],
    /// Longest gap that is interpolated, seconds.
    pub(crate) max_gap_secs: f64,
}

/// Distances of the 68 landmarks from the reprojected mean face, pixels.
type Offsets = Vec<DVec2>;

impl Between<'_> {
    /// Corrects the interpolated poses; returns how many, or `None` where there is too little to measure on.
    pub(crate) fn correct(&self, interpolated: &mut Interpolated) -> Option<usize> {
        let poses = self.placed.poses();
        let offsets: BTreeMap<u32, Offsets> =
            poses.keys().filter_map(|&frame| Some((frame, self.offsets(frame, poses.get(&frame)?)?))).collect();
        let points = self.landmark_sigma(&offsets)?;
        let sigma = self.spline_sigma(&poses, interpolated, &offsets, &points)?;
        let frames: Vec<u32> = interpolated.poses.keys().copied().collect();
        let corrected: Vec<Option<Isometry>> = frames
            .par_iter()
            .map(|&frame| self.at(frame, interpolated.poses.get(&frame)?, &offsets, &sigma, &points))
            .collect();
        let mut count = 0;
        for (frame, pose) in frames.iter().zip(corrected) {
            if let Some(pose) = pose {
                interpolated.poses.insert(*frame, pose);
                count += 1;
            }
        }
        self.smooth(interpolated, &poses);
        Some(count)
    }

    fn secs(&self, frame: u32) -> f64 {
        self.frames[frame as usize].timestamp_nanos as f64 * 1e-9
    }

    fn offsets(&self, frame: u32, pose: &Isometry) -> Option<Offsets> {
        let lens = self.placed.lenses.get(&self.placed.frames.get(&frame)?.lens)?;
        let landmarks = self.rows.get(&frame)?.landmarks.as_ref()?;
        let offset = |(p, q): (&[f32; 2], &DVec3)| {
            DVec2::new(f64::from(p[0]), f64::from(p[1])) - lens.project(pose.transform_point(*q))
        };
        Some(landmarks.points_px.iter().zip(self.face).map(offset).collect())
    }

    /// Error of the spline in the middle of a gap: six deviations.
    ///
    /// By leaving placed frames out; and, since a shake as fast as the key frames is invisible to that, by what the
    /// landmarks say in the middle of the gaps, less what they say wrongly at placed frames.
    fn spline_sigma(
        &self,
        poses: &BTreeMap<u32, Isometry>,
        interpolated: &Interpolated,
        offsets: &BTreeMap<u32, Offsets>,
        points: &[RigidPoint],
    ) -> Option<[f64; 6]> {
        let left_out = deviations(&self.left_out(poses))?.map(|s| (s * HALVED_GAP).max(1e-9));
        let distance =
            poses.values().map(|p| p.transform_point(self.face[30]).z.abs()).sum::<f64>() / poses.len() as f64;
        let loose: [f64; 6] =
            std::array::from_fn(|i| 10.0 * left_out[i] + if i < 3 { LOOSE } else { LOOSE * distance });
        let known: Vec<u32> = offsets.keys().copied().collect();
        let at_placed =
            known.par_windows(3).filter_map(|w| self.claim(w[1], (w[0], w[2]), &poses[&w[1]], offsets, &loose, points));
        let runs = interpolated.runs.par_iter().filter_map(|run| {
            let middle = u32::midpoint(run[0], run[1]);
            self.claim(middle, around(middle, offsets)?, interpolated.poses.get(&middle)?, offsets, &loose, points)
        });
        let at_placed = deviations(&at_placed.collect::<Vec<_>>());
        let in_gaps = deviations(&runs.collect::<Vec<_>>());
        let (Some(at_placed), Some(in_gaps)) = (at_placed, in_gaps) else { return Some(left_out) };
        Some(std::array::from_fn(|i| (in_gaps[i].powi(2) - at_placed[i].powi(2)).max(0.0).sqrt().max(left_out[i])))
    }

    /// Twists from the placed frames to what the spline says when they are left out.
    fn left_out(&self, poses: &BTreeMap<u32, Isometry>) -> Vec<[f64; 6]> {
        let known: Vec<u32> = poses.keys().copied().collect();
        let mut errors = Vec::new();
        for parity in 0..2 {
            // Every second frame is left out at once: cheaper than one by one, and the neighbours stay.
            let left: BTreeMap<u32, Isometry> = known.iter().skip(parity).step_by(2).map(|f| (*f, poses[f])).collect();
            let guessed = interpolate(&left, self.frames, 2.0 * self.max_gap_secs).poses;
            let error = |f: &u32| Some(se3::log(&poses[f].compose(&guessed.get(f)?.inverse())).to_array());
            errors.extend(known.iter().filter(|f| !left.contains_key(f)).filter_map(error));
        }
        errors
    }

    /// The twist from `guess` to what the landmarks alone make of the frame.
    fn claim(
        &self,
        frame: u32,
        around: (u32, u32),
        guess: &Isometry,
        offsets: &BTreeMap<u32, Offsets>,
        loose: &[f64; 6],
        points: &[RigidPoint],
    ) -> Option<[f64; 6]> {
        let pose = self.solve(frame, around, guess, offsets, loose, points)?;
        Some(se3::log(&pose.compose(&guess.inverse())).to_array())
    }

    /// Noise of each landmark's offset when it is predicted from the placed frames around it.
    fn landmark_sigma(&self, offsets: &BTreeMap<u32, Offsets>) -> Option<Vec<RigidPoint>> {
        let known: Vec<(&u32, &Offsets)> = offsets.iter().collect();
        if known.len() < FEWEST_PLACED {
            return None;
        }
        (0..68)
            .map(|landmark| {
                let mut errors: Vec<f64> = known
                    .windows(3)
                    .filter(|w| self.secs(*w[2].0) - self.secs(*w[0].0) <= 2.0 * self.max_gap_secs)
                    .map(|w| {
                        let t = (self.secs(*w[1].0) - self.secs(*w[0].0)) / (self.secs(*w[2].0) - self.secs(*w[0].0));
                        (w[0].1[landmark].lerp(w[2].1[landmark], t) - w[1].1[landmark]).length()
                    })
                    .collect();
                // The median length of a 2-D normal deviate is 1.18 σ.
                Some(RigidPoint { landmark, sigma_px: (median(&mut errors)? / 1.18).max(0.1) * COMMON_ERROR })
            })
            .collect()
    }

    fn at(
        &self,
        frame: u32,
        guess: &Isometry,
        offsets: &BTreeMap<u32, Offsets>,
        sigma: &[f64; 6],
        points: &[RigidPoint],
    ) -> Option<Isometry> {
        let around = around(frame, offsets)?;
        let t = (self.secs(frame) - self.secs(around.0)) / (self.secs(around.1) - self.secs(around.0));
        // The spline is exact at the placed frames and worst in the middle.
        let looseness = (std::f64::consts::PI * t).sin().max(0.05);
        self.solve(frame, around, guess, offsets, &sigma.map(|s| s * looseness), points)
    }

    /// The most likely pose of `frame`, whose landmark offsets lie between those of the frames `around` it.
    fn solve(
        &self,
        frame: u32,
        around: (u32, u32),
        guess: &Isometry,
        offsets: &BTreeMap<u32, Offsets>,
        sigma: &[f64; 6],
        points: &[RigidPoint],
    ) -> Option<Isometry> {
        let landmarks = self.rows.get(&frame)?.landmarks.as_ref()?;
        let (a, b) = (offsets.get(&around.0)?, offsets.get(&around.1)?);
        let span = self.secs(around.1) - self.secs(around.0);
        // Placed frames without landmarks make the span longer than the gap.
        if span > 2.0 * self.max_gap_secs || span <= 0.0 {
            return None;
        }
        let t = (self.secs(frame) - self.secs(around.0)) / span;
        let lens = self.placed.lenses.get(&self.placed.frames.get(&around.0)?.lens)?;
        let pixel = |(i, p): (usize, &[f32; 2])| DVec2::new(f64::from(p[0]), f64::from(p[1])) - a[i].lerp(b[i], t);
        let view = FrameView { pixels: landmarks.points_px.iter().enumerate().map(pixel).collect() };
        let prior = Prior { pose: *guess, sigma: *sigma };
        Some(refine_pose(lens, *guess, self.face, points, &view, Some(&prior)))
    }

    /// Takes the noise of single frames out of the corrected poses; placed ones stay.
    fn smooth(&self, interpolated: &mut Interpolated, placed: &BTreeMap<u32, Isometry>) {
        let mut all = interpolated.poses.clone();
        all.extend(placed.iter().map(|(f, p)| (*f, *p)));
        let (frames, poses): (Vec<u32>, Vec<Isometry>) = all.into_iter().unzip();
        let secs: Vec<f64> = frames.iter().map(|&f| self.secs(f)).collect();
        for (frame, pose) in frames.iter().zip(smooth(&poses, &secs, SMOOTH_SECS)) {
            if let Some(slot) = interpolated.poses.get_mut(frame) {
                *slot = pose;
            }
        }
    }
}

/// The placed frames with landmarks before and after `frame`.
fn around(frame: u32, offsets: &BTreeMap<u32, Offsets>) -> Option<(u32, u32)> {
    let before = *offsets.range(..frame).next_back()?.0;
    let after = *offsets.range(frame + 1..).next()?.0;
    Some((before, after))
}

/// Robust deviations of twists; `None` with too few.
fn deviations(twists: &[[f64; 6]]) -> Option<[f64; 6]> {
    if twists.len() < FEWEST_PLACED {
        return None;
    }
    let deviation = |i: usize| median(&mut twists.iter().map(|t| t[i].abs()).collect::<Vec<_>>());
    let mut result = [0.0; 6];
    for (i, value) in result.iter_mut().enumerate() {
        *value = deviation(i)? / 0.6745;
    }
    Some(result)
}

#[cfg(test)]
#[path = "between_tests.rs"]
mod tests;
