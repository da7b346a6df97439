//! Bundle adjustment of key frames: poses, points and the lens together.
//!
//! Levenberg–Marquardt on Cauchy-weighted pixels. Points are eliminated (3×3 blocks), what is left is one dense system of
//! 6 numbers a frame and up to 5 of the lens, which a Cholesky factorisation solves. A weak prior on every pose holds the
//! seven numbers that no picture tells (place, turn and size of the world), and one on the lens what these pictures do
//! not tell.

use glam::{DVec2, DVec3};
use nalgebra::{DMatrix, DVector, Matrix2, Matrix2x3, Matrix3, SMatrix, Vector2, Vector3};
use rayon::prelude::*;
use risorius_formats::{Intrinsics, Isometry};

use super::triangulate::median;
use crate::se3::{self, Twist};

/// Numbers of the lens: focal length, centre x and y, k1, k2.
pub(crate) const LENS: usize = 5;
/// Residuals beyond this many deviations count less and less.
const CAUCHY: f64 = 2.0;
/// Points per partial sum is the number of points over this: fixed, so that threads do not change the result.
const PARTS: usize = 8;
/// Deviation of the prior on poses: radians, and shares of the distance to the points.
const POSE_SIGMA: f64 = 0.3;

/// One point seen in one frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Observation {
    /// Index of the frame's pose.
    pub(crate) frame: usize,
    /// Index of the point.
    pub(crate) point: usize,
    /// Where it is seen, pixels.
    pub(crate) pixel: DVec2,
}

/// What is adjusted. Observations stand in the order of their points.
#[derive(Clone, Debug)]
pub(crate) struct Scene {
    /// The one lens.
    pub(crate) lens: Intrinsics,
    /// `camera_from_world` of each frame.
    pub(crate) poses: Vec<Isometry>,
    /// Points in the world.
    pub(crate) points: Vec<DVec3>,
    /// What was seen.
    pub(crate) observations: Vec<Observation>,
}

/// Which numbers of the lens may change, and how far they may be from where they are: deviations; 0 holds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct LensPrior(pub(crate) [f64; LENS]);

/// How an adjustment ended.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Outcome {
    /// Robust loss in squared deviations.
    pub(crate) loss: f64,
    /// Median distance of a point from where it is seen, pixels.
    pub(crate) median_error_px: f64,
    /// Deviations of the lens numbers, from noise alone; 0 for those held.
    pub(crate) lens_sigma: [f64; LENS],
}

type Pose = SMatrix<f64, 2, 6>;
type Lens = SMatrix<f64, 2, LENS>;

struct Linear {
    value: Vector2<f64>,
    weight: f64,
    by_pose: Pose,
    by_point: Matrix2x3<f64>,
    by_lens: Lens,
}

/// The numbers of a lens that the adjustment knows.
fn numbers(lens: &Intrinsics) -> [f64; LENS] {
    [lens.fx, lens.cx, lens.cy, lens.distortion.radial[0], lens.distortion.radial[1]]
}

fn with_step(lens: &Intrinsics, step: &[f64]) -> Intrinsics {
    let mut lens = *lens;
    // Both focal lengths keep their ratio.
    let ratio = lens.fy / lens.fx;
    lens.fx += step[0];
    lens.fy = lens.fx * ratio;
    lens.cx += step[1];
    lens.cy += step[2];
    lens.distortion.radial[0] += step[3];
    lens.distortion.radial[1] += step[4];
    lens
}

