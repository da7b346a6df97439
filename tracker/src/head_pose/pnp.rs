//! Perspective-n-point: the pose of a known shape from its points in a picture.
//!
//! The start is a scaled orthographic camera, which is linear; Levenberg–Marquardt steps on the reprojection error follow,
//! with Cauchy weights for points that are not where the shape has them. No step divides by an angle, so that frontal
//! faces are no special case.

use glam::{DMat3, DVec2, DVec3};
use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};
use risorius_formats::Isometry;

use crate::se3::rotation_exp;

/// Steps at most.
const STEPS: usize = 30;
/// A step below this ends the search: radians, shares of the distance.
const CONVERGED: f64 = 1e-10;

/// `camera_from_head` that brings `shape` (millimetres) to the rays `seen` (x/z, y/z), and the root of the weighted mean
/// squared reprojection error in the same unit.
///
/// `error_scale` is the error at which a point's weight is halved. `None` where the points say nothing: fewer than four with a
/// weight, all in one place, or a pose behind the camera.
pub fn solve(
    shape: &[DVec3],
    seen: &[DVec2],
    weights: &[f64],
    error_scale: f64,
    start: Option<&Isometry>,
) -> Option<(Isometry, f64)> {
    if weights.iter().filter(|w| **w > 0.0).count() < 4 || seen.iter().any(|p| !p.is_finite()) {
        return None;
    }
    let mut pose = match start {
        Some(pose) if pose.rotation.is_finite() && pose.translation.is_finite() => *pose,
        _ => orthographic(shape, seen, weights)?,
    };
    let mut damping = 1e-4;
    let mut current = cost(shape, seen, weights, error_scale, &pose)?;
    for _ in 0..STEPS {
        let (normal, right) = normal_equations(shape, seen, weights, error_scale, &pose);
        let mut moved = false;
        for _ in 0..8 {
            let mut damped = normal;
            for i in 0..6 {
                damped[(i, i)] += damping * normal[(i, i)].max(1e-12);
            }
            let step = damped.cholesky()?.solve(&right);
            let turned = rotation_exp(DVec3::new(step[0], step[1], step[2]));
            let next = Isometry::new(turned * pose.rotation, pose.translation + DVec3::new(step[3], step[4], step[5]));
            if let Some(next_cost) = cost(shape, seen, weights, error_scale, &next)
                && next_cost <= current
            {
                damping = (damping * 0.2).max(1e-12);
                let size = step.fixed_rows::<3>(0).norm()
                    + step.fixed_rows::<3>(3).norm() / next.translation.length().max(1.0);
                (pose, current, moved) = (next, next_cost, size > CONVERGED);
                break;
            }
            damping *= 10.0;
        }
        if !moved {
            break;
        }
    }
    let total: f64 = weights.iter().sum();
    let squares: f64 = errors(shape, seen, &pose).zip(weights).map(|(e, w)| w * e.length_squared()).sum();
    // Rounding leaves a rotation that is no longer quite one.
    let rotation = DMat3::from_quat(glam::DQuat::from_mat3(&pose.rotation).normalize());
    let error = (squares / total).sqrt();
    let found = rotation.is_finite() && pose.translation.is_finite() && error.is_finite();
    found.then_some((Isometry::new(rotation, pose.translation), error))
}

fn errors<'a>(shape: &'a [DVec3], seen: &'a [DVec2], pose: &'a Isometry) -> impl Iterator<Item = DVec2> + 'a {
    shape.iter().zip(seen).map(|(x, s)| {
        let p = pose.transform_point(*x);
        p.truncate() / p.z - *s
    })
}

/// Sum of the Cauchy losses; `None` where a point with a weight is behind the camera.
fn cost(shape: &[DVec3], seen: &[DVec2], weights: &[f64], scale: f64, pose: &Isometry) -> Option<f64> {
    if shape.iter().zip(weights).any(|(x, w)| *w > 0.0 && pose.transform_point(*x).z <= 1e-6) {
        return None;
    }
    let loss = |(e, w): (DVec2, &f64)| if *w > 0.0 { w * (e.length_squared() / (scale * scale)).ln_1p() } else { 0.0 };
    let sum: f64 = errors(shape, seen, pose).zip(weights).map(loss).sum();
    sum.is_finite().then_some(sum)
}

