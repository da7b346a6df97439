//! Convex hulls in a picture: of points, and of bodies seen by a camera.

use glam::{DVec2, DVec3};

use crate::Camera;

/// Corners of a body nearer to the camera's plane than this, in world units, have no place in the picture.
const MIN_DEPTH: f64 = 1e-6;

/// The corners of the smallest convex shape around `points` (Andrew's monotone chain), without points on its sides,
/// counter-clockwise where y points up. Points that are not finite are left out; fewer than three distinct points come
/// back as they are, sorted.
pub fn convex_hull(points: &[DVec2]) -> Vec<DVec2> {
    let mut points: Vec<DVec2> = points.iter().copied().filter(|p| p.is_finite()).collect();
    points.sort_unstable_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    points.dedup();
    if points.len() < 3 {
        return points;
    }
    let mut hull = half_hull(points.iter().copied());
    hull.extend(half_hull(points.iter().rev().copied()));
    hull
}

/// The chain of left turns along sorted points, without its last point: the other half begins with it.
fn half_hull(points: impl Iterator<Item = DVec2>) -> Vec<DVec2> {
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
}

/// Whether `p` lies in a convex hull as [`convex_hull`] makes it, its sides included; nothing lies in fewer than three
/// corners.
pub fn hull_contains(hull: &[DVec2], p: DVec2) -> bool {
    hull.len() >= 3 && (0..hull.len()).all(|i| (hull[(i + 1) % hull.len()] - hull[i]).perp_dot(p - hull[i]) >= 0.0)
}

/// The outline of the convex hull of `corners_in_world` in the picture of `camera`, pixels.
///
/// The hull of the projected corners is the projection of the hull as long as all corners lie in front of a camera
/// without distortion; corners behind it are left out.
pub fn projected_hull(corners_in_world: &[DVec3], camera: &Camera) -> Vec<DVec2> {
    let in_front = |p: &&DVec3| camera.camera_from_world.transform_point(**p).z > MIN_DEPTH;
    let pixels: Vec<DVec2> = corners_in_world.iter().filter(in_front).map(|&p| camera.project(p)).collect();
    convex_hull(&pixels)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::{Intrinsics, Isometry};

    #[test]
    fn the_hull_of_a_square_with_inner_points_is_the_square() {
        let square =
            [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0), (2.0, 2.0), (2.0, 0.0), (0.0, 0.0)].map(DVec2::from);
        let hull = convex_hull(&square);
        assert_eq!(hull, [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0)].map(DVec2::from));
        assert!(hull_contains(&hull, DVec2::new(0.1, 3.9)) && hull_contains(&hull, DVec2::new(4.0, 2.0)));
        assert!(!hull_contains(&hull, DVec2::new(4.1, 2.0)));
    }

    #[test]
    fn points_that_span_nothing_hold_nothing() {
        let line = [(0.0, 0.0), (1.0, 1.0), (2.0, 2.0)].map(DVec2::from);
        assert_eq!(convex_hull(&line).len(), 2);
        assert!(!hull_contains(&convex_hull(&line), DVec2::ONE));
        assert!(convex_hull(&[DVec2::NAN, DVec2::new(f64::INFINITY, 0.0)]).is_empty());
        assert!(!hull_contains(&[], DVec2::ZERO));
    }

    #[test]
    fn corners_behind_the_camera_are_left_out() {
        let camera = Camera { intrinsics: Intrinsics::pinhole(100, 100, 100.0), camera_from_world: Isometry::IDENTITY };
        let mut corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (0.0, 0.2)]
            .map(|(x, y)| DVec3::new(x, y, 4.0))
            .to_vec();
        let outline = projected_hull(&corners, &camera);
        assert_eq!(outline, [(25.0, 25.0), (75.0, 25.0), (75.0, 75.0), (25.0, 75.0)].map(DVec2::from));
        corners.extend([DVec3::new(9.0, 9.0, -1.0), DVec3::ZERO]);
        assert_eq!(projected_hull(&corners, &camera), outline);
    }

    proptest! {
        #[test]
        fn hulls_hold_all_points_and_are_made_of_them(points in prop::collection::vec(prop::array::uniform2(-50f64..50.0), 3..40)) {
            let points: Vec<DVec2> = points.into_iter().map(DVec2::from).collect();
            let hull = convex_hull(&points);
            prop_assume!(hull.len() >= 3);
            prop_assert!(hull.iter().all(|p| points.contains(p)));
            // A little wider, as the corners themselves lie on the sides but for rounding.
            let middle = hull.iter().sum::<DVec2>() / hull.len() as f64;
            let wider: Vec<DVec2> = hull.iter().map(|&p| middle + (p - middle) * (1.0 + 1e-9)).collect();
            prop_assert!(points.iter().all(|&p| hull_contains(&wider, p)));
        }
    }
}
