//! The resting shape of a person's 68 points, from many pictures of them.
//!
//! The shape is a mean and principal shapes of many people's resting faces; its coefficients and the poses are found in
//! turn. What all poses share, such as a long nose, ends in the coefficients, not in the poses.

use glam::{DVec2, DVec3};
use nalgebra::{DMatrix, DVector};
use risorius_formats::Isometry;

use super::{Lens, RIGIDITY, pnp};

/// Resting faces: mean and principal shapes of the 68 points, millimetres, in the head's axes.
#[derive(Clone, Debug, PartialEq)]
pub struct ShapeModel {
    /// The mean face.
    pub mean: Vec<DVec3>,
    /// One for each coefficient, scaled so that coefficients of people have the deviation 1.
    pub modes: Vec<Vec<DVec3>>,
}

/// The shape that was found for a person.
#[derive(Clone, Debug, PartialEq)]
pub struct PersonShape {
    /// The 68 resting points, millimetres, their mean at the origin.
    pub points: Vec<DVec3>,
    /// Coefficients of the model.
    pub coefficients: Vec<f64>,
    /// Root mean square distance of the rigid points from the pictures after the fit, shares of the focal length.
    pub error: f64,
}

/// Error of a landmark network's point, shares of the outer-eye distance: what the prior is weighed against.
const POINT_ERROR: f64 = 0.02;
/// The outer-eye distance that goes with it, millimetres.
const EYE_DISTANCE_MM: f64 = 89.0;
/// Neighbouring frames repeat each other's errors: so many count as one.
const REPEATED: f64 = 10.0;
/// How often shape and poses are improved in turn.
const ROUNDS: usize = 6;

impl ShapeModel {
    /// The shape for coefficients, its origin at the mean of its points.
    pub fn shape(&self, coefficients: &[f64]) -> Vec<DVec3> {
        let mut points = self.mean.clone();
        for (mode, c) in self.modes.iter().zip(coefficients) {
            for (p, m) in points.iter_mut().zip(mode) {
                *p += *m * *c;
            }
        }
        let mean = points.iter().sum::<DVec3>() / points.len() as f64;
        for p in &mut points {
            *p -= mean;
        }
        points
    }

    /// The person's shape from the points seen in several pictures; the mean face where there are none.
    pub fn fit(&self, lens: &Lens, pictures: &[[[f32; 2]; 68]]) -> PersonShape {
        let seen: Vec<Vec<DVec2>> = pictures.iter().map(|p| p.iter().map(|q| lens.normalised(*q)).collect()).collect();
        let mut person = PersonShape { points: self.shape(&[]), coefficients: vec![0.0; self.modes.len()], error: 0.0 };
        for _ in 0..ROUNDS {
            let poses: Vec<Option<(Isometry, f64)>> = seen.iter().map(|s| pose(&person.points, s, None)).collect();
            let Some(coefficients) = self.improved(&person, &seen, &poses) else { break };
            let errors: Vec<f64> = poses.iter().flatten().map(|p| p.1 * p.1).collect();
            person.error = (errors.iter().sum::<f64>() / errors.len().max(1) as f64).sqrt();
            person.points = self.shape(&coefficients);
            person.coefficients = coefficients;
        }
        person
    }

