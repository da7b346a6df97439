//! The mask that keeps COLMAP's features off the face.

use glam::DVec2;
use image::{GrayImage, Luma};
use risorius_formats::Landmarks68;
use risorius_formats::polygon::{convex_hull, hull_contains};

/// Hull of the landmarks, grown by this about its middle, is the face.
const GROWTH: f64 = 1.15;

/// 0 on the face, 255 elsewhere; all 255 without landmarks. `scale` is mask pixels per landmark pixel.
pub(crate) fn outside_face(width: u32, height: u32, scale: f64, landmarks: Option<&Landmarks68>) -> GrayImage {
    let mut mask = GrayImage::from_pixel(width, height, Luma([255]));
    let Some(landmarks) = landmarks else { return mask };
    let hull = face_outline(landmarks, scale);
    for (x, y, pixel) in mask.enumerate_pixels_mut() {
        if hull_contains(&hull, DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)) {
            *pixel = Luma([0]);
        }
    }
    mask
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
        let mask = outside_face(60, 60, 0.5, Some(&landmarks));
        assert_eq!(mask.get_pixel(30, 28).0, [0]);
        assert_eq!(mask.get_pixel(10, 10).0, [255]);
        assert!(outside_face(8, 8, 1.0, None).pixels().all(|p| p.0 == [255]));
    }
}
