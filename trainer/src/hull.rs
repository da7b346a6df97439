//! The outline of the head's hull in an image: what lies outside was never fitted.

use glam::{DVec2, DVec3};
use risorius_formats::Camera;

/// A convex polygon, counter-clockwise in a y-up sense.
#[derive(Clone, Debug)]
pub struct Outline {
    corners: Vec<DVec2>,
}

impl Outline {
    /// The convex hull of the projections of `corners_in_world`; corners behind the camera are left out.
    pub fn of(corners_in_world: &[DVec3], camera: &Camera) -> Self {
        let in_front = |p: &&DVec3| camera.camera_from_world.transform_point(**p).z > 1e-9;
        let mut points: Vec<DVec2> = corners_in_world.iter().filter(in_front).map(|p| camera.project(*p)).collect();
        points.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
        points.dedup();
        // Andrew's monotone chain.
        let half = |points: &mut dyn Iterator<Item = DVec2>| {
            let mut chain: Vec<DVec2> = Vec::new();
            for p in points {
                while chain.len() >= 2 && turn(chain[chain.len() - 2], chain[chain.len() - 1], p) <= 0.0 {
                    chain.pop();
                }
                chain.push(p);
            }
            chain.pop();
            chain
        };
        let mut corners = half(&mut points.iter().copied());
        corners.extend(half(&mut points.iter().rev().copied()));
        Self { corners }
    }

    /// Whether a pixel position lies inside.
    pub fn contains(&self, p: DVec2) -> bool {
        let n = self.corners.len();
        n >= 3 && (0..n).all(|i| turn(self.corners[i], self.corners[(i + 1) % n], p) >= 0.0)
    }
}

fn turn(a: DVec2, b: DVec2, c: DVec2) -> f64 {
    (b - a).perp_dot(c - a)
}

#[cfg(test)]
mod tests {
    use risorius_formats::{Intrinsics, Isometry};

    use super::*;

    #[test]
    fn a_square_contains_its_middle_only() {
        let camera = Camera { intrinsics: Intrinsics::pinhole(100, 100, 100.0), camera_from_world: Isometry::IDENTITY };
        let corners =
            [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (0.0, 0.2)].map(|(x, y)| DVec3::new(x, y, 4.0));
        let outline = Outline::of(&corners, &camera);
        assert_eq!(outline.corners.len(), 4);
        assert!(outline.contains(DVec2::new(50.0, 50.0)) && outline.contains(DVec2::new(26.0, 74.0)));
        assert!(!outline.contains(DVec2::new(24.0, 50.0)) && !outline.contains(DVec2::new(50.0, 76.0)));
    }
}