fn linear(lens: &Intrinsics, pose: &Isometry, point: DVec3, pixel: DVec2, sigma_px: f64) -> Option<Linear> {
    let p = pose.transform_point(point);
    if p.z <= 1e-9 {
        return None;
    }
    let iz = 1.0 / p.z;
    let (x, y) = (p.x * iz, p.y * iz);
    let r2 = x * x + y * y;
    let [k1, k2, k3] = lens.distortion.radial;
    let d = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
    let slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2));
    // Tangential and rational terms are left out of the derivative only: it changes the steps, not where they end.
    let focal = Vector2::new(lens.fx, lens.fy) / sigma_px;
    let bent = Matrix2::new(
        focal.x * (d + slope * x * x),
        focal.x * slope * x * y,
        focal.y * slope * x * y,
        focal.y * (d + slope * y * y),
    );
    let flat = Matrix2x3::new(iz, 0.0, -x * iz, 0.0, iz, -y * iz);
    let by_camera = bent * flat;
    let cross = Matrix3::new(0.0, p.z, -p.y, -p.z, 0.0, p.x, p.y, -p.x, 0.0);
    let mut by_pose = Pose::zeros();
    by_pose.fixed_columns_mut::<3>(0).copy_from(&(by_camera * cross));
    by_pose.fixed_columns_mut::<3>(3).copy_from(&by_camera);
    let s = 1.0 / sigma_px;
    let ratio = lens.fy / lens.fx;
    let by_lens = Lens::from_row_slice(&[
        d * x * s,
        s,
        0.0,
        focal.x * x * r2,
        focal.x * x * r2 * r2,
        d * y * s * ratio,
        0.0,
        s,
        focal.y * y * r2,
        focal.y * y * r2 * r2,
    ]);
    let seen = lens.project(p);
    let value = Vector2::new(seen.x - pixel.x, seen.y - pixel.y) / sigma_px;
    let weight = 1.0 / (1.0 + value.norm_squared() / (CAUCHY * CAUCHY));
    let rotation = Matrix3::from_column_slice(&pose.rotation.to_cols_array());
    Some(Linear { value, weight, by_pose, by_point: by_camera * rotation, by_lens })
}

fn loss_of(squared: f64) -> f64 {
    let c2 = CAUCHY * CAUCHY;
    c2 * (squared / c2).ln_1p()
}

/// A part of the reduced system, and what is needed to step the points.
struct Part {
    h: DMatrix<f64>,
    g: DVector<f64>,
    points: Vec<PointPart>,
}

struct PointPart {
    inverse: Matrix3<f64>,
    g: Vector3<f64>,
    /// Rows of the camera system times the point: frame index and block.
    poses: Vec<(usize, SMatrix<f64, 6, 3>)>,
    lens: SMatrix<f64, LENS, 3>,
}

impl Scene {
    /// Ranges of observations of each point.
    fn ranges(&self) -> Vec<std::ops::Range<usize>> {
        let mut ranges = vec![0..0; self.points.len()];
        let mut start = 0;
        for group in self.observations.chunk_by(|a, b| a.point == b.point) {
            ranges[group[0].point] = start..start + group.len();
            start += group.len();
        }
        ranges
    }

    /// Distances between where points are seen and where they project, pixels.
    pub(crate) fn errors_px(&self) -> Vec<f64> {
        self.observations
            .iter()
            .map(|o| {
                let p = self.poses[o.frame].transform_point(self.points[o.point]);
                if p.z <= 1e-9 { f64::INFINITY } else { self.lens.project(p).distance(o.pixel) }
            })
            .collect()
    }

    /// Adjusts everything; residuals are counted in `sigma_px`.
    pub(crate) fn adjust(&mut self, prior: LensPrior, sigma_px: f64, rounds: usize) -> Outcome {
        let start = Start {
            lens: numbers(&self.lens),
            poses: self.poses.clone(),
            pose_sigma: self.pose_sigma(),
            prior,
            sigma_px,
            ranges: self.ranges(),
        };
        let mut loss = self.loss(&start);
        let mut damping = 1e-4;
        for _ in 0..rounds {
            let Some(next) = self.step(&start, damping) else {
                damping *= 10.0;
                if damping > 1e6 {
                    break;
                }
                continue;
            };
            let next_loss = next.loss(&start);
            if next_loss <= loss {
                let gain = loss - next_loss;
                *self = next;
                loss = next_loss;
                damping = (damping * 0.2).max(1e-10);
                if gain <= 1e-7 * loss {
                    break;
                }
            } else {
                damping *= 10.0;
                if damping > 1e6 {
                    break;
                }
            }
        }
        let mut errors = self.errors_px();
        Outcome {
            loss,
            median_error_px: median(&mut errors).unwrap_or(0.0),
            lens_sigma: self.lens_sigma(&start).unwrap_or([f64::INFINITY; LENS]),
        }
    }

