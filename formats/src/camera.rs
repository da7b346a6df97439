//! Cameras: intrinsics with OpenCV distortion and `camera_from_world` in f64.
//!
//! Axes are OpenCV's (x right, y down, z forward) and the centre of the first pixel is (0.5, 0.5).
//! The distortion polynomial and its inverse are those of fact sheet §3.6:
//!
//! ```text
//! d  = 1 + r²(k1 + r²(k2 + r² k3))          (k4..k6: rational denominator, 0 for most)
//! x' = x d + 2 p1 x y + p2 (r² + 2x²)
//! y' = y d + 2 p2 x y + p1 (r² + 2y²)
//! u  = fx x' + skew y' + cx,   v = fy y' + cy
//! ```

use glam::{DMat2, DMat3, DQuat, DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// A rigid transform: `p_a = rotation · p_b + translation` for an `a_from_b`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Isometry {
    /// A proper rotation.
    pub rotation: DMat3,
    /// In the units of the target space.
    pub translation: DVec3,
}

impl Isometry {
    /// Leaves every point where it is.
    pub const IDENTITY: Self = Self { rotation: DMat3::IDENTITY, translation: DVec3::ZERO };

    /// From a rotation matrix and a translation.
    pub fn new(rotation: DMat3, translation: DVec3) -> Self {
        Self { rotation, translation }
    }

    /// From the rows of a 3×4 matrix.
    pub fn from_rows(rows: [[f64; 4]; 3]) -> Self {
        let row = |i: usize| DVec3::new(rows[i][0], rows[i][1], rows[i][2]);
        let rotation = DMat3::from_cols(row(0), row(1), row(2)).transpose();
        Self { rotation, translation: DVec3::new(rows[0][3], rows[1][3], rows[2][3]) }
    }

    /// The rows of the 3×4 matrix.
    pub fn to_rows(&self) -> [[f64; 4]; 3] {
        let t = self.translation.to_array();
        std::array::from_fn(|i| {
            let r = self.rotation.row(i);
            [r.x, r.y, r.z, t[i]]
        })
    }

    /// From a quaternion (w, x, y, z), normalised here, and a translation.
    pub fn from_wxyz(q: [f64; 4], translation: DVec3) -> Self {
        let q = DQuat::from_xyzw(q[1], q[2], q[3], q[0]).normalize();
        Self { rotation: DMat3::from_quat(q), translation }
    }

    /// The rotation as a unit quaternion (w, x, y, z) with w ≥ 0.
    pub fn to_wxyz(&self) -> [f64; 4] {
        let q = DQuat::from_mat3(&self.rotation).normalize();
        let q = if q.w < 0.0 { -q } else { q };
        [q.w, q.x, q.y, q.z]
    }

    /// `b_from_a` for this `a_from_b`.
    #[must_use]
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.transpose();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// `a_from_c` from this `a_from_b` and `b_from_c`.
    #[must_use]
    pub fn compose(&self, b_from_c: &Self) -> Self {
        Self {
            rotation: self.rotation * b_from_c.rotation,
            translation: self.rotation * b_from_c.translation + self.translation,
        }
    }

    /// The point in the target space.
    pub fn transform_point(&self, p: DVec3) -> DVec3 {
        self.rotation * p + self.translation
    }

    /// For a `camera_from_world`: where the camera stands in the world.
    pub fn camera_center(&self) -> DVec3 {
        -(self.rotation.transpose() * self.translation)
    }

    /// The largest deviation of `RᵀR` from the identity.
    pub fn orthonormality_error(&self) -> f64 {
        let e = self.rotation.transpose() * self.rotation - DMat3::IDENTITY;
        e.to_cols_array().iter().fold(0.0, |m, v| m.max(v.abs()))
    }
}

/// Lens distortion, OpenCV's coefficients. All zero is a pinhole.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Distortion {
    /// Radial k1, k2, k3 (numerator).
    pub radial: [f64; 3],
    /// Radial k4, k5, k6 (denominator of the rational model).
    #[serde(default)]
    pub radial_denominator: [f64; 3],
    /// Tangential p1, p2.
    pub tangential: [f64; 2],
}

