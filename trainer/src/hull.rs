//! The outline of the head's hull in an image: what lies outside was never fitted.

use glam::{DVec2, DVec3};
use risorius_formats::Camera;
use risorius_formats::polygon::{hull_contains, projected_hull};

/// A convex polygon, counter-clockwise in a y-up sense.
#[derive(Clone, Debug)]
pub struct Outline {
    corners: Vec<DVec2>,
}

impl Outline {
    /// The convex hull of the projections of `corners_in_world`; corners behind the camera are left out.
    pub fn of(corners_in_world: &[DVec3], camera: &Camera) -> Self {
        Self { corners: projected_hull(corners_in_world, camera) }
    }

    /// Whether a pixel position lies inside.
    pub fn contains(&self, p: DVec2) -> bool {
        hull_contains(&self.corners, p)
    }
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