    fn pose_sigma(&self) -> [f64; 6] {
        let mut depths: Vec<f64> =
            self.observations.iter().map(|o| self.poses[o.frame].transform_point(self.points[o.point]).z).collect();
        let depth = median(&mut depths).unwrap_or(1.0).abs().max(1e-6);
        std::array::from_fn(|i| if i < 3 { POSE_SIGMA } else { POSE_SIGMA * depth })
    }

    fn loss(&self, start: &Start) -> f64 {
        let seen: f64 = self
            .observations
            .iter()
            .map(|o| {
                let p = self.poses[o.frame].transform_point(self.points[o.point]);
                if p.z <= 1e-9 {
                    return 1e6;
                }
                loss_of((self.lens.project(p).distance(o.pixel) / start.sigma_px).powi(2))
            })
            .sum();
        let strayed: f64 = self.poses.iter().enumerate().map(|(i, p)| start.deviations(i, p).norm_squared()).sum();
        let lens = numbers(&self.lens);
        let bent: f64 = (0..LENS)
            .filter(|&i| start.prior.0[i] > 0.0)
            .map(|i| ((lens[i] - start.lens[i]) / start.prior.0[i]).powi(2))
            .sum();
        seen + strayed + bent
    }

    /// The system of poses and lens with the points eliminated.
    fn reduced(&self, start: &Start, damping: f64) -> (DMatrix<f64>, DVector<f64>, Vec<Part>) {
        let n = 6 * self.poses.len() + LENS;
        let chunk = self.points.len().div_ceil(PARTS).max(1);
        let parts: Vec<Part> =
            start.ranges.par_chunks(chunk).map(|ranges| self.part(ranges, start.sigma_px, damping)).collect();
        let mut h = DMatrix::<f64>::zeros(n, n);
        let mut g = DVector::<f64>::zeros(n);
        for part in &parts {
            h += &part.h;
            g += &part.g;
        }
        for (i, pose) in self.poses.iter().enumerate() {
            let deviations = start.deviations(i, pose);
            for k in 0..6 {
                h[(6 * i + k, 6 * i + k)] += start.pose_sigma[k].powi(-2);
                g[6 * i + k] += deviations[k] / start.pose_sigma[k];
            }
        }
        let lens = numbers(&self.lens);
        for (k, value) in lens.iter().enumerate() {
            let at = n - LENS + k;
            let sigma = start.prior.0[k];
            if sigma > 0.0 {
                h[(at, at)] += sigma.powi(-2);
                g[at] += (value - start.lens[k]) / (sigma * sigma);
            } else {
                h.row_mut(at).fill(0.0);
                h.column_mut(at).fill(0.0);
                h[(at, at)] = 1.0;
                g[at] = 0.0;
            }
        }
        (h, g, parts)
    }

    fn step(&self, start: &Start, damping: f64) -> Option<Self> {
        let n = 6 * self.poses.len() + LENS;
        let (mut h, g, parts) = self.reduced(start, damping);
        for i in 0..n {
            h[(i, i)] *= 1.0 + damping;
        }
        let step = -h.cholesky()?.solve(&g);
        if !step.iter().all(|v| v.is_finite()) {
            return None;
        }
        let lens_step: [f64; LENS] = std::array::from_fn(|k| step[n - LENS + k]);
        let mut next = self.clone();
        next.lens = with_step(&self.lens, &lens_step);
        for (i, pose) in next.poses.iter_mut().enumerate() {
            let twist = Twist::from_array(std::array::from_fn(|k| step[6 * i + k]));
            *pose = se3::exp(twist).compose(pose);
        }
        let lens_step = SMatrix::<f64, LENS, 1>::from_column_slice(&lens_step);
        for (point, part) in next.points.iter_mut().zip(parts.iter().flat_map(|p| &p.points)) {
            let mut right = part.g + part.lens.transpose() * lens_step;
            for (frame, block) in &part.poses {
                right += block.transpose() * step.fixed_rows::<6>(6 * frame);
            }
            let moved = part.inverse * right;
            *point -= DVec3::new(moved.x, moved.y, moved.z);
        }
        (next.lens.fx > 0.0).then_some(next)
    }

