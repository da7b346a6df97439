//! The point model: 68 points in space as a mean and modes, seen by a camera far away.
//!
//! x_i = s · R₂ (M_i + V_i p) + t, with scale s, rotation R (its first two rows R₂), translation t (px) and coefficients p.
//! A fit makes Σ |x_i − seen_i|² + k Σ p_j² / λ_j least by Gauss–Newton (Saragih et al. 2011, IJCV 91), in half steps as
//! OpenFace. The file holds three matrices: M (204 × 1: all x, all y, all z), V (204 × modes), λ (1 × modes).

use std::path::Path;

use glam::{DMat3, DVec2, DVec3};
use nalgebra::{DMatrix, DVector};

use super::matrix::{self, Matrix, damaged};
use crate::error::Result;
use crate::se3::rotation_exp;

/// Points of a face.
pub const POINTS: usize = 68;
/// Coordinates of the points.
const COORDINATES: usize = 3 * POINTS;
/// Parameters before p: scale, rotation, translation.
const RIGID: usize = 6;
/// Share of a Gauss–Newton step that is gone.
const STEP: f64 = 0.5;
const MOST_STEPS: usize = 200;
/// The fit ends once so many steps made the error less than a thousandth smaller.
const IDLE_STEPS: usize = 3;
const IDLE: f64 = 0.999;

/// A point model.
#[derive(Clone, Debug)]
pub struct PointModel {
    mean: [DVec3; POINTS],
    /// Displacement of each point by each mode: `modes[j][i]`.
    modes: Vec<[DVec3; POINTS]>,
    variances: Vec<f64>,
}

/// Where a face is, and its shape.
#[derive(Clone, Debug, PartialEq)]
pub struct Fit {
    /// Pixels per unit of the model.
    pub scale: f64,
    /// `camera_from_model`.
    pub rotation: DMat3,
    /// Pixels.
    pub translation: DVec2,
    /// p.
    pub coefficients: Vec<f64>,
}

impl PointModel {
    /// Reads OpenFace's text file.
    pub fn read(path: &Path) -> Result<Self> {
        let matrices = matrix::read_text(path)?;
        let [mean, modes, variances, ..] = &matrices[..] else {
            let what = format!("has {} matrices; mean, modes and variances should be there", matrices.len());
            return Err(damaged(path, what).into());
        };
        Self::new(mean, modes, variances).map_err(|what| damaged(path, what).into())
    }

    fn new(mean: &Matrix, modes: &Matrix, variances: &Matrix) -> Result<Self, String> {
        let count = variances.values.len();
        if mean.values.len() != COORDINATES || (modes.rows, modes.columns) != (COORDINATES, count) {
            return Err(format!(
                "has a mean of {} numbers, modes of {} × {} and {count} variances; 204, 204 × n and n fit together",
                mean.values.len(),
                modes.rows,
                modes.columns
            ));
        }
        if variances.values.iter().any(|v| *v <= 0.0) {
            return Err("has a variance that is not above 0".to_owned());
        }
        let point = |at: &dyn Fn(usize) -> f64, i: usize| DVec3::new(at(i), at(i + POINTS), at(i + 2 * POINTS));
        let mean: [DVec3; POINTS] = std::array::from_fn(|i| point(&|k| mean.values[k], i));
        let mode = |j: usize| std::array::from_fn(|i| point(&|k| modes.values[k * count + j], i));
        let modes = (0..count).map(mode).collect();
        if mean[36].distance(mean[45]) < 1e-9 {
            return Err("has a mean whose outer eye corners coincide".to_owned());
        }
        Ok(Self { mean, modes, variances: variances.values.clone() })
    }

    /// Numbers that describe a shape: displacements and coefficients.
    pub fn numbers(&self) -> usize {
        COORDINATES + self.modes.len()
    }

    /// The mean shape from the front: x and y of each point.
    pub fn front(&self) -> [DVec2; POINTS] {
        self.mean.map(DVec3::truncate)
    }

    /// Distance of the outer eye corners of the mean shape.
    pub fn outer_eye_distance(&self) -> f64 {
        self.mean[36].distance(self.mean[45])
    }

    /// V p: all x, all y, all z.
    pub fn displacements(&self, coefficients: &[f64]) -> Vec<f64> {
        let moved: [DVec3; POINTS] = std::array::from_fn(|i| self.moved(i, coefficients));
        (0..3).flat_map(|axis| moved.map(|d| d[axis])).collect()
    }

    fn moved(&self, i: usize, coefficients: &[f64]) -> DVec3 {
        self.modes.iter().zip(coefficients).map(|(mode, p)| mode[i] * *p).sum()
    }

