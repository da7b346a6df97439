//! Convex hulls in the picture, and the mask that keeps COLMAP's features off the face.

use glam::DVec2;
use image::{GrayImage, Luma};
use risorius_formats::Landmarks68;

/// Hull of the landmarks, grown by this about its middle, is the face.
const GROWTH: f64 = 1.15;

/// The corners of the smallest convex shape around `points`, counter-clockwise (Andrew's monotone chain).
pub fn convex_hull(points: &[DVec2]) -> Vec<DVec2> {
    let mut points: Vec<DVec2> = points.iter().copied().filter(|p| p.is_finite()).collect();
    points.sort_unstable_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    points.dedup();
    if points.len() < 3 {
        return points;
    }
    let half = |points: &mut dyn Iterator<Item = DVec2>| {
        let mut chain: Vec<DVec2> = Vec::new();
        for p in points {
            while let [.., a, b] = chain[..]
                && (b - a).perp_dot(p - a) <= 0.0
            {
                chain.pop();
            }
            chain.push(p);
        }
        chain.pop();
        chain
    };
    let mut hull = half(&mut points.iter().copied());
    hull.extend(half(&mut points.iter().rev().copied()));
    hull
}

/// Whether `p` lies inside the counter-clockwise convex polygon.
pub fn contains(hull: &[DVec2], p: DVec2) -> bool {
    hull.len() >= 3 && (0..hull.len()).all(|i| (hull[(i + 1) % hull.len()] - hull[i]).perp_dot(p - hull[i]) >= 0.0)
}

/// 0 on the face, 255 elsewhere; all 255 without landmarks. `scale` is mask pixels per landmark pixel.
pub(crate) fn outside_face(width: u32, height: u32, scale: f64, landmarks: Option<&Landmarks68>) -> GrayImage {
    let mut mask = GrayImage::from_pixel(width, height, Luma([255]));
    let Some(landmarks) = landmarks else { return mask };
    let points: Vec<DVec2> = landmarks.points_px.iter().map(|p| DVec2::new(p[0].into(), p[1].into()) * scale).collect();
    let middle = points.iter().sum::<DVec2>() / points.len() as f64;
    let hull: Vec<DVec2> = convex_hull(&points).into_iter().map(|p| middle + (p - middle) * GROWTH).collect();
    for (x, y, pixel) in mask.enumerate_pixels_mut() {
        if contains(&hull, DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)) {
            *pixel = Luma([0]);
        }
    }
    mask
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_hull_of_a_square_with_inner_points_is_the_square() {
        let square =
            [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0), (2.0, 2.0), (2.0, 0.0), (0.0, 0.0)].map(DVec2::from);
        let hull = convex_hull(&square);
        assert_eq!(hull.len(), 4);
        assert!(contains(&hull, DVec2::new(0.1, 3.9)) && !contains(&hull, DVec2::new(4.1, 2.0)));
        assert!(convex_hull(&square[..2]).len() == 2 && !contains(&square[..2], DVec2::ZERO));
    }

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