    fn part(&self, ranges: &[std::ops::Range<usize>], sigma_px: f64, damping: f64) -> Part {
        let n = 6 * self.poses.len() + LENS;
        let mut part = Part { h: DMatrix::zeros(n, n), g: DVector::zeros(n), points: Vec::with_capacity(ranges.len()) };
        for range in ranges {
            let mut v = Matrix3::<f64>::zeros();
            let mut g = Vector3::<f64>::zeros();
            let mut poses: Vec<(usize, SMatrix<f64, 6, 3>)> = Vec::with_capacity(range.len());
            let mut lens = SMatrix::<f64, LENS, 3>::zeros();
            for o in &self.observations[range.clone()] {
                let Some(l) = linear(&self.lens, &self.poses[o.frame], self.points[o.point], o.pixel, sigma_px) else {
                    continue;
                };
                let at = 6 * o.frame;
                let pose_w = l.by_pose.transpose() * l.weight;
                let lens_w = l.by_lens.transpose() * l.weight;
                let point_w = l.by_point.transpose() * l.weight;
                let mut block = part.h.fixed_view_mut::<6, 6>(at, at);
                block += pose_w * l.by_pose;
                let across = lens_w * l.by_pose;
                let mut block = part.h.fixed_view_mut::<LENS, 6>(n - LENS, at);
                block += across;
                let mut block = part.h.fixed_view_mut::<6, LENS>(at, n - LENS);
                block += across.transpose();
                let mut block = part.h.fixed_view_mut::<LENS, LENS>(n - LENS, n - LENS);
                block += lens_w * l.by_lens;
                let mut rows = part.g.fixed_rows_mut::<6>(at);
                rows += pose_w * l.value;
                let mut rows = part.g.fixed_rows_mut::<LENS>(n - LENS);
                rows += lens_w * l.value;
                v += point_w * l.by_point;
                g += point_w * l.value;
                lens += lens_w * l.by_point;
                poses.push((o.frame, pose_w * l.by_point));
            }
            for k in 0..3 {
                v[(k, k)] += damping * v[(k, k)] + 1e-9;
            }
            let inverse = v.try_inverse().unwrap_or_else(Matrix3::zeros);
            let lens_left = lens * inverse;
            let mut block = part.h.fixed_view_mut::<LENS, LENS>(n - LENS, n - LENS);
            block -= lens_left * lens.transpose();
            let mut rows = part.g.fixed_rows_mut::<LENS>(n - LENS);
            rows -= lens_left * g;
            for (i, block_i) in &poses {
                let left = block_i * inverse;
                let mut rows = part.g.fixed_rows_mut::<6>(6 * i);
                rows -= left * g;
                let across = left * lens.transpose();
                let mut block = part.h.fixed_view_mut::<6, LENS>(6 * i, n - LENS);
                block -= across;
                let mut block = part.h.fixed_view_mut::<LENS, 6>(n - LENS, 6 * i);
                block -= across.transpose();
                for (j, block_j) in &poses {
                    let mut block = part.h.fixed_view_mut::<6, 6>(6 * i, 6 * j);
                    block -= left * block_j.transpose();
                }
            }
            part.points.push(PointPart { inverse, g, poses, lens });
        }
        part
    }

    /// Deviations of the lens numbers where everything else is free to follow them.
    fn lens_sigma(&self, start: &Start) -> Option<[f64; LENS]> {
        let n = 6 * self.poses.len() + LENS;
        let factor = self.reduced(start, 0.0).0.cholesky()?;
        let mut sigma = [0.0; LENS];
        for (k, value) in sigma.iter_mut().enumerate() {
            if start.prior.0[k] > 0.0 {
                let mut unit = DVector::zeros(n);
                unit[n - LENS + k] = 1.0;
                *value = factor.solve(&unit)[n - LENS + k].max(0.0).sqrt();
            }
        }
        Some(sigma)
    }
}

/// Where an adjustment began.
struct Start {
    lens: [f64; LENS],
    poses: Vec<Isometry>,
    pose_sigma: [f64; 6],
    prior: LensPrior,
    sigma_px: f64,
    ranges: Vec<std::ops::Range<usize>>,
}

impl Start {
    fn deviations(&self, i: usize, pose: &Isometry) -> SMatrix<f64, 6, 1> {
        let twist = se3::log(&pose.compose(&self.poses[i].inverse())).to_array();
        SMatrix::from_fn(|k, _| twist[k] / self.pose_sigma[k])
    }
}

#[cfg(test)]
#[path = "adjust_tests.rs"]
mod tests;
