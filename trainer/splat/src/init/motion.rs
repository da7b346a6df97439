//! What AUs do to the 68 landmarks, from their tracks: X_l(a) = X_l0 + Σ_k a_k B_lk in the head frame.
//!
//! For known poses (R, t) and ideal image coordinates (x, y) each frame gives two equations that are linear in X_l0 and
//! B_l (prototype §3.4): (r1 − x r3)·X = x t3 − t1 and (r2 − y r3)·X = y t3 − t2. One ridge solve of 3 (1 + AUs) unknowns
//! per landmark, reweighted for outliers and for depth.

use glam::{DVec2, DVec3};
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use risorius_formats::Isometry;

use super::LandmarkMotion;
use crate::scene::Scene;

/// Solves with weights from the residuals before.
const REWEIGHTINGS: usize = 3;
/// Expected size of a displacement, metres: the ridge.
const DISPLACEMENT_M: f64 = 0.008;
/// Residuals beyond this many standard deviations count less and less.
const OUTLIER: f64 = 2.0;
/// The smallest standard deviation of landmarks that is believed, pixels.
const LEAST_SIGMA_PX: f64 = 0.05;

/// The landmarks of a frame that has activations too.
#[derive(Clone, Debug)]
pub(crate) struct Track {
    /// Index of the frame.
    pub(crate) frame: usize,
    /// 1, then the activations.
    pub(crate) activations: Vec<f64>,
    /// Ideal image coordinates (x/z, y/z); `None` where there is no number.
    pub(crate) points: [Option<DVec2>; 68],
    /// Focal length, pixels.
    pub(crate) focal: f64,
}

/// The tracks of all frames with landmarks and finite activations.
pub(crate) fn tracks(scene: &Scene<'_>) -> Vec<Track> {
    let count = scene.region_of.len();
    let of = |(frame, f): (usize, &crate::scene::Frame<'_>)| {
        let (landmarks, values) = (f.landmarks_px.as_ref()?, f.activations.as_ref()?);
        let usable = values.len() == count && values.iter().all(|v| v.is_finite());
        let lens = &f.camera.intrinsics;
        let focal = 0.5 * (lens.fx + lens.fy);
        if !(usable && focal.is_finite() && focal > 0.0) {
            return None;
        }
        let point = |p: &[f32; 2]| {
            let p = DVec2::new(f64::from(p[0]), f64::from(p[1]));
            p.is_finite().then(|| lens.unproject(p)).flatten()
        };
        let activations = std::iter::once(1.0).chain(values.iter().map(|&v| f64::from(v))).collect();
        Some(Track { frame, activations, points: std::array::from_fn(|i| point(&landmarks[i])), focal })
    };
    scene.frames.iter().enumerate().filter_map(of).collect()
}

/// The motion of all landmarks and the standard deviation of each one's residuals, pixels.
#[derive(Clone, Debug)]
pub(crate) struct Solution {
    /// The motion.
    pub(crate) motion: LandmarkMotion,
    /// Robust standard deviation per landmark and coordinate, pixels.
    pub(crate) sigmas_px: [f64; 68],
}

/// Solves for all landmarks; `poses` are `camera_from_head` of the tracks. `None` with fewer than three tracks, and where
/// a landmark is never seen.
pub(crate) fn solve(tracks: &[Track], poses: &[Isometry], radius: f64) -> Option<Solution> {
    if tracks.len() < 3 || tracks.len() != poses.len() {
        return None;
    }
    let solved: Vec<Option<Point>> =
        (0..68).into_par_iter().map(|l| solve_landmark(tracks, poses, radius, l)).collect();
    let solved: Vec<Point> = solved.into_iter().collect::<Option<_>>()?;
    let bases = tracks[0].activations.len();
    let at = |k: usize| std::array::from_fn(|l| solved[l].places[k].to_array());
    let (sum, count) = solved.iter().fold((0.0, 0.0), |(s, c), p| (s + p.squares, c + p.weights));
    let motion = LandmarkMotion {
        rest: at(0),
        deltas: (1..bases).map(at).collect(),
        error_px: (2.0 * sum / f64::max(count, 1e-12)).sqrt(),
    };
    Some(Solution { motion, sigmas_px: std::array::from_fn(|l| solved[l].sigma_px) })
}

/// What one landmark does.
struct Point {
    /// At rest, then per AU its displacement, metres.
    places: Vec<DVec3>,
    sigma_px: f64,
    /// Weighted squared residuals of coordinates, and their weights.
    squares: f64,
    weights: f64,
}

/// A frame's residual in pixels: `c`·X − `d` for both coordinates.
struct Rows {
    c: [DVec3; 2],
    d: [f64; 2],
}

fn rows_of(p: DVec2, pose: &Isometry, focal: f64, depth: f64) -> Rows {
    let (r1, r2, r3) = (pose.rotation.row(0), pose.rotation.row(1), pose.rotation.row(2));
    let t = pose.translation;
    let scale = focal / depth;
    Rows {
        c: [scale * (r1 - p.x * r3), scale * (r2 - p.y * r3)],
        d: [scale * (p.x * t.z - t.x), scale * (p.y * t.z - t.y)],
    }
}

