//! Head poses from landmarks, where the head moves against the room.
//!
//! The skull's landmarks give first corrections D of each frame (`rigid`): `camera_from_head` = C H D. Then the linear
//! solve of `motion` and D, from the reprojection of all X(a), alternate. Corrections are smoothed over frames, and
//! believed only if those of one half of the landmarks explain the other half; else the head keeps the poses that it
//! came with.

use glam::{DVec2, DVec3};
use nalgebra::{Matrix6, Vector6};
use rayon::prelude::*;
use risorius_formats::Isometry;

use super::LandmarkMotion;
use super::motion::{self, Solution, Track};
use super::rigid::{self, residual};
use crate::scene::{Scene, rotation_from_vector};

/// Alternations of motion and poses.
const ROUNDS: usize = 2;
/// Expected size of a correction: radians and metres.
pub(crate) const EXPECTED: [f64; 2] = [0.1, 0.02];
/// Frames on each side over which corrections may be smoothed.
const WINDOWS: [usize; 5] = [0, 1, 2, 4, 8];
/// Share of the squared residuals of unseen landmarks that corrections must remove.
const WORTH: f64 = 0.1;
/// Residuals beyond this many standard deviations count less and less.
const OUTLIER: f64 = 3.0;

/// A small rigid motion: rotation vector (radians) and translation (metres).
pub(crate) type Twist = [f64; 6];

/// The motion of the landmarks and the head's pose per frame of the scene.
pub(crate) fn solve(scene: &Scene<'_>, tracks: &[Track], radius: f64) -> (Option<LandmarkMotion>, Vec<Isometry>) {
    let own: Vec<Isometry> = scene.frames.iter().map(|f| f.room_from_head).collect();
    let from_head = |head: &Isometry, frame: usize| scene.frames[frame].camera.camera_from_world.compose(head);
    let start: Vec<Isometry> = tracks.iter().map(|t| from_head(&own[t.frame], t.frame)).collect();
    let Some(still) = motion::solve(tracks, &start, radius) else { return (None, own) };
    // Where the camera's pose is that of the head, it has been found by landmarks already.
    let moving = if scene.head_hull.is_some() { None } else { swaying(tracks, &start, &still, radius) };
    let Some((motion, twists)) = moving else { return (Some(still.motion), own) };
    let mut poses = own;
    let at: Vec<usize> = tracks.iter().map(|t| t.frame).collect();
    for (frame, pose) in poses.iter_mut().enumerate() {
        if let Some(twist) = between(&at, &twists, frame) {
            *pose = pose.compose(&isometry(&twist));
        }
    }
    (Some(motion), poses)
}

/// Corrections that are worth it, with the motion that goes with them.
fn swaying(
    tracks: &[Track],
    start: &[Isometry],
    still: &Solution,
    radius: f64,
) -> Option<(LandmarkMotion, Vec<Twist>)> {
    let mut twists = rigid::corrections(tracks, start, &still.motion.rest)?;
    center(&mut twists);
    let mut solution = motion::solve(tracks, &moved(start, &twists), radius)?;
    for _ in 0..ROUNDS {
        twists = corrections(tracks, start, &solution, &twists, |_| true);
        center(&mut twists);
        solution = motion::solve(tracks, &moved(start, &twists), radius)?;
    }
    // The corrections of either half of the landmarks, held against the other half.
    let halves: [Vec<Twist>; 2] =
        std::array::from_fn(|odd| corrections(tracks, start, &solution, &twists, |l| l % 2 == odd));
    let score = |window: usize| -> f64 {
        (0..2).map(|odd| error(tracks, start, &solution, &smoothed(&halves[odd], window), |l| l % 2 != odd)).sum()
    };
    let scores = WINDOWS.map(score);
    let best = (0..WINDOWS.len()).min_by(|&a, &b| scores[a].total_cmp(&scores[b]))?;
    let without: f64 = {
        let none = vec![[0.0; 6]; tracks.len()];
        (0..2).map(|odd| error(tracks, start, still, &none, |l| l % 2 != odd)).sum()
    };
    let worth = scores[best] < (1.0 - WORTH) * without;
    if !worth {
        return None;
    }
    twists = smoothed(&corrections(tracks, start, &solution, &twists, |_| true), WINDOWS[best]);
    center(&mut twists);
    let solution = motion::solve(tracks, &moved(start, &twists), radius)?;
    Some((solution.motion, twists))
}

pub(crate) fn isometry(twist: &Twist) -> Isometry {
    let [a, b, c, x, y, z] = *twist;
    Isometry::new(rotation_from_vector(DVec3::new(a, b, c)), DVec3::new(x, y, z))
}

fn moved(start: &[Isometry], twists: &[Twist]) -> Vec<Isometry> {
    start.iter().zip(twists).map(|(pose, twist)| pose.compose(&isometry(twist))).collect()
}

/// Takes the mean from the corrections: it belongs to the landmarks at rest.
fn center(twists: &mut [Twist]) {
    for k in 0..6 {
        let mean = twists.iter().map(|t| t[k]).sum::<f64>() / twists.len().max(1) as f64;
        for twist in &mut *twists {
            twist[k] -= mean;
        }
    }
}

