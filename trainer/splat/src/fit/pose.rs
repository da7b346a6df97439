//! The head's poses: one Newton step each time that an image is looked at.
//!
//! A fit sees an image a few times only, too seldom for small steps along a gradient. The gradient is the kernels'; the
//! curvature is Gauss–Newton's (Lucas and Kanade), `Σ w ∇T ∂u/∂ξ (∇T ∂u/∂ξ)ᵀ` over the pixels of a sphere about the skull, with
//! the gradient of the picture itself: sharper than what is drawn, so that steps are rather too short than too long.

use glam::DVec3;
use nalgebra::{Matrix6, Vector6};
use risorius_formats::{Camera, Isometry};

use crate::raster::{CHARBONNIER, RowNumbers, Target};
use crate::scene::rotation_from_vector;

/// Every so many pixels along a row and a column is asked.
const STRIDE: usize = 3;
/// What a pose is held by where its picture says nothing: its expected correction, metres and radians.
const EXPECTED: [f64; 2] = [0.003, 0.01];
/// Errors of neighbouring pixels go together: this many count as one.
const TOGETHER: f64 = 100.0;
/// Share of a Newton step that is gone.
const SHARE: f64 = 0.5;
/// Most that a step moves, metres and radians.
const MOST: [f64; 2] = [0.003, 0.015];
/// The sphere that stands for the skull, against the face's radius: it begins at the face's middle.
const SKULL: f64 = 1.5;

/// One image of a step.
pub(super) struct Look<'a> {
    pub camera: &'a Camera,
    pub target: &'a Target<'a>,
    pub face_radius_m: f64,
    pub numbers: &'a RowNumbers,
}

/// The motion (room axes, about the origin) that takes a head's pose nearer to its least error; `slope` is ∂L of a shift and a
/// turn in camera axes, the turn about the origin.
pub(super) fn newton(look: &Look<'_>, slope: &[f32; 6]) -> Option<Isometry> {
    let pose = look.camera.camera_from_world;
    let mse = look.numbers.squared / (3 * look.numbers.pixels.max(1)) as f64;
    let weight = 1.0 / (mse + f64::from(CHARBONNIER).powi(2)).sqrt();
    let mut normal = look.curvature(pose.translation)? * weight;
    // Σ w r² of a pixel and channel, as if neighbours told the same.
    let noise = TOGETHER * weight * mse;
    for k in 0..6 {
        normal[(k, k)] += noise / EXPECTED[k / 3].powi(2);
    }
    let slope = Vector6::from_fn(|k, _| -f64::from(slope[k]));
    let xi = normal.cholesky()?.solve(&slope) * SHARE;
    let size = |from: usize| xi.rows(from, 3).norm().max(1e-12);
    let xi = xi * (MOST[0] / size(0)).min(MOST[1] / size(3)).min(1.0);
    if !xi.iter().all(|v| v.is_finite()) {
        return None;
    }
    let axes = pose.rotation.transpose();
    let (shift, turn) = (axes * DVec3::new(xi[0], xi[1], xi[2]), axes * DVec3::new(xi[3], xi[4], xi[5]));
    Some(Isometry::new(rotation_from_vector(turn), shift))
}

impl Look<'_> {
    /// Σ ∇T ∂u/∂ξ (∇T ∂u/∂ξ)ᵀ over the skull's pixels; turns are about `center` (camera axes).
    fn curvature(&self, center: DVec3) -> Option<Matrix6<f64>> {
        let i = &self.camera.intrinsics;
        let (w, h) = (i.width as usize, i.height as usize);
        let radius = SKULL * self.face_radius_m;
        let middle = self.camera.camera_from_world.transform_point(DVec3::Z * radius);
        let mut normal = Matrix6::zeros();
        let mut pixels = 0;
        for y in (1..h.saturating_sub(1)).step_by(STRIDE) {
            for x in (1..w.saturating_sub(1)).step_by(STRIDE) {
                let ray = DVec3::new((x as f64 + 0.5 - i.cx) / i.fx, (y as f64 + 0.5 - i.cy) / i.fy, 1.0);
                // Where the ray meets the sphere first.
                let (a, b) = (ray.length_squared(), ray.dot(middle));
                let inside = b * b - a * (middle.length_squared() - radius * radius);
                let z = (b - inside.max(0.0).sqrt()) / a;
                if inside <= 0.0 || z <= 0.05 {
                    continue;
                }
                let [left, right] = [self.target.color(x - 1, y), self.target.color(x + 1, y)];
                let [above, below] = [self.target.color(x, y - 1), self.target.color(x, y + 1)];
                let mut s = [0.0; 3];
                for c in 0..3 {
                    let gx = 0.5 * f64::from(right[c] - left[c]);
                    let gy = 0.5 * f64::from(below[c] - above[c]);
                    s = [s[0] + gx * gx, s[1] + gx * gy, s[2] + gy * gy];
                }
                let arm = ray * z - center;
                let shift = |d: DVec3| [i.fx * (d.x - ray.x * d.z) / z, i.fy * (d.y - ray.y * d.z) / z];
                let axes = [DVec3::X, DVec3::Y, DVec3::Z];
                let du: [[f64; 2]; 6] =
                    std::array::from_fn(|k| if k < 3 { shift(axes[k]) } else { shift(axes[k - 3].cross(arm)) });
                for k in 0..6 {
                    let along = [s[0] * du[k][0] + s[1] * du[k][1], s[1] * du[k][0] + s[2] * du[k][1]];
                    for l in 0..=k {
                        normal[(k, l)] += along[0] * du[l][0] + along[1] * du[l][1];
                    }
                }
                pixels += 1;
            }
        }
        (pixels > 20).then(|| normal * (STRIDE * STRIDE) as f64)
    }
}