fn solve_landmark(tracks: &[Track], poses: &[Isometry], radius: f64, landmark: usize) -> Option<Point> {
    let seen: Vec<(&Track, &Isometry, DVec2)> =
        tracks.iter().zip(poses).filter_map(|(t, pose)| Some((t, pose, t.points[landmark]?))).collect();
    let bases = tracks[0].activations.len();
    // The first depth is that of the face's middle.
    let mut depths: Vec<f64> = seen.iter().map(|(_, pose, _)| pose.translation.z.max(0.01)).collect();
    let mut weights = vec![1.0; seen.len()];
    let mut sigma_px = 1.0f64;
    let mut places = Vec::new();
    let mut residuals = Vec::new();
    for _ in 0..=REWEIGHTINGS {
        let mut system = Normal::new(bases);
        for (((track, pose, p), &depth), &weight) in seen.iter().zip(&depths).zip(&weights) {
            system.add(&rows_of(*p, pose, track.focal, depth), &track.activations, weight);
        }
        places = system.solve(sigma_px, radius)?;
        residuals.clear();
        for (((track, pose, p), depth), weight) in seen.iter().zip(&mut depths).zip(&mut weights) {
            let at: DVec3 = places.iter().zip(&track.activations).map(|(&b, &a)| b * a).sum();
            *depth = pose.transform_point(at).z.max(0.01);
            let rows = rows_of(*p, pose, track.focal, *depth);
            let r = DVec2::new(rows.c[0].dot(at) - rows.d[0], rows.c[1].dot(at) - rows.d[1]);
            residuals.push(r);
            *weight = 1.0 / (1.0 + r.length_squared() / (2.0 * (OUTLIER * sigma_px).powi(2)));
        }
        let mut sizes: Vec<f64> = residuals.iter().map(|r| r.length()).collect();
        sizes.sort_by(f64::total_cmp);
        // The median length of a 2-D normal distribution is 1.177 σ.
        sigma_px = (sizes.get(sizes.len() / 2)? / 1.177).max(LEAST_SIGMA_PX);
    }
    let squares = residuals.iter().zip(&weights).map(|(r, w)| 0.5 * w * r.length_squared()).sum();
    let finite = places.iter().all(|p| p.is_finite());
    finite.then(|| Point { places, sigma_px, squares, weights: weights.iter().sum() })
}

/// The normal equations: AᵀA = Σ w (c cᵀ) ⊗ (ã ãᵀ), 3 × 3 blocks over pairs of bases.
struct Normal {
    bases: usize,
    /// `[pairs j ≤ i][6]`: xx, xy, xz, yy, yz, zz.
    blocks: Vec<[f64; 6]>,
    right: Vec<DVec3>,
}

impl Normal {
    fn new(bases: usize) -> Self {
        Self { bases, blocks: vec![[0.0; 6]; bases * (bases + 1) / 2], right: vec![DVec3::ZERO; bases] }
    }

    fn add(&mut self, rows: &Rows, activations: &[f64], weight: f64) {
        let [u, v] = rows.c;
        let block = [
            u.x * u.x + v.x * v.x,
            u.x * u.y + v.x * v.y,
            u.x * u.z + v.x * v.z,
            u.y * u.y + v.y * v.y,
            u.y * u.z + v.y * v.z,
            u.z * u.z + v.z * v.z,
        ];
        let right = weight * (u * rows.d[0] + v * rows.d[1]);
        let mut pairs = self.blocks.iter_mut();
        for (i, &a) in activations.iter().enumerate() {
            self.right[i] += a * right;
            for (&b, to) in activations[..=i].iter().zip(pairs.by_ref()) {
                let share = weight * a * b;
                (0..6).for_each(|k| to[k] += share * block[k]);
            }
        }
    }

    fn solve(&self, sigma_px: f64, radius: f64) -> Option<Vec<DVec3>> {
        let n = 3 * self.bases;
        let mut matrix = DMatrix::<f64>::zeros(n, n);
        let mut pairs = self.blocks.iter();
        for i in 0..self.bases {
            for (j, b) in (0..=i).zip(pairs.by_ref()) {
                let full = [[b[0], b[1], b[2]], [b[1], b[3], b[4]], [b[2], b[4], b[5]]];
                for (r, row) in full.iter().enumerate() {
                    for (c, &v) in row.iter().enumerate() {
                        matrix[(3 * i + r, 3 * j + c)] = v;
                        matrix[(3 * j + c, 3 * i + r)] = v;
                    }
                }
            }
        }
        let ridge = |size: f64| (sigma_px / size).powi(2);
        for i in 0..n {
            // At rest a landmark is somewhere in the face.
            matrix[(i, i)] += if i < 3 { ridge(2.0 * radius) } else { ridge(DISPLACEMENT_M) };
        }
        let right = DVector::from_iterator(n, self.right.iter().flat_map(DVec3::to_array));
        let x = matrix.cholesky()?.solve(&right);
        Some((0..self.bases).map(|i| DVec3::new(x[3 * i], x[3 * i + 1], x[3 * i + 2])).collect())
    }
}

/// Where the landmarks are at the activations of `track` (1 first), metres in the head frame.
pub(crate) fn landmarks_at(motion: &LandmarkMotion, activations: &[f64]) -> [DVec3; 68] {
    std::array::from_fn(|l| {
        let moved: DVec3 = motion.deltas.iter().zip(&activations[1..]).map(|(d, &a)| DVec3::from(d[l]) * a).sum();
        DVec3::from(motion.rest[l]) + moved
    })
}
