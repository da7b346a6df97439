//! The mask that keeps COLMAP's features off the face.

use std::collections::BTreeMap;

use glam::DVec2;
use image::{GrayImage, Luma};
use rayon::prelude::*;
use risorius_formats::Landmarks68;
use risorius_formats::polygon::{convex_hull, hull_contains};

use super::patch::Template;
use super::picture::Picture;
use super::triangulate::median;

/// Distance of the places that are tried for texture, pixels.
pub(crate) const GRID_PX: u32 = 20;
/// Strength of a textured place: grey values × 16 per pixel, squared.
pub(crate) const STRONG: f32 = 900.0;
/// Hull of the landmarks, grown by this about its middle, is the face.
const GROWTH: f64 = 1.15;

/// 0 within the outline, 255 elsewhere; all 255 without one. `scale` is mask pixels per outline pixel.
pub(crate) fn outside_face(width: u32, height: u32, scale: f64, outline: Option<&[DVec2]>) -> GrayImage {
    let mut mask = GrayImage::from_pixel(width, height, Luma([255]));
    let Some(outline) = outline else { return mask };
    let hull: Vec<DVec2> = outline.iter().map(|p| *p * scale).collect();
    for (x, y, pixel) in mask.enumerate_pixels_mut() {
        if hull_contains(&hull, DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)) {
            *pixel = Luma([0]);
        }
    }
    mask
}

/// Places with texture beside the face, on a grid of [`GRID_PX`]: the median over some of the pictures.
pub(crate) fn texture_outside(pictures: &BTreeMap<u32, Picture>, outlines: &BTreeMap<u32, Vec<DVec2>>) -> usize {
    let step = pictures.len().div_ceil(8).max(1);
    let chosen: Vec<_> = pictures.iter().filter_map(|(f, p)| Some((p, outlines.get(f)?))).step_by(step).collect();
    let mut counts: Vec<f64> = chosen
        .par_iter()
        .map(|(picture, outline)| {
            let [width, height] = picture.size();
            let places = (0..height / GRID_PX).flat_map(|y| (0..width / GRID_PX).map(move |x| (x, y)));
            let textured = |(x, y): (u32, u32)| {
                let at = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5) * f64::from(GRID_PX);
                !hull_contains(outline, at)
                    && Template::cut(picture, 0, at, false).is_some_and(|t| t.strength >= STRONG)
            };
            places.filter(|p| textured(*p)).count() as f64
        })
        .collect();
    median(&mut counts).unwrap_or(0.0) as usize
}

/// The grown hull of the landmarks; `scale` is its pixels per landmark pixel.
pub(crate) fn face_outline(landmarks: &Landmarks68, scale: f64) -> Vec<DVec2> {
    let points: Vec<DVec2> = landmarks.points_px.iter().map(|p| DVec2::new(p[0].into(), p[1].into()) * scale).collect();
    let middle = points.iter().sum::<DVec2>() / points.len() as f64;
    convex_hull(&points).into_iter().map(|p| middle + (p - middle) * GROWTH).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mask_is_black_on_the_face_only() {
        let landmarks = Landmarks68 {
            points_px: std::array::from_fn(|i| [40.0 + (i % 9) as f32 * 5.0, 40.0 + (i / 9) as f32 * 5.0]),
        };
        let mask = outside_face(60, 60, 0.5, Some(&face_outline(&landmarks, 1.0)));
        assert_eq!(mask.get_pixel(30, 28).0, [0]);
        assert_eq!(mask.get_pixel(10, 10).0, [255]);
        assert!(outside_face(8, 8, 1.0, None).pixels().all(|p| p.0 == [255]));
    }
}
