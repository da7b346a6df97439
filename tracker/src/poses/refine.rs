//! Poses of a rigid point set from its projections: Levenberg–Marquardt on one pose, and bundle adjustment of all poses
//! with the shape.
//!
//! Residuals are pixels divided by the noise of their landmark, under Cauchy weights. Poses are updated from the left,
//! `pose ← exp(δ) · pose`. The adjustment eliminates the poses (6×6 each) and solves for the shape (Schur complement). A
//! prior on the shape holds what views cannot tell: place, turn and size of the head frame, and, where the head hardly
//! turns, its depth.

use glam::{DVec2, DVec3};
use nalgebra::{DMatrix, DVector, Matrix2x3, Matrix2x6, Matrix3, Matrix6, SMatrix, Vector2, Vector3, Vector6};
use rayon::prelude::*;
use risorius_formats::{Intrinsics, Isometry};

use crate::se3::{self, Twist};

/// Residuals beyond this many deviations count less and less.
const CAUCHY: f64 = 2.0;
/// Frames per partial sum: fixed, so that the result does not depend on the number of threads.
const CHUNK: usize = 32;

/// A point of the rigid set.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RigidPoint {
    /// Index of the landmark.
    pub(crate) landmark: usize,
    /// Noise of its projections, pixels (standard deviation).
    pub(crate) sigma_px: f64,
}

/// Projections in one frame; `pixels[k]` belongs to the k-th rigid point.
#[derive(Clone, Debug)]
pub(crate) struct FrameView {
    pub(crate) pixels: Vec<DVec2>,
}

/// Residual (in deviations) and its derivatives by pose and point; `None` behind the camera.
fn residual(lens: &Intrinsics, pose: &Isometry, point: DVec3, pixel: DVec2, sigma: f64) -> Option<Linear> {
    let p = pose.transform_point(point);
    if p.z <= 1e-9 {
        return None;
    }
    let seen = lens.project(p);
    // Distortion is left out of the derivative only: it changes the steps a little, not where they end.
    let (fx, fy, iz) = (lens.fx / sigma, lens.fy / sigma, 1.0 / p.z);
    let by_camera = Matrix2x3::new(fx * iz, 0.0, -fx * p.x * iz * iz, 0.0, fy * iz, -fy * p.y * iz * iz);
    // d(exp(δ) p)/dδ = [−[p]×, I] for δ = (rotation, translation).
    let cross = Matrix3::new(0.0, p.z, -p.y, -p.z, 0.0, p.x, p.y, -p.x, 0.0);
    let mut by_pose = Matrix2x6::zeros();
    by_pose.fixed_columns_mut::<3>(0).copy_from(&(by_camera * cross));
    by_pose.fixed_columns_mut::<3>(3).copy_from(&by_camera);
    let rotation = Matrix3::from_column_slice(&pose.rotation.to_cols_array());
    let value = Vector2::new(seen.x - pixel.x, seen.y - pixel.y) / sigma;
    let weight = 1.0 / (1.0 + value.norm_squared() / (CAUCHY * CAUCHY));
    Some(Linear { value, weight, by_pose, by_point: by_camera * rotation })
}

struct Linear {
    value: Vector2<f64>,
    weight: f64,
    by_pose: Matrix2x6<f64>,
    by_point: Matrix2x3<f64>,
}

impl Linear {
    /// Cauchy's loss, in squared deviations.
    fn loss(&self) -> f64 {
        let c2 = CAUCHY * CAUCHY;
        c2 * (self.value.norm_squared() / c2).ln_1p()
    }
}

/// What is known about a pose beforehand.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Prior {
    /// The most likely pose.
    pub(crate) pose: Isometry,
    /// Deviations of the twist from it to the pose, rotation first.
    pub(crate) sigma: [f64; 6],
}

impl Prior {
    /// The twist from the prior to `pose`, in deviations.
    fn deviations(&self, pose: &Isometry) -> Vector6<f64> {
        let twist = se3::log(&pose.compose(&self.pose.inverse())).to_array();
        Vector6::from_fn(|i, _| twist[i] / self.sigma[i])
    }
}

fn frame_loss(lens: &Intrinsics, pose: &Isometry, shape: &[DVec3], points: &[RigidPoint], view: &FrameView) -> f64 {
    let loss = |(k, &pixel): (usize, &DVec2)| {
        residual(lens, pose, shape[k], pixel, points[k].sigma_px).map_or(1e6, |l| l.loss())
    };
    view.pixels.iter().enumerate().map(loss).sum()
}

