//! Similarities between worlds, and the one that brings two sets of points together (Umeyama 1991).

use glam::{DMat3, DVec3};
use nalgebra::{Matrix3, Vector3};

use crate::Isometry;

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
    /// Leaves everything where it is.
    pub const IDENTITY: Self = Self { scale: 1.0, rotation: DMat3::IDENTITY, translation: DVec3::ZERO };

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

/// What [`umeyama`] finds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fit {
    /// The similarity.
    pub a_from_b: Similarity,
    /// Root mean square distance of the pairs after it, units of `a`.
    pub rms: f64,
    /// Whether the points lie on a line, which leaves the turn about it open.
    pub on_a_line: bool,
}

/// Points whose second direction carries less than this share of the first one's covariance lie on a line.
const LINE: f64 = 1e-9;

/// The `a_from_b` that brings the points of `b` closest to those of `a`, in the least-squares sense.
///
/// Pairs are (point of `a`, point of `b`). `with_scale` = false keeps the scale at 1. `None` with fewer than 3 pairs,
/// when all points of `b` coincide, or where a number is not finite or overflows.
pub fn umeyama(pairs: &[(DVec3, DVec3)], with_scale: bool) -> Option<Fit> {
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
    // Before the decomposition, which would look for the singular values of a NaN for ever.
    if !(covariance.iter().all(|v| v.is_finite()) && variance_b > 0.0 && variance_b.is_finite()) {
        return None;
    }
    // Singular values come in descending order.
    let svd = covariance.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    // The last axis is flipped where the best orthogonal matrix would be a mirror.
    let sign = if (u.determinant() * v_t.determinant()) < 0.0 { -1.0 } else { 1.0 };
    let r = u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v_t;
    let [first, second, third] = [0, 1, 2].map(|i| svd.singular_values[i]);
    let trace = first + second + sign * third;
    if !trace.is_finite() {
        return None;
    }
    let scale = if with_scale { trace / variance_b } else { 1.0 };
    let rotation = DMat3::from_cols_slice(r.as_slice());
    let a_from_b = Similarity { scale, rotation, translation: mean.0 - rotation * mean.1 * scale };
    let squares: f64 = pairs.iter().map(|(a, b)| (a_from_b.transform_point(*b) - *a).length_squared()).sum();
    let rms = (squares / n).sqrt();
    (rms.is_finite() && scale.is_finite()).then_some(Fit { a_from_b, rms, on_a_line: second <= LINE * first })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::{Camera, Intrinsics};

    fn turn(w: [f64; 3]) -> DMat3 {
        DMat3::from_quat(glam::DQuat::from_scaled_axis(DVec3::from(w)))
    }

    proptest! {
        #[test]
        fn a_known_similarity_is_found(w in prop::array::uniform3(-1.8f64..1.8), t in prop::array::uniform3(-5f64..5.0),
                                       scale in 0.01f64..100.0, flat in prop::bool::ANY) {
            let truth = Similarity { scale, rotation: turn(w), translation: DVec3::from(t) };
            // Flat sets are the usual case: cameras on an arc. A mirror fits them as well as a rotation does.
            let pairs: Vec<_> = (0..12u32).map(|i| {
                let i = f64::from(i);
                let b = DVec3::new((i * 1.7).sin(), (i * 0.9).cos(), if flat { 0.0 } else { (i * 2.3).sin() });
                (truth.transform_point(b), b)
            }).collect();
            let fit = umeyama(&pairs, true).unwrap();
            let found = fit.a_from_b;
            prop_assert!((found.scale / scale - 1.0).abs() < 1e-9);
            prop_assert!((found.rotation - truth.rotation).to_cols_array().iter().all(|v| v.abs() < 1e-7));
            prop_assert!((found.translation - truth.translation).length() < 1e-9 * (1.0 + scale));
            prop_assert!(fit.rms < 1e-9 * (1.0 + scale) && !fit.on_a_line);
        }
    }

    #[test]
    fn a_camera_sees_in_the_other_world_what_it_saw() {
        let s = Similarity { scale: 2.5, rotation: turn([0.3, -0.5, 0.9]), translation: DVec3::new(1.0, 2.0, 3.0) };
        let pose = Isometry::new(turn([-0.2, 0.1, 0.4]), DVec3::new(0.5, -0.1, 4.0));
        let point = DVec3::new(0.3, 0.7, -0.2);
        let moved = s.transform_pose(&pose);
        assert!((moved.transform_point(s.transform_point(point)) - pose.transform_point(point) * 2.5).length() < 1e-12);
        let camera = |camera_from_world| Camera { intrinsics: Intrinsics::pinhole(640, 480, 500.0), camera_from_world };
        let pixels = (camera(pose).project(point), camera(moved).project(s.transform_point(point)));
        assert!(pixels.0.distance(pixels.1) < 1e-9);
    }

    #[test]
    fn what_has_no_shape_is_refused_or_told() {
        assert!(umeyama(&[(DVec3::ONE, DVec3::ONE); 2], true).is_none());
        assert!(umeyama(&[(DVec3::ONE, DVec3::ONE); 5], true).is_none());
        assert!(umeyama(&[(DVec3::NAN, DVec3::ONE), (DVec3::ONE, DVec3::X), (DVec3::ONE, DVec3::Y)], true).is_none());
        let line: Vec<_> = (0..5).map(|i| (DVec3::X * f64::from(i), DVec3::Y * f64::from(i))).collect();
        assert!(umeyama(&line, true).is_some_and(|fit| fit.on_a_line));
    }
}