/// JᵀWJ and −JᵀWr for a turn about the camera's axes and a shift.
fn normal_equations(
    shape: &[DVec3],
    seen: &[DVec2],
    weights: &[f64],
    scale: f64,
    pose: &Isometry,
) -> (Matrix6<f64>, Vector6<f64>) {
    let (mut normal, mut right) = (Matrix6::zeros(), Vector6::zeros());
    for ((x, s), w) in shape.iter().zip(seen).zip(weights) {
        if *w == 0.0 {
            continue;
        }
        let turned = pose.rotation * *x;
        let p = turned + pose.translation;
        let r = p.truncate() / p.z - *s;
        let weight = w / (scale * scale + r.length_squared());
        for (axis, row) in [(0, DVec3::new(1.0, 0.0, -p.x / p.z)), (1, DVec3::new(0.0, 1.0, -p.y / p.z))] {
            let along = row / p.z;
            // d(R x)/dω = ω × (R x), so that a gradient g turns into (R x) × g.
            let about = turned.cross(along);
            let j = Vector6::new(about.x, about.y, about.z, along.x, along.y, along.z);
            normal += j * j.transpose() * weight;
            right -= j * (r[axis] * weight);
        }
    }
    (normal, right)
}

/// The pose of a scaled orthographic camera: x/z ≈ (R₁·X + t₁)/z₀, linear in the two scaled rows of R.
fn orthographic(shape: &[DVec3], seen: &[DVec2], weights: &[f64]) -> Option<Isometry> {
    let total: f64 = weights.iter().sum();
    let mean = shape.iter().zip(weights).fold(DVec3::ZERO, |m, (x, w)| m + *x * (*w / total));
    let middle = seen.iter().zip(weights).fold(DVec2::ZERO, |m, (s, w)| m + *s * (*w / total));
    let (mut normal, mut rows) = (Matrix3::<f64>::zeros(), [Vector3::<f64>::zeros(); 2]);
    for ((x, s), w) in shape.iter().zip(seen).zip(weights) {
        let x = *x - mean;
        let x = Vector3::new(x.x, x.y, x.z);
        normal += x * x.transpose() * *w;
        for (axis, row) in rows.iter_mut().enumerate() {
            *row += x * (w * (s[axis] - middle[axis]));
        }
    }
    // Flat shapes have no depth to tell apart: a little of the identity keeps them solvable.
    normal += Matrix3::identity() * (1e-6 * normal.trace());
    let inverse = normal.try_inverse()?;
    let [a, b] = rows.map(|r| {
        let v = inverse * r;
        DVec3::new(v.x, v.y, v.z)
    });
    let scale = 0.5 * (a.length() + b.length());
    if !(scale.is_finite() && scale > 1e-9) {
        return None;
    }
    let x = a.try_normalize()?;
    let z = x.cross(b).try_normalize()?;
    // Rows of the rotation.
    let rotation = DMat3::from_cols(x, z.cross(x), z).transpose();
    let depth = 1.0 / scale;
    let translation = middle.extend(1.0) * depth - rotation * mean;
    Some(Isometry::new(rotation, translation))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn shape() -> Vec<DVec3> {
        (0..30u32)
            .map(|i| {
                let t = f64::from(i);
                DVec3::new(60.0 * (t * 1.3).sin(), 70.0 * (t * 0.8).cos(), 35.0 * (t * 2.1).sin())
            })
            .collect()
    }

    fn seen(shape: &[DVec3], pose: &Isometry) -> Vec<DVec2> {
        errors(shape, &vec![DVec2::ZERO; shape.len()], pose).collect()
    }

    proptest! {
        #[test]
        fn a_known_pose_is_found_from_any_side(w in prop::array::uniform3(-1.1f64..1.1), x in -150f64..150.0, y in -150f64..150.0,
                                               z in 250f64..1500.0) {
            let (shape, truth) = (shape(), Isometry::new(rotation_exp(DVec3::from(w)), DVec3::new(x, y, z)));
            let (found, error) = solve(&shape, &seen(&shape, &truth), &[1.0; 30], 0.01, None).unwrap();
            prop_assert!((found.translation - truth.translation).length() < 1e-5 * z, "{found:?} {truth:?}");
            prop_assert!(crate::se3::rotation_angle(&(found.rotation * truth.rotation.transpose())) < 1e-6);
            prop_assert!(error < 1e-7);
        }
    }

    #[test]
    fn points_that_moved_with_the_expression_hardly_count() {
        let (shape, truth) = (shape(), Isometry::new(DMat3::IDENTITY, DVec3::new(10.0, -20.0, 600.0)));
        let mut seen = seen(&shape, &truth);
        for s in &mut seen[..5] {
            *s += DVec2::new(0.0, 0.05);
        }
        let (found, _) = solve(&shape, &seen, &[1.0; 30], 0.002, None).unwrap();
        assert!(crate::se3::rotation_angle(&found.rotation) < 0.01, "{found:?}");
    }

    #[test]
    fn what_says_nothing_has_no_pose() {
        let shape = shape();
        assert!(solve(&shape, &[DVec2::ZERO; 30], &[1.0; 30], 0.01, None).is_none());
        assert!(solve(&shape, &[DVec2::NAN; 30], &[1.0; 30], 0.01, None).is_none());
        assert!(solve(&shape, &[DVec2::ONE; 30], &[0.0; 30], 0.01, None).is_none());
    }
}