fn moved(pose: &Isometry, step: &Vector6<f64>) -> Isometry {
    let step = Twist::from_array(std::array::from_fn(|i| step[i]));
    se3::exp(step).compose(pose)
}

/// The pose that fits the projections (and the prior) best, starting from `pose`.
pub(crate) fn refine_pose(
    lens: &Intrinsics,
    pose: Isometry,
    shape: &[DVec3],
    points: &[RigidPoint],
    view: &FrameView,
    prior: Option<&Prior>,
) -> Isometry {
    let total = |pose: &Isometry| {
        frame_loss(lens, pose, shape, points, view) + prior.map_or(0.0, |p| p.deviations(pose).norm_squared())
    };
    let mut pose = pose;
    let mut loss = total(&pose);
    let mut damping = 1e-4;
    for _ in 0..30 {
        let mut h = Matrix6::<f64>::zeros();
        let mut g = Vector6::<f64>::zeros();
        for (k, &pixel) in view.pixels.iter().enumerate() {
            let Some(l) = residual(lens, &pose, shape[k], pixel, points[k].sigma_px) else { continue };
            h += l.by_pose.transpose() * l.by_pose * l.weight;
            g += l.by_pose.transpose() * l.value * l.weight;
        }
        if let Some(prior) = prior {
            // The derivative of the twist by a small left step is the identity, next to the prior.
            let deviations = prior.deviations(&pose);
            for i in 0..6 {
                h[(i, i)] += 1.0 / (prior.sigma[i] * prior.sigma[i]);
                g[i] += deviations[i] / prior.sigma[i];
            }
        }
        let mut damped = h;
        for i in 0..6 {
            damped[(i, i)] += damping * h[(i, i)].max(1e-12);
        }
        let Some(step) = damped.cholesky().map(|c| -c.solve(&g)) else { break };
        let candidate = moved(&pose, &step);
        let next = total(&candidate);
        if next <= loss {
            let gain = loss - next;
            pose = candidate;
            loss = next;
            damping = (damping * 0.2).max(1e-9);
            if gain <= 1e-10 * (1.0 + loss) {
                break;
            }
        } else {
            damping *= 8.0;
            if damping > 1e6 {
                break;
            }
        }
    }
    pose
}

/// What the adjustment starts from and ends with.
pub(crate) struct Bundle<'a> {
    /// The still camera.
    pub(crate) lens: &'a Intrinsics,
    /// The rigid points.
    pub(crate) points: &'a [RigidPoint],
    /// Projections, frame by frame.
    pub(crate) views: &'a [FrameView],
    /// How far the shape may stray from where it began, world units (standard deviation of each coordinate).
    pub(crate) shape_sigma: f64,
}

