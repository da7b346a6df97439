//! OpenFace's own AU models, for users who have them (`tracker run --aus openface`).
//!
//! The pipeline of OpenFace 2.x (Baltrušaitis et al. 2018; 2015 for the person's own median): the 68 points are fitted by a
//! point model ([`point_model`]), the face is aligned and masked ([`aligned`]), its FHOG and the shape's displacements make
//! [`HOG_NUMBERS`] + 204 + modes numbers x, and each AU is linear in x ([`predictors`]). What depends on the whole clip, the
//! median of x and the quantile that counts as rest, comes between the two passes ([`clip`]).
//!
//! The models are for academic, non-commercial use. Nothing of them is part of this project.

pub mod aligned;
pub mod clip;
pub mod folder;
pub mod matrix;
mod offsets;
pub mod point_model;
pub mod predictors;

use std::path::Path;

use glam::DVec2;
use image::RgbImage;

use super::fhog::{FHOG_NUMBERS, fhog};
use crate::error::Result;
use folder::ModelFiles;
use point_model::{Fit, POINTS, PointModel};
use predictors::Predictors;

/// Numbers of x that describe the skin: 12 × 12 cells of 31.
pub const HOG_NUMBERS: usize = FHOG_NUMBERS;
/// Numbers of a cell.
const CELL_NUMBERS: usize = 31;
/// Where the four texture energies of dlib's FHOG lie among this project's: lower right, upper right, lower left, upper left.
const TEXTURE_ORDER: [usize; 4] = [3, 1, 2, 0];
/// How much stiffer the point model is for the tracker's own points than for points that it made itself.
const STIFFNESS: f64 = 10.0;

/// The models of an OpenFace install.
#[derive(Clone, Debug)]
pub struct OpenFaceModels {
    point_model: PointModel,
    /// Corners of the triangles that cover the face.
    triangles: Vec<[usize; 3]>,
    /// One linear function per AU and purpose.
    pub predictors: Predictors,
}

impl OpenFaceModels {
    /// Reads the models; `dir` is the install's root, its `AU_predictors` or its `model` folder.
    pub fn open(dir: &Path) -> Result<Self> {
        let files = ModelFiles::find(dir)?;
        let point_model = PointModel::read(&files.point_model)?;
        let triangles = aligned::read_triangles(&files.triangles)?;
        let predictors = Predictors::read(&files.predictors, HOG_NUMBERS + point_model.numbers())?;
        Ok(Self { point_model, triangles, predictors })
    }

    /// How many numbers x has.
    pub fn numbers(&self) -> usize {
        HOG_NUMBERS + self.point_model.numbers()
    }

    /// x of a face with the 68 points `points_px` (the centre of the first pixel at 0.5): FHOG, displacements of the 68
    /// points (all x, all y, all z), coefficients of the modes. `None` where no face can be fitted.
    pub fn describe(&self, picture: &RgbImage, points_px: &[[f32; 2]; POINTS]) -> Option<Vec<f32>> {
        let (points, fit) = self.place(points_px)?;
        let face = aligned::face(picture, &points, &fit, &self.point_model, &self.triangles)?;
        let mut numbers = dlib_order(&fhog(&face));
        numbers.extend(self.point_model.displacements(&fit.coefficients).iter().map(|v| *v as f32));
        numbers.extend(fit.coefficients.iter().map(|v| *v as f32));
        numbers.iter().all(|v| v.is_finite()).then_some(numbers)
    }

    /// The points where OpenFace would see them (the centre of the first pixel at 0), and the fit of the point model to them.
    fn place(&self, points_px: &[[f32; 2]; POINTS]) -> Option<([DVec2; POINTS], Fit)> {
        let seen = points_px.map(|[x, y]| DVec2::new(f64::from(x) - 0.5, f64::from(y) - 0.5));
        let fit = self.point_model.fit(&seen, STIFFNESS)?;
        let unit = self.point_model.outer_eye_distance() * fit.scale;
        let moved = std::array::from_fn(|i| seen[i] + (fit.rotation * offsets::offset(i)).truncate() * unit);
        let fit = self.point_model.refit(fit, &moved, STIFFNESS)?;
        let points = self.point_model.project(&fit);
        let fit = self.point_model.refit(fit, &points, 1.0)?;
        Some((points, fit))
    }
}

/// This project's FHOG in dlib's order.
fn dlib_order(fhog: &[f32]) -> Vec<f32> {
    let mut out = fhog.to_vec();
    for (cell, ours) in out.chunks_exact_mut(CELL_NUMBERS).zip(fhog.chunks_exact(CELL_NUMBERS)) {
        let first = CELL_NUMBERS - TEXTURE_ORDER.len();
        for (k, from) in TEXTURE_ORDER.into_iter().enumerate() {
            cell[first + k] = ours[first + from];
        }
    }
    out
}

#[cfg(test)]
#[path = "openface_tests.rs"]
mod tests;
