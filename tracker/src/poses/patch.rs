//! A small patch of one picture found again in another, to a fraction of a pixel.
//!
//! Inverse compositional Lucas–Kanade under a warp that is predicted from the cameras: the derivatives of the patch are
//! taken once, each step only reads the other picture. Means and deviations of both are made equal in each step, so that
//! exposure does not matter. The weight falls towards the patch's edge.
//!
//! ```text
//! e(d) = (I(t + W d) − mean I) · σ_T / σ_I − (T(d) − mean T)
//! δ    = (Σ w g gᵀ)⁻¹ Σ w g e,      t ← t − W δ            (g: the patch's gradient)
//! ```
//!
//! The affine form has six unknowns, `g` times (1, dx, dy), and corrects `W` too.

use glam::{DMat2, DVec2};
use nalgebra::{Matrix6, Vector6};

use super::picture::Picture;

/// A patch is the same in two pictures that are far apart in time where it correlates at least this much.
pub(crate) const SAME: f32 = 0.85;
/// Half the side of a patch less the middle pixel.
const RADIUS: usize = 6;
const SIDE: usize = 2 * RADIUS + 1;
const AREA: usize = SIDE * SIDE;
/// Steps at most.
const ROUNDS: usize = 20;
/// A step below this ends the search, pixels of the level.
const SMALL_PX: f32 = 0.004;
/// Patches of less contrast are no landmark: deviation in grey values × 16.
const LEAST_DEVIATION: f32 = 3.0 * 16.0;

/// A patch to be found.
#[derive(Clone, Debug)]
pub(crate) struct Template {
    level: usize,
    /// Value less the mean, and the gradient times the weight.
    values: Vec<f32>,
    by_x: Vec<f32>,
    by_y: Vec<f32>,
    /// Inverse of the weighted sum of gradient products.
    inverse: [f32; 3],
    inverse_affine: Option<Box<Matrix6<f32>>>,
    deviation: f32,
    /// Smaller eigenvalue of the structure tensor over the weights: grey values × 16 per pixel, squared.
    pub(crate) strength: f32,
}

/// Where a patch was found.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Match {
    /// Its middle, full-size pixels.
    pub(crate) centre: DVec2,
    /// Normalised correlation with the patch, −1 … 1.
    pub(crate) similarity: f32,
}

fn offset(i: usize) -> (f32, f32) {
    ((i % SIDE) as f32 - RADIUS as f32, (i / SIDE) as f32 - RADIUS as f32)
}

fn weights() -> [f32; AREA] {
    std::array::from_fn(|i| {
        let (dx, dy) = offset(i);
        (-(dx * dx + dy * dy) / (2.0 * 4.0 * 4.0)).exp()
    })
}

impl Template {
    /// Cuts the patch around `centre` (full-size pixels); `None` near the border and without texture.
    pub(crate) fn cut(picture: &Picture, level: usize, centre: DVec2, affine: bool) -> Option<Self> {
        let level = level.max(picture.finest());
        let source = picture.level(level);
        let s = f64::from(1u32 << level);
        let (cx, cy) = ((centre.x / s) as f32, (centre.y / s) as f32);
        let reach = RADIUS as f32 + 1.0;
        if !centre.is_finite() || !source.holds([cx - reach, cx + reach], [cy - reach, cy + reach]) {
            return None;
        }
        let weights = weights();
        let total: f32 = weights.iter().sum();
        let mut values = Vec::with_capacity(AREA);
        let (mut by_x, mut by_y) = (Vec::with_capacity(AREA), Vec::with_capacity(AREA));
        let mut mean = 0.0;
        for (i, w) in weights.iter().enumerate() {
            let (dx, dy) = offset(i);
            let (x, y) = (cx + dx, cy + dy);
            let value = source.at(x, y);
            mean += w * value;
            values.push(value);
            by_x.push((source.at(x + 1.0, y) - source.at(x - 1.0, y)) * 0.5);
            by_y.push((source.at(x, y + 1.0) - source.at(x, y - 1.0)) * 0.5);
        }
        mean /= total;
        let mut square = 0.0;
        let mut h = [0.0f32; 3];
        let mut full = Matrix6::<f32>::zeros();
        for (i, w) in weights.iter().enumerate() {
            values[i] -= mean;
            square += w * values[i] * values[i];
            let (gx, gy) = (by_x[i], by_y[i]);
            h[0] += w * gx * gx;
            h[1] += w * gx * gy;
            h[2] += w * gy * gy;
            if affine {
                let g = affine_row(i, gx, gy);
                full += g * g.transpose() * *w;
            }
            by_x[i] *= w;
            by_y[i] *= w;
        }
        let deviation = (square / total).sqrt();
        let strength = (0.5 * (h[0] + h[2]) - (0.25 * (h[0] - h[2]).powi(2) + h[1] * h[1]).sqrt()) / total;
        let determinant = h[0] * h[2] - h[1] * h[1];
        if deviation < LEAST_DEVIATION || determinant <= 1e-3 * (h[0] + h[2]).powi(2) {
            return None;
        }
        let inverse = [h[2] / determinant, -h[1] / determinant, h[0] / determinant];
        let inverse_affine = if affine { Some(Box::new(full.try_inverse()?)) } else { None };
        Some(Self { level, values, by_x, by_y, inverse, inverse_affine, deviation, strength })
    }