impl Bundle<'_> {
    fn loss(&self, poses: &[Isometry], shape: &[DVec3], prior: &[DVec3]) -> f64 {
        let partial: Vec<f64> = poses
            .par_chunks(CHUNK)
            .zip(self.views.par_chunks(CHUNK))
            .map(|(poses, views)| {
                poses.iter().zip(views).map(|(pose, view)| frame_loss(self.lens, pose, shape, self.points, view)).sum()
            })
            .collect();
        let strayed: f64 = shape.iter().zip(prior).map(|(a, b)| a.distance_squared(*b)).sum();
        partial.iter().sum::<f64>() + strayed / (self.shape_sigma * self.shape_sigma)
    }

    /// Adjusts all poses and the shape; the prior is the shape that it starts from.
    pub(crate) fn adjust(&self, poses: &mut Vec<Isometry>, shape: &mut Vec<DVec3>, rounds: usize) {
        let prior = shape.clone();
        let mut loss = self.loss(poses, shape, &prior);
        let mut damping = 1e-4;
        for _ in 0..rounds {
            let Some((next_poses, next_shape)) = self.step(poses, shape, &prior, damping) else { break };
            let next = self.loss(&next_poses, &next_shape, &prior);
            if next <= loss {
                let gain = loss - next;
                *poses = next_poses;
                *shape = next_shape;
                loss = next;
                damping = (damping * 0.2).max(1e-9);
                if gain <= 1e-7 * loss {
                    break;
                }
            } else {
                damping *= 10.0;
                if damping > 1e4 {
                    break;
                }
            }
        }
    }

    /// One damped step.
    fn step(
        &self,
        poses: &[Isometry],
        shape: &[DVec3],
        prior: &[DVec3],
        damping: f64,
    ) -> Option<(Vec<Isometry>, Vec<DVec3>)> {
        let n = 3 * shape.len();
        let partial: Vec<Reduced> = poses
            .par_chunks(CHUNK)
            .zip(self.views.par_chunks(CHUNK))
            .map(|(poses, views)| self.reduce(poses, views, shape, damping))
            .collect();
        let mut h = DMatrix::<f64>::zeros(n, n);
        let mut g = DVector::<f64>::zeros(n);
        for part in &partial {
            h += &part.h;
            g += &part.g;
        }
        let hold = 1.0 / (self.shape_sigma * self.shape_sigma);
        for (k, (a, b)) in shape.iter().zip(prior).enumerate() {
            for c in 0..3 {
                h[(3 * k + c, 3 * k + c)] += hold;
                g[3 * k + c] += hold * (a[c] - b[c]);
            }
        }
        let step = -h.cholesky()?.solve(&g);
        let next_shape = shape
            .iter()
            .enumerate()
            .map(|(k, p)| *p + DVec3::new(step[3 * k], step[3 * k + 1], step[3 * k + 2]))
            .collect();
        let mut next_poses = Vec::with_capacity(poses.len());
        for (pose, frame) in poses.iter().zip(partial.iter().flat_map(|p| &p.frames)) {
            let mut right = frame.g;
            for (k, block) in frame.cross.iter().enumerate() {
                right += block * Vector3::new(step[3 * k], step[3 * k + 1], step[3 * k + 2]);
            }
            next_poses.push(moved(pose, &(-(frame.inverse * right))));
        }
        Some((next_poses, next_shape))
    }

    /// The normal equations of a few frames with their poses eliminated.
    fn reduce(&self, poses: &[Isometry], views: &[FrameView], shape: &[DVec3], damping: f64) -> Reduced {
        let n = shape.len();
        let mut sum = Reduced {
            h: DMatrix::zeros(3 * n, 3 * n),
            g: DVector::zeros(3 * n),
            frames: Vec::with_capacity(poses.len()),
        };
        for (pose, view) in poses.iter().zip(views) {
            let mut h = Matrix6::<f64>::zeros();
            let mut g = Vector6::<f64>::zeros();
            let mut cross = vec![SMatrix::<f64, 6, 3>::zeros(); n];
            for (k, &pixel) in view.pixels.iter().enumerate() {
                let Some(l) = residual(self.lens, pose, shape[k], pixel, self.points[k].sigma_px) else { continue };
                h += l.by_pose.transpose() * l.by_pose * l.weight;
                g += l.by_pose.transpose() * l.value * l.weight;
                cross[k] = l.by_pose.transpose() * l.by_point * l.weight;
                let own = l.by_point.transpose() * l.by_point * l.weight;
                let own_g = l.by_point.transpose() * l.value * l.weight;
                let mut block = sum.h.fixed_view_mut::<3, 3>(3 * k, 3 * k);
                block += own + Matrix3::from_diagonal(&own.diagonal()) * damping;
                let mut rows = sum.g.fixed_rows_mut::<3>(3 * k);
                rows += own_g;
            }
            for i in 0..6 {
                h[(i, i)] += damping * h[(i, i)] + 1e-12;
            }
            let inverse = h.try_inverse().unwrap_or_else(Matrix6::zeros);
            for i in 0..n {
                let left = cross[i].transpose() * inverse;
                let mut rows = sum.g.fixed_rows_mut::<3>(3 * i);
                rows -= left * g;
                for (j, right) in cross.iter().enumerate() {
                    let mut block = sum.h.fixed_view_mut::<3, 3>(3 * i, 3 * j);
                    block -= left * right;
                }
            }
            sum.frames.push(FrameStep { inverse, g, cross });
        }
        sum
    }
}

struct Reduced {
    h: DMatrix<f64>,
    g: DVector<f64>,
    frames: Vec<FrameStep>,
}

struct FrameStep {
    inverse: Matrix6<f64>,
    g: Vector6<f64>,
    cross: Vec<SMatrix<f64, 6, 3>>,
}

#[cfg(test)]
#[path = "refine_tests.rs"]
mod tests;