/// ∂(ω × p + t)/∂(ω, t), row by row.
fn twist_rows(p: DVec3) -> [[f64; 6]; 3] {
    [[0.0, p.z, -p.y, 1.0, 0.0, 0.0], [-p.z, 0.0, p.x, 0.0, 1.0, 0.0], [p.y, -p.x, 0.0, 0.0, 0.0, 1.0]]
}

fn weight(r: DVec2, sigma: f64) -> f64 {
    1.0 / (sigma * sigma) / (1.0 + r.length_squared() / (2.0 * (OUTLIER * sigma).powi(2)))
}

/// The correction of each frame from the landmarks that `used` takes.
fn corrections(
    tracks: &[Track],
    start: &[Isometry],
    solution: &Solution,
    from: &[Twist],
    used: impl Fn(usize) -> bool + Sync,
) -> Vec<Twist> {
    let of = |i: usize| {
        let places = motion::landmarks_at(&solution.motion, &tracks[i].activations);
        let mut pose = isometry(&from[i]);
        for _ in 0..4 {
            let (mut left, mut right) = (Matrix6::<f64>::zeros(), Vector6::<f64>::zeros());
            let camera = start[i];
            for l in (0..68).filter(|&l| used(l)) {
                let in_head = pose.transform_point(places[l]);
                let Some((r, by_place)) = residual(&tracks[i], l, camera.transform_point(in_head)) else { continue };
                let w = weight(r, solution.sigmas_px[l]);
                let rows = twist_rows(in_head);
                for (r, by_place) in r.to_array().into_iter().zip(by_place) {
                    let g = camera.rotation.transpose() * by_place;
                    let row = Vector6::from_fn(|k, _| g.x * rows[0][k] + g.y * rows[1][k] + g.z * rows[2][k]);
                    left += w * row * row.transpose();
                    right -= w * r * row;
                }
            }
            // Weak: it decides only where landmarks are few.
            let so_far = twist_of(&pose);
            for k in 0..6 {
                let prior = EXPECTED[usize::from(k > 2)].powi(-2);
                left[(k, k)] += prior;
                right[k] -= prior * so_far[k];
            }
            let Some(step) = left.cholesky().map(|c| c.solve(&right)) else { break };
            if !step.iter().all(|v| v.is_finite()) {
                break;
            }
            pose = isometry(&step.into()).compose(&pose);
        }
        let twist = twist_of(&pose);
        if twist.iter().all(|v| v.is_finite()) { twist } else { from[i] }
    };
    (0..tracks.len()).into_par_iter().map(of).collect()
}

pub(crate) fn twist_of(pose: &Isometry) -> Twist {
    let q = glam::DQuat::from_mat3(&pose.rotation);
    let turn = q.normalize().to_scaled_axis();
    [turn.x, turn.y, turn.z, pose.translation.x, pose.translation.y, pose.translation.z]
}

/// Robust squared residuals, in standard deviations, of the landmarks that `used` takes.
fn error(
    tracks: &[Track],
    start: &[Isometry],
    solution: &Solution,
    twists: &[Twist],
    used: impl Fn(usize) -> bool + Sync,
) -> f64 {
    let of = |i: usize| -> f64 {
        let places = motion::landmarks_at(&solution.motion, &tracks[i].activations);
        let pose = start[i].compose(&isometry(&twists[i]));
        let one = |l: usize| {
            let (r, _) = residual(&tracks[i], l, pose.transform_point(places[l]))?;
            // In pixels, saturating at four.
            Some(r.length_squared().min(16.0))
        };
        (0..68).filter(|&l| used(l)).filter_map(one).sum()
    };
    (0..tracks.len()).into_par_iter().map(of).collect::<Vec<_>>().iter().sum()
}

/// Corrections smoothed by a line through the neighbours of each frame, with weights that fall to 0 at `window` + 1.
fn smoothed(twists: &[Twist], window: usize) -> Vec<Twist> {
    let at = |i: usize| -> Twist {
        let range = i.saturating_sub(window)..(i + window + 1).min(twists.len());
        let (mut sum, mut first, mut second) = (0.0, 0.0, 0.0);
        let (mut values, mut slopes) = ([0.0; 6], [0.0; 6]);
        for j in range {
            let d = j as f64 - i as f64;
            let w = (1.0 - (d / (window + 1) as f64).powi(2)).powi(2);
            sum += w;
            first += w * d;
            second += w * d * d;
            (0..6).for_each(|k| {
                values[k] += w * twists[j][k];
                slopes[k] += w * d * twists[j][k];
            });
        }
        let determinant = sum * second - first * first;
        std::array::from_fn(|k| {
            if determinant > 1e-9 { (second * values[k] - first * slopes[k]) / determinant } else { values[k] / sum }
        })
    };
    (0..twists.len()).map(at).collect()
}

/// The correction of any frame: its own, or one between those of the tracked frames before and behind it.
fn between(at: &[usize], twists: &[Twist], frame: usize) -> Option<Twist> {
    let behind = at.partition_point(|&f| f < frame);
    let last = at.len().checked_sub(1)?;
    if behind > last || behind == 0 || at[behind] == frame {
        return twists.get(behind.min(last)).copied();
    }
    let (a, b) = (at[behind - 1], at[behind]);
    let share = (frame - a) as f64 / (b - a) as f64;
    Some(std::array::from_fn(|k| twists[behind - 1][k] * (1.0 - share) + twists[behind][k] * share))
}
