//! The similarity between two worlds that hold the same cameras (Umeyama 1991).

use glam::{DMat3, DVec3};
use nalgebra::{Matrix3, Vector3};
use risorius_formats::Isometry;

/// `p_a = scale · rotation · p_b + translation` for an `a_from_b`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Similarity {
    /// Units of `a` per unit of `b`.
    pub scale: f64,
    /// A proper rotation.
    pub rotation: DMat3,
    /// In units of `a`.
    pub translation: DVec3,
}

impl Similarity {
    /// The point in `a`.
    pub fn transform_point(&self, p: DVec3) -> DVec3 {
        self.rotation * p * self.scale + self.translation
    }

    /// `camera_from_a` of a camera given by its `camera_from_b`; camera space gets the units of `a`.
    pub fn transform_pose(&self, camera_from_b: &Isometry) -> Isometry {
        let rotation = camera_from_b.rotation * self.rotation.transpose();
        Isometry::new(rotation, -(rotation * self.transform_point(camera_from_b.camera_center())))
    }
}

/// The `a_from_b` that brings the points of `b` closest to those of `a`, in the least-squares sense.
///
/// `with_scale` = false keeps the scale at 1. `None` with fewer than 3 pairs or when all points of `b` coincide. Points on
/// a line leave the turn about it open; it is then the smallest one.
pub fn umeyama(pairs: &[(DVec3, DVec3)], with_scale: bool) -> Option<Similarity> {
    if pairs.len() < 3 {
        return None;
    }
    let n = pairs.len() as f64;
    let mean = pairs.iter().fold((DVec3::ZERO, DVec3::ZERO), |m, p| (m.0 + p.0 / n, m.1 + p.1 / n));
    let mut covariance = Matrix3::<f64>::zeros();
    let mut variance_b = 0.0;
    for (a, b) in pairs {
        let (a, b) = (*a - mean.0, *b - mean.1);
        covariance += Vector3::new(a.x, a.y, a.z) * Vector3::new(b.x, b.y, b.z).transpose() / n;
        variance_b += b.length_squared() / n;
    }
    let svd = covariance.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    // The last axis is flipped where the best orthogonal matrix would be a mirror.
    let sign = if (u.determinant() * v_t.determinant()) < 0.0 { -1.0 } else { 1.0 };
    let flip = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign));
    let r = u * flip * v_t;
    let trace = svd.singular_values[0] + svd.singular_values[1] + sign * svd.singular_values[2];
    if variance_b <= 0.0 || !trace.is_finite() {
        return None;
    }
    let scale = if with_scale { trace / variance_b } else { 1.0 };
    let rotation = DMat3::from_cols_slice(r.as_slice());
    Some(Similarity { scale, rotation, translation: mean.0 - rotation * mean.1 * scale })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::se3::{rotation_angle, rotation_exp};
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_known_similarity_is_found(w in prop::array::uniform3(-1.8f64..1.8), t in prop::array::uniform3(-5f64..5.0),
                                       scale in 0.01f64..100.0, flat in prop::bool::ANY) {
            let truth = Similarity { scale, rotation: rotation_exp(DVec3::from(w)), translation: DVec3::from(t) };
            // Flat sets are the usual case: cameras on an arc. A mirror fits them as well as a rotation does.
            let pairs: Vec<_> = (0..12u32).map(|i| {
                let i = f64::from(i);
                let b = DVec3::new((i * 1.7).sin(), (i * 0.9).cos(), if flat { 0.0 } else { (i * 2.3).sin() });
                (truth.transform_point(b), b)
            }).collect();
            let found = umeyama(&pairs, true).unwrap();
            prop_assert!((found.scale / scale - 1.0).abs() < 1e-9);
            prop_assert!(rotation_angle(&(found.rotation * truth.rotation.transpose())) < 1e-7);
            prop_assert!((found.translation - truth.translation).length() < 1e-9 * (1.0 + scale));
        }
    }

    #[test]
    fn poses_follow_their_world() {
        let s = Similarity {
            scale: 2.5,
            rotation: rotation_exp(DVec3::new(0.3, -0.5, 0.9)),
            translation: DVec3::new(1.0, 2.0, 3.0),
        };
        let pose = Isometry::new(rotation_exp(DVec3::new(-0.2, 0.1, 0.4)), DVec3::new(0.5, -0.1, 4.0));
        let point = DVec3::new(0.3, 0.7, -0.2);
        let moved = s.transform_pose(&pose).transform_point(s.transform_point(point));
        assert!((moved - pose.transform_point(point) * 2.5).length() < 1e-12);
    }

    #[test]
    fn two_points_or_one_place_are_not_enough() {
        assert!(umeyama(&[(DVec3::ONE, DVec3::ONE); 2], true).is_none());
        assert!(umeyama(&[(DVec3::ONE, DVec3::ONE); 5], true).is_none());
    }
}