impl Distortion {
    /// Whether there is nothing to undo.
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// Normalised ideal coordinates to normalised distorted ones.
    pub fn distort(&self, p: DVec2) -> DVec2 {
        let ([k1, k2, k3], [k4, k5, k6], [p1, p2]) = (self.radial, self.radial_denominator, self.tangential);
        let (x, y) = (p.x, p.y);
        let r2 = x * x + y * y;
        let d = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)));
        DVec2::new(
            x * d + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * d + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y),
        )
    }

    fn jacobian(&self, p: DVec2) -> DMat2 {
        let ([k1, k2, k3], [k4, k5, k6], [p1, p2]) = (self.radial, self.radial_denominator, self.tangential);
        let (x, y) = (p.x, p.y);
        let r2 = x * x + y * y;
        let num = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let den = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
        let d = num / den;
        // d(d)/d(r²), then the chain through r² = x² + y².
        let dr =
            ((k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2)) * den - num * (k4 + r2 * (2.0 * k5 + 3.0 * k6 * r2))) / (den * den);
        let (dx, dy) = (2.0 * x * dr, 2.0 * y * dr);
        DMat2::from_cols(
            DVec2::new(d + x * dx + 2.0 * p1 * y + 6.0 * p2 * x, y * dx + 2.0 * p2 * y + 2.0 * p1 * x),
            DVec2::new(x * dy + 2.0 * p1 * x + 2.0 * p2 * y, d + y * dy + 2.0 * p2 * x + 6.0 * p1 * y),
        )
    }

    /// Normalised distorted coordinates to ideal ones by ten Newton steps, as the Nerfies family does.
    ///
    /// `None` when the residual stays above 1e-5: the point lies beyond the fold of the lens model, where no ideal
    /// point exists (fact sheet §8.14); such a pixel has no ray and must be masked out.
    pub fn undistort(&self, distorted: DVec2) -> Option<DVec2> {
        if self.is_none() {
            return distorted.is_finite().then_some(distorted);
        }
        let mut p = distorted;
        for _ in 0..10 {
            let residual = self.distort(p) - distorted;
            let j = self.jacobian(p);
            if j.determinant().abs() > 1e-9 {
                p -= j.inverse() * residual;
            }
        }
        // A Newton run that jumped to another branch shows as a negative Jacobian determinant (an inside-out image).
        let ok = p.is_finite() && (self.distort(p) - distorted).length() < 1e-5 && self.jacobian(p).determinant() > 0.0;
        ok.then_some(p)
    }
}

/// What maps camera space to pixels, in pixels of an image of `width` × `height`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Intrinsics {
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// Horizontal focal length, pixels.
    pub fx: f64,
    /// Vertical focal length, pixels.
    pub fy: f64,
    /// Principal point x, pixels.
    pub cx: f64,
    /// Principal point y, pixels.
    pub cy: f64,
    /// Skew, pixels.
    #[serde(default)]
    pub skew: f64,
    /// Lens distortion.
    #[serde(default)]
    pub distortion: Distortion,
}

impl Intrinsics {
    /// A pinhole with square pixels and the principal point in the middle.
    pub fn pinhole(width: u32, height: u32, focal_px: f64) -> Self {
        Self {
            width,
            height,
            fx: focal_px,
            fy: focal_px,
            cx: f64::from(width) / 2.0,
            cy: f64::from(height) / 2.0,
            skew: 0.0,
            distortion: Distortion::default(),
        }
    }

    /// The same lens for an image reduced `divisor` times; sides are rounded half to even.
    #[must_use]
    pub fn reduced(&self, divisor: u32) -> Self {
        let s = 1.0 / f64::from(divisor);
        let side = |n: u32| (f64::from(n) * s).round_ties_even() as u32;
        Self {
            width: side(self.width),
            height: side(self.height),
            fx: self.fx * s,
            fy: self.fy * s,
            cx: self.cx * s,
            cy: self.cy * s,
            skew: self.skew * s,
            distortion: self.distortion,
        }
    }

    /// The pixel of a point in camera space; points behind the camera project too, as in the original.
    pub fn project(&self, point_in_camera: DVec3) -> DVec2 {
        let d = self.distortion.distort(point_in_camera.truncate() / point_in_camera.z);
        DVec2::new(self.fx * d.x + self.skew * d.y + self.cx, self.fy * d.y + self.cy)
    }

    /// The normalised ideal coordinates (x/z, y/z) of a pixel; `None` beyond the fold of the lens model.
    pub fn unproject(&self, pixel: DVec2) -> Option<DVec2> {
        let y = (pixel.y - self.cy) / self.fy;
        let x = (pixel.x - self.cx - y * self.skew) / self.fx;
        self.distortion.undistort(DVec2::new(x, y))
    }
}

/// A posed camera.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Camera space to pixels.
    pub intrinsics: Intrinsics,
    /// World to camera space.
    pub camera_from_world: Isometry,
}

impl Camera {
    /// The pixel of a point in the world.
    pub fn project(&self, point_in_world: DVec3) -> DVec2 {
        self.intrinsics.project(self.camera_from_world.transform_point(point_in_world))
    }

    /// The unit direction in the world of the ray through a pixel; `None` beyond the fold of the lens model, and where
    /// the camera's numbers give no direction.
    pub fn ray_direction(&self, pixel: DVec2) -> Option<DVec3> {
        let p = self.intrinsics.unproject(pixel)?;
        // A pixel so far out that its square overflows has no length, hence no direction.
        (self.camera_from_world.rotation.transpose() * p.extend(1.0).try_normalize()?).try_normalize()
    }

    /// Where the camera stands in the world.
    pub fn center(&self) -> DVec3 {
        self.camera_from_world.camera_center()
    }

    /// The same camera for an image reduced `divisor` times.
    #[must_use]
    pub fn reduced(&self, divisor: u32) -> Self {
        Self { intrinsics: self.intrinsics.reduced(divisor), camera_from_world: self.camera_from_world }
    }
}

#[cfg(test)]
#[path = "camera_tests.rs"]
mod tests;