    /// Finds the patch near `start` (full-size pixels) where offsets in it become `warp` times themselves.
    ///
    /// `None` where it runs over the border or does not settle.
    pub(crate) fn find(&self, picture: &Picture, start: DVec2, warp: DMat2) -> Option<Match> {
        self.search(picture, start, warp, false)
    }

    /// The same while the warp is corrected too; the template has to be cut for it.
    pub(crate) fn find_affine(&self, picture: &Picture, start: DVec2, warp: DMat2) -> Option<Match> {
        self.search(picture, start, warp, true)
    }

    fn search(&self, picture: &Picture, start: DVec2, warp: DMat2, affine: bool) -> Option<Match> {
        let inverse_affine = if affine { Some(self.inverse_affine.as_deref()?) } else { None };
        let target = picture.level(self.level);
        let s = f64::from(1u32 << self.level);
        let (mut tx, mut ty) = ((start.x / s) as f32, (start.y / s) as f32);
        let mut w = warp.as_mat2();
        let weights = weights();
        let total: f32 = weights.iter().sum();
        let mut read = [0.0f32; AREA];
        for round in 0..ROUNDS {
            let reach = RADIUS as f32;
            let (rx, ry) =
                (reach * (w.x_axis.x.abs() + w.y_axis.x.abs()), reach * (w.x_axis.y.abs() + w.y_axis.y.abs()));
            let finite = tx.is_finite() && ty.is_finite();
            if !finite || !target.holds([tx - rx, tx + rx], [ty - ry, ty + ry]) {
                return None;
            }
            let (mut mean, mut square) = (0.0, 0.0);
            for (i, value) in read.iter_mut().enumerate() {
                let (dx, dy) = offset(i);
                *value = target.at(tx + w.x_axis.x * dx + w.y_axis.x * dy, ty + w.x_axis.y * dx + w.y_axis.y * dy);
                mean += weights[i] * *value;
                square += weights[i] * *value * *value;
            }
            mean /= total;
            let deviation = (square / total - mean * mean).max(1.0).sqrt();
            let gain = self.deviation / deviation;
            let step = if let Some(inverse) = inverse_affine {
                let mut b = Vector6::<f32>::zeros();
                for (i, value) in read.iter().enumerate() {
                    let e = (value - mean) * gain - self.values[i];
                    b += affine_row(i, self.by_x[i], self.by_y[i]) * e;
                }
                let d = inverse * b;
                // The patch's own warp d ↦ d + δ + A d is undone: W ← W (I + A)⁻¹.
                let a = glam::Mat2::from_cols(glam::Vec2::new(1.0 + d[2], d[3]), glam::Vec2::new(d[4], 1.0 + d[5]));
                if a.determinant() < 0.3 {
                    return None;
                }
                w *= a.inverse();
                glam::Vec2::new(d[0], d[1])
            } else {
                let (mut bx, mut by) = (0.0, 0.0);
                for (i, value) in read.iter().enumerate() {
                    let e = (value - mean) * gain - self.values[i];
                    bx += self.by_x[i] * e;
                    by += self.by_y[i] * e;
                }
                glam::Vec2::new(
                    self.inverse[0] * bx + self.inverse[1] * by,
                    self.inverse[1] * bx + self.inverse[2] * by,
                )
            };
            let step = w * step;
            // A leap means that the patch is not here.
            if step.length() > 2.0 * RADIUS as f32 {
                return None;
            }
            tx -= step.x;
            ty -= step.y;
            if step.length() < SMALL_PX || round + 1 == ROUNDS {
                if step.length() > 0.1 {
                    return None;
                }
                let both: f32 = (0..AREA).map(|i| weights[i] * (read[i] - mean) * self.values[i]).sum();
                let similarity = both / (total * deviation * self.deviation);
                return Some(Match { centre: DVec2::new(f64::from(tx), f64::from(ty)) * s, similarity });
            }
        }
        None
    }
}

fn affine_row(i: usize, gx: f32, gy: f32) -> Vector6<f32> {
    let (dx, dy) = offset(i);
    Vector6::new(gx, gy, gx * dx, gy * dx, gx * dy, gy * dy)
}

#[cfg(test)]
#[path = "patch_tests.rs"]
mod tests;
