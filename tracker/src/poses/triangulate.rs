//! A point's place in the world from many views of it.
//!
//! The start is the point nearest to all rays (3×3 linear least squares); Gauss–Newton steps on the reprojection error with
//! Cauchy weights then leave out what the expression moved: the result is the robust mean face.

use glam::{DMat3, DVec2, DVec3};
use nalgebra::{Matrix3, Vector3};
use risorius_formats::{Camera, Isometry};

/// One view of a point.
#[derive(Clone, Copy, Debug)]
pub struct View {
    /// Pose of the camera.
    pub camera_from_world: Isometry,
    /// Ideal (undistorted) normalised image coordinates x/z, y/z.
    pub normalised: DVec2,
    /// Focal length that turns a normalised distance into pixels.
    pub focal_px: f64,
}

impl View {
    /// The view of `camera` at `pixel`; `None` beyond the fold of the lens model.
    pub fn new(camera: &Camera, pixel: DVec2) -> Option<Self> {
        let normalised = camera.intrinsics.unproject(pixel)?;
        let focal_px = 0.5 * (camera.intrinsics.fx + camera.intrinsics.fy);
        normalised.is_finite().then_some(Self { camera_from_world: camera.camera_from_world, normalised, focal_px })
    }

    fn residual_px(&self, point: DVec3) -> Option<DVec2> {
        let p = self.camera_from_world.transform_point(point);
        (p.z > 0.0).then(|| (p.truncate() / p.z - self.normalised) * self.focal_px)
    }
}

/// A triangulated point.
#[derive(Clone, Copy, Debug)]
pub struct Triangulated {
    /// In the world.
    pub point: DVec3,
    /// Median distance between its projections and the views, pixels.
    pub median_error_px: f64,
    /// Spread of the ray directions, radians: the depth is worthless where it is next to nothing.
    pub parallax_rad: f64,
}

/// Rays whose directions spread less than this (standard deviation) have no depth, radians.
pub const MIN_PARALLAX_RAD: f64 = 0.008;

/// The point that the views see; `None` with fewer than two views or no parallax at all.
pub fn triangulate(views: &[View]) -> Option<Triangulated> {
    if views.len() < 2 {
        return None;
    }
    // Sum of the projectors across each ray; its smallest eigenvalue is the mean squared sine between rays.
    let mut normal = Matrix3::<f64>::zeros();
    let mut right = Vector3::<f64>::zeros();
    for view in views {
        let rotation = &view.camera_from_world.rotation;
        let d = (rotation.transpose() * view.normalised.extend(1.0)).normalize();
        let c = view.camera_from_world.camera_center();
        let across = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
        normal += to_na(&across);
        right += to_na_vec(across * c);
    }
    let spread = normal.symmetric_eigenvalues().min().max(0.0) / views.len() as f64;
    let start = normal.try_inverse()? * right;
    let mut point = DVec3::new(start.x, start.y, start.z);
    let mut errors = Vec::with_capacity(views.len());
    for _ in 0..20 {
        errors.clear();
        errors.extend(views.iter().filter_map(|v| v.residual_px(point)).map(DVec2::length));
        // Cauchy's scale follows the data; below half a pixel the noise of landmarks is the scale.
        let scale = (1.5 * median(&mut errors)?).max(0.5);
        let mut hessian = Matrix3::<f64>::zeros();
        let mut gradient = Vector3::<f64>::zeros();
        for view in views {
            let p = view.camera_from_world.transform_point(point);
            let Some(residual) = view.residual_px(point) else { continue };
            let weight = 1.0 / (1.0 + residual.length_squared() / (scale * scale));
            let rotation = &view.camera_from_world.rotation;
            let f = view.focal_px / p.z;
            // Rows of d(residual)/d(point): (f/z)(r₀ − x r₂), (f/z)(r₁ − y r₂).
            for (axis, value) in [(0, p.x / p.z), (1, p.y / p.z)] {
                let row = (rotation.row(axis) - rotation.row(2) * value) * f;
                let row = to_na_vec(row);
                hessian += row * row.transpose() * weight;
                gradient += row * (weight * residual[axis]);
            }
        }
        let Some(step) = hessian.try_inverse().map(|inverse| inverse * gradient) else { break };
        point -= DVec3::new(step.x, step.y, step.z);
        if step.norm() <= 1e-12 * (1.0 + point.length()) {
            break;
        }
    }
    errors.clear();
    errors.extend(views.iter().filter_map(|v| v.residual_px(point)).map(DVec2::length));
    // A point that ended behind most cameras was not found.
    if !point.is_finite() || errors.len() * 2 < views.len() {
        return None;
    }
    Some(Triangulated { point, median_error_px: median(&mut errors)?, parallax_rad: spread.sqrt() })
}

/// The median (upper one of an even count); reorders `values`.
pub(crate) fn median(values: &mut [f64]) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let middle = values.len() / 2;
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

fn to_na(m: &DMat3) -> Matrix3<f64> {
    Matrix3::from_column_slice(&m.to_cols_array())
}

fn to_na_vec(v: DVec3) -> Vector3<f64> {
    Vector3::new(v.x, v.y, v.z)
}

#[cfg(test)]
mod tests {
    use super::*;
    use risorius_formats::Intrinsics;
    use risorius_formats::camera::Distortion;

    fn camera(x: f64) -> Camera {
        let mut intrinsics = Intrinsics::pinhole(640, 480, 700.0);
        intrinsics.distortion = Distortion { radial: [-0.1, 0.02, 0.0], ..Distortion::default() };
        let rotation = DMat3::from_rotation_y(-x * 0.3) * DMat3::from_rotation_x(0.1 * x);
        Camera { intrinsics, camera_from_world: Isometry::new(rotation, -(rotation * DVec3::new(x, 0.2 * x, -2.0))) }
    }

    #[test]
    fn exact_views_give_the_exact_point_through_distortion() {
        let truth = DVec3::new(0.1, -0.2, 0.3);
        let views: Vec<View> = (-4..=4)
            .map(|i| f64::from(i) * 0.1)
            .map(|x| View::new(&camera(x), camera(x).project(truth)).unwrap())
            .collect();
        let found = triangulate(&views).unwrap();
        assert!((found.point - truth).length() < 1e-8, "{}", found.point);
        assert!(found.median_error_px < 1e-5 && found.parallax_rad > 0.05);
    }

    #[test]
    fn a_third_of_wild_views_hardly_moves_it() {
        let truth = DVec3::new(0.1, -0.2, 0.3);
        let views: Vec<View> = (-15..15)
            .map(|i| {
                let camera = camera(f64::from(i) * 0.03);
                let wild = if i % 3 == 0 { DVec2::new(25.0, -40.0) } else { DVec2::ZERO };
                View::new(&camera, camera.project(truth) + wild).unwrap()
            })
            .collect();
        let found = triangulate(&views).unwrap();
        // A plain mean would be off by 10 px, which is 30 mm here.
        assert!((found.point - truth).length() < 2e-3, "{}", (found.point - truth).length());
    }

    #[test]
    fn a_still_camera_shows_its_lack_of_parallax() {
        let truth = DVec3::new(0.1, -0.2, 0.3);
        let views: Vec<View> = (0..9).map(|_| View::new(&camera(0.0), camera(0.0).project(truth)).unwrap()).collect();
        assert!(triangulate(&views).is_none_or(|t| t.parallax_rad < MIN_PARALLAX_RAD));
        assert!(triangulate(&views[..1]).is_none());
    }
}
