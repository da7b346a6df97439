//! OpenFace's aligned and masked face: 112 × 112 px.
//!
//! A similarity brings the rigid points to 0.7 × the mean shape, with the point model's origin in the middle. Outside the
//! triangles over the 68 points, with the brows and both ends of the outline raised by 30 px, it is black.

use std::path::Path;

use glam::{DMat2, DVec2};
use image::RgbImage;

use super::matrix::{self, damaged};
use super::point_model::{Fit, POINTS, PointModel};
use crate::aus::face::{AlignedFace, PLANE, SIDE, inside};
use crate::error::Result;

/// Pixels per unit of the point model.
const SCALE: f64 = 0.7;
/// The middle of the aligned face, px.
const MIDDLE: f64 = 56.0;
/// How far brows and the ends of the outline are raised, px.
const RAISED: f64 = 30.0;
/// Points that move little with expressions, from 0.
const RIGID: [usize; 24] = [1, 2, 3, 4, 12, 13, 14, 15, 27, 28, 29, 31, 32, 33, 34, 35, 36, 39, 40, 41, 42, 45, 46, 47];

/// Reads the triangles: a matrix with three corners a row.
pub fn read_triangles(path: &Path) -> Result<Vec<[usize; 3]>> {
    let matrices = matrix::read_text(path)?;
    let is_corner = |v: &f64| v.fract() == 0.0 && (0.0..POINTS as f64).contains(v);
    match matrices.first() {
        Some(m) if m.columns == 3 && m.values.iter().all(is_corner) => {
            Ok(m.values.chunks_exact(3).map(|t| [0, 1, 2].map(|k| t[k] as usize)).collect())
        }
        _ => Err(damaged(path, "is no matrix of triangles over 68 points").into()),
    }
}

/// The face with the points `points` (px, the centre of the first pixel at 0). `None` where the rigid points coincide.
pub fn face(
    picture: &RgbImage,
    points: &[DVec2; POINTS],
    fit: &Fit,
    model: &PointModel,
    triangles: &[[usize; 3]],
) -> Option<AlignedFace> {
    let front = model.front().map(|p| p * SCALE);
    let linear = turn_and_scale(points, &front)?;
    let shift = DVec2::splat(MIDDLE) - linear * fit.translation;
    let mask = mask(&points.map(|p| linear * p + shift), triangles);
    let back = linear.inverse();
    let mut levels = vec![0.0; 3 * PLANE];
    for (at, _) in mask.iter().enumerate().filter(|(_, inside)| **inside) {
        let place = DVec2::new((at % SIDE) as f64, (at / SIDE) as f64);
        for (c, level) in bilinear(picture, back * (place - shift)).into_iter().enumerate() {
            levels[c * PLANE + at] = level;
        }
    }
    Some(AlignedFace { levels })
}

/// The rotation that brings the rigid points of `from` nearest to those of `to`, times the ratio of their sizes.
fn turn_and_scale(from: &[DVec2; POINTS], to: &[DVec2; POINTS]) -> Option<DMat2> {
    let mean = |points: &[DVec2; POINTS]| RIGID.iter().map(|i| points[*i]).sum::<DVec2>() / RIGID.len() as f64;
    let (a, b) = (mean(from), mean(to));
    let (mut dot, mut cross, mut size_from, mut size_to) = (0.0, 0.0, 0.0, 0.0);
    for i in RIGID {
        let (p, q) = (from[i] - a, to[i] - b);
        dot += p.dot(q);
        cross += p.perp_dot(q);
        size_from += p.length_squared();
        size_to += q.length_squared();
    }
    let linear = DMat2::from_angle(cross.atan2(dot)) * (size_to / size_from).sqrt();
    (size_from > 1e-9 && linear.determinant().is_finite() && linear.determinant() > 1e-12).then_some(linear)
}

/// Which pixels lie in a triangle.
fn mask(points: &[DVec2; POINTS], triangles: &[[usize; 3]]) -> Vec<bool> {
    let raised = |i: usize| {
        let up = if i == 0 || (16..27).contains(&i) { RAISED } else { 0.0 };
        // The rows and columns of `inside` are counted from the edge of the first pixel.
        [points[i].x as f32 + 0.5, (points[i].y - up) as f32 + 0.5]
    };
    let mut mask = vec![false; PLANE];
    for triangle in triangles {
        let corners = triangle.map(raised);
        let rows = corners.iter().fold([f32::MAX, f32::MIN], |[l, h], c| [l.min(c[1]), h.max(c[1])]);
        let [from, to] = rows.map(|v| v.clamp(0.0, SIDE as f32));
        for row in from as usize..(to.ceil() as usize).min(SIDE) {
            for [from, to] in inside(&corners, row as f32 + 0.5) {
                mask[row * SIDE + from..row * SIDE + to.max(from)].fill(true);
            }
        }
    }
    mask
}

/// Levels at a point, rounded to whole ones as OpenFace's pictures are; black outside.
fn bilinear(picture: &RgbImage, at: DVec2) -> [f32; 3] {
    let (x, y) = (at.x.floor(), at.y.floor());
    let (fx, fy) = (at.x - x, at.y - y);
    let mut sum = [0.0; 3];
    for (dx, dy, weight) in [
        (0.0, 0.0, (1.0 - fx) * (1.0 - fy)),
        (1.0, 0.0, fx * (1.0 - fy)),
        (0.0, 1.0, (1.0 - fx) * fy),
        (1.0, 1.0, fx * fy),
    ] {
        let (px, py) = (x + dx, y + dy);
        if px >= 0.0
            && py >= 0.0
            && let Some(pixel) = picture.get_pixel_checked(px as u32, py as u32)
        {
            sum.iter_mut().zip(pixel.0).for_each(|(s, level)| *s += weight * f64::from(level));
        }
    }
    sum.map(|v| v.round() as f32)
}