    /// One Gauss–Newton step of the coefficients with the poses held; `None` where no picture has a pose.
    fn improved(
        &self,
        person: &PersonShape,
        seen: &[Vec<DVec2>],
        poses: &[Option<(Isometry, f64)>],
    ) -> Option<Vec<f64>> {
        let count = self.modes.len();
        let (mut normal, mut right) = (DMatrix::<f64>::identity(count, count), DVector::<f64>::zeros(count));
        let own = DVector::from_column_slice(&person.coefficients);
        let mut placed = 0;
        for (seen, pose) in seen.iter().zip(poses).filter_map(|(s, p)| Some((s, p.as_ref()?))) {
            placed += 1;
            let (pose, _) = pose;
            for i in 0..68 {
                let p = pose.transform_point(person.points[i]);
                let residual = seen[i] - p.truncate() / p.z;
                let sigma = POINT_ERROR * EYE_DISTANCE_MM / p.z;
                let weight = RIGIDITY[i] / (REPEATED * (sigma * sigma + residual.length_squared()));
                let turned: Vec<DVec3> = self.modes.iter().map(|m| pose.rotation * m[i]).collect();
                for (axis, row) in [(0, DVec3::new(1.0, 0.0, -p.x / p.z)), (1, DVec3::new(0.0, 1.0, -p.y / p.z))] {
                    let along = row / p.z;
                    let j = DVector::from_iterator(count, turned.iter().map(|t| along.dot(*t)));
                    // The target is for the coefficients themselves, not their change: the prior is around 0.
                    let target = residual[axis] + j.dot(&own);
                    normal.ger(weight, &j, &j, 1.0);
                    right.axpy(weight * target, &j, 1.0);
                }
            }
        }
        if placed == 0 {
            return None;
        }
        Some(normal.cholesky()?.solve(&right).as_slice().to_vec())
    }
}

/// The pose of a shape in one picture, and its error as a share of the focal length.
pub fn pose(points: &[DVec3], seen: &[DVec2], start: Option<&Isometry>) -> Option<(Isometry, f64)> {
    let eye = (seen[36] - seen[45]).length();
    pnp::solve(points, seen, &RIGIDITY, (POINT_ERROR * eye).max(1e-6), start)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::se3::{rotation_angle, rotation_exp};

    /// A face-like cloud with two ways to differ.
    fn model() -> ShapeModel {
        let mean: Vec<DVec3> = (0..68u32)
            .map(|i| {
                let t = f64::from(i);
                DVec3::new(65.0 * (t * 1.9).sin(), 60.0 * (t * 0.7).cos(), 40.0 * (t * 1.1).sin() - 10.0)
            })
            .collect();
        let mode =
            |k: f64| mean.iter().map(|p| DVec3::new(0.0, 3.0 * (p.x * k).sin(), 4.0 * (p.y * k).cos())).collect();
        ShapeModel { modes: vec![mode(0.05), mode(0.09)], mean }
    }

    #[test]
    fn the_shape_behind_the_pictures_is_found_and_with_it_the_poses() {
        let (model, lens) = (model(), Lens::new(640, 480, Some(700.0)));
        let truth = model.shape(&[1.4, -1.1]);
        let poses: Vec<Isometry> = (0..40u32)
            .map(|i| {
                let t = f64::from(i);
                let turn = DVec3::new(0.2 * (t * 0.9).sin(), 0.8 * (t * 0.37).sin(), 0.1 * t.cos());
                Isometry::new(rotation_exp(turn), DVec3::new(10.0 * t.sin(), 5.0, 550.0))
            })
            .collect();
        let picture = |pose: &Isometry| {
            std::array::from_fn(|i| {
                let p = lens.project(pose.transform_point(truth[i]));
                [p.x as f32, p.y as f32]
            })
        };
        let pictures: Vec<[[f32; 2]; 68]> = poses.iter().map(picture).collect();
        let found = model.fit(&lens, &pictures);
        assert!(
            (found.coefficients[0] - 1.4).abs() < 0.1 && (found.coefficients[1] + 1.1).abs() < 0.1,
            "{:?}",
            found.coefficients
        );
        let angle = |points: &[DVec3], k: usize| {
            let seen: Vec<DVec2> = pictures[k].iter().map(|p| lens.normalised(*p)).collect();
            rotation_angle(&(pose(points, &seen, None).unwrap().0.rotation * poses[k].rotation.transpose()))
                .to_degrees()
        };
        let mean = |points: &[DVec3]| (0..40).map(|k| angle(points, k)).sum::<f64>() / 40.0;
        let (own, average) = (mean(&found.points), mean(&model.shape(&[])));
        assert!(own < 0.15 && own < 0.3 * average, "{own} {average}");
    }

    #[test]
    fn without_pictures_it_is_the_mean_face() {
        let model = model();
        assert_eq!(model.fit(&Lens::new(640, 480, None), &[]).points, model.shape(&[]));
    }
}
