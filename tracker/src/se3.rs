//! Exponential and logarithm of rigid transforms, for motion along a constant twist (f64 throughout).

use glam::{DMat3, DQuat, DVec3};
use risorius_formats::Isometry;

/// A rigid motion as a twist: rotation vector (radians) and the matching velocity.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Twist {
    /// Rotation vector: axis × angle.
    pub(crate) rotation: DVec3,
    /// Translation part before the left Jacobian.
    pub(crate) translation: DVec3,
}

impl Twist {
    /// The six numbers, rotation first.
    pub(crate) fn to_array(self) -> [f64; 6] {
        let (r, t) = (self.rotation, self.translation);
        [r.x, r.y, r.z, t.x, t.y, t.z]
    }

    /// From six numbers, rotation first.
    pub(crate) fn from_array(v: [f64; 6]) -> Self {
        Self { rotation: DVec3::new(v[0], v[1], v[2]), translation: DVec3::new(v[3], v[4], v[5]) }
    }
}

fn skew(v: DVec3) -> DMat3 {
    DMat3::from_cols(DVec3::new(0.0, v.z, -v.y), DVec3::new(-v.z, 0.0, v.x), DVec3::new(v.y, -v.x, 0.0))
}

/// Rotation by the vector `w` (axis × angle, radians).
pub(crate) fn rotation_exp(w: DVec3) -> DMat3 {
    DMat3::from_quat(DQuat::from_scaled_axis(w).normalize())
}

/// The rotation vector of `r`, length 0..π.
pub(crate) fn rotation_log(r: &DMat3) -> DVec3 {
    let q = DQuat::from_mat3(r).normalize();
    let q = if q.w < 0.0 { -q } else { q };
    let v = DVec3::new(q.x, q.y, q.z);
    let s = v.length();
    // 2 atan2(s, w) / s, whose limit at s → 0 is 2 / w.
    if s < 1e-12 { v * (2.0 / q.w) } else { v * (2.0 * s.atan2(q.w) / s) }
}

/// The angle of the rotation `r`, radians.
pub(crate) fn rotation_angle(r: &DMat3) -> f64 {
    rotation_log(r).length()
}

/// (1 − cos θ)/θ² and (θ − sin θ)/θ³ without cancellation.
fn jacobian_factors(theta: f64) -> (f64, f64) {
    if theta < 1e-3 {
        let t2 = theta * theta;
        (0.5 - t2 / 24.0, 1.0 / 6.0 - t2 / 120.0)
    } else {
        ((1.0 - theta.cos()) / (theta * theta), (theta - theta.sin()) / (theta * theta * theta))
    }
}

fn left_jacobian(w: DVec3) -> DMat3 {
    let (a, b) = jacobian_factors(w.length());
    let k = skew(w);
    DMat3::IDENTITY + k * a + k * k * b
}

/// The motion along `twist` for one unit of time.
pub(crate) fn exp(twist: Twist) -> Isometry {
    Isometry::new(rotation_exp(twist.rotation), left_jacobian(twist.rotation) * twist.translation)
}

/// The twist of a motion whose angle is below π.
pub(crate) fn log(motion: &Isometry) -> Twist {
    let rotation = rotation_log(&motion.rotation);
    Twist { rotation, translation: left_jacobian(rotation).inverse() * motion.translation }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_logarithm_undoes_the_exponential(v in prop::array::uniform6(-1.7f64..1.7), small in prop::bool::ANY) {
            let scale = if small { 1e-6 } else { 1.0 };
            let v = v.map(|x| x * scale);
            let back = log(&exp(Twist::from_array(v))).to_array();
            for (a, b) in v.iter().zip(back) {
                prop_assert!((a - b).abs() < 1e-12 + 1e-9 * scale, "{v:?} {back:?}");
            }
        }
    }

    #[test]
    fn a_quarter_turn_about_an_offset_axis_moves_on_its_circle() {
        // Twist of a rotation about z through (1, 0, 0): v = −ω × p.
        let twist = Twist {
            rotation: DVec3::Z * std::f64::consts::FRAC_PI_2,
            translation: DVec3::new(0.0, -std::f64::consts::FRAC_PI_2, 0.0),
        };
        let moved = exp(twist).transform_point(DVec3::ZERO);
        assert!((moved - DVec3::new(1.0, -1.0, 0.0)).length() < 1e-12, "{moved}");
    }
}