    /// The points of a fit in the picture.
    pub fn project(&self, fit: &Fit) -> [DVec2; POINTS] {
        std::array::from_fn(|i| {
            let point = self.mean[i] + self.moved(i, &fit.coefficients);
            (fit.rotation * point).truncate() * fit.scale + fit.translation
        })
    }

    /// Fits the model to 68 points, px; `stiffness` is k. `None` where the points have no extent or the fit fails.
    pub fn fit(&self, seen: &[DVec2; POINTS], stiffness: f64) -> Option<Fit> {
        self.refit(self.first_guess(seen)?, seen, stiffness)
    }

    /// The same from a fit that is near.
    pub fn refit(&self, mut fit: Fit, seen: &[DVec2; POINTS], stiffness: f64) -> Option<Fit> {
        let mut before = self.error(&fit, seen);
        let mut idle = 0;
        for _ in 0..MOST_STEPS {
            self.step(&mut fit, seen, stiffness)?;
            let error = self.error(&fit, seen);
            idle += usize::from(error > IDLE * before);
            if idle == IDLE_STEPS {
                break;
            }
            before = error;
        }
        let is_sane = fit.scale > 0.0 && fit.scale.is_finite() && fit.translation.is_finite();
        (is_sane && fit.coefficients.iter().all(|p| p.is_finite())).then_some(fit)
    }

    /// The mean shape, upright on the eyes, as large as the points and where they are.
    fn first_guess(&self, seen: &[DVec2; POINTS]) -> Option<Fit> {
        let eyes = seen[45] - seen[36];
        let center = |points: &[DVec2; POINTS]| points.iter().sum::<DVec2>() / POINTS as f64;
        let front = self.front();
        let size = |points: &[DVec2; POINTS]| {
            let middle = center(points);
            points.iter().map(|p| p.distance_squared(middle)).sum::<f64>().sqrt()
        };
        let scale = size(seen) / size(&front);
        let rotation = DMat3::from_rotation_z(eyes.y.atan2(eyes.x));
        let translation = center(seen) - (rotation * center(&front).extend(0.0)).truncate() * scale;
        let fit = Fit { scale, rotation, translation, coefficients: vec![0.0; self.modes.len()] };
        (scale > 1e-9 && scale.is_finite() && translation.is_finite()).then_some(fit)
    }

    fn error(&self, fit: &Fit, seen: &[DVec2; POINTS]) -> f64 {
        let points = self.project(fit);
        points.iter().zip(seen).map(|(a, b)| a.distance_squared(*b)).sum::<f64>().sqrt()
    }

    /// Half a step of Gauss–Newton.
    fn step(&self, fit: &mut Fit, seen: &[DVec2; POINTS], stiffness: f64) -> Option<()> {
        let count = RIGID + self.modes.len();
        let mut jacobian = DMatrix::<f64>::zeros(2 * POINTS, count);
        let mut residual = DVector::<f64>::zeros(2 * POINTS);
        for i in 0..POINTS {
            let point = self.mean[i] + self.moved(i, &fit.coefficients);
            let turned = (fit.rotation * point).truncate();
            let off = seen[i] - (turned * fit.scale + fit.translation);
            let mut put = |column: usize, by: DVec2| {
                jacobian[(i, column)] = by.x;
                jacobian[(i + POINTS, column)] = by.y;
            };
            put(0, turned);
            for (k, axis) in [DVec3::X, DVec3::Y, DVec3::Z].into_iter().enumerate() {
                put(1 + k, (fit.rotation * axis.cross(point)).truncate() * fit.scale);
            }
            put(4, DVec2::X);
            put(5, DVec2::Y);
            for (j, mode) in self.modes.iter().enumerate() {
                put(RIGID + j, (fit.rotation * mode[i]).truncate() * fit.scale);
            }
            residual[i] = off.x;
            residual[i + POINTS] = off.y;
        }
        let mut normal = jacobian.tr_mul(&jacobian);
        let mut right = jacobian.tr_mul(&residual);
        for (j, (p, variance)) in fit.coefficients.iter().zip(&self.variances).enumerate() {
            normal[(RIGID + j, RIGID + j)] += stiffness / variance;
            right[RIGID + j] -= stiffness / variance * p;
        }
        let update = normal.cholesky()?.solve(&right) * STEP;
        fit.scale += update[0];
        fit.rotation *= rotation_exp(DVec3::new(update[1], update[2], update[3]));
        fit.translation += DVec2::new(update[4], update[5]);
        fit.coefficients.iter_mut().enumerate().for_each(|(j, p)| *p += update[RIGID + j]);
        Some(())
    }
}

#[cfg(test)]
#[path = "point_model_tests.rs"]
mod tests;
