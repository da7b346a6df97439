//! Where the cameras stand, seen from the head: directions, the cells they fall into, and how well a choice covers them.
//!
//! Directions are unit vectors from the middle of the face to the camera in the head's own axes (x to the image's right,
//! y down, z away from a camera in front), so that they mean the same whether the camera moves or the head.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;
use risorius_formats::{Camera, Isometry};
use serde::{Deserialize, Serialize};

/// Side of a cell of directions, degrees.
pub const CELL_DEG: f64 = 10.0;

/// The direction of `camera` from the head; `None` where the camera stands in the head's middle.
pub fn direction(camera: &Camera, world_from_head: &Isometry) -> Option<DVec3> {
    world_from_head.inverse().transform_point(camera.center()).try_normalize()
}

/// Yaw (positive: the camera stands to the image's right of the face) and pitch (positive: above it), degrees.
pub fn yaw_pitch_deg(direction: DVec3) -> [f64; 2] {
    let yaw = direction.x.atan2(-direction.z);
    let pitch = (-direction.y).clamp(-1.0, 1.0).asin();
    [yaw.to_degrees(), pitch.to_degrees()]
}

/// The direction of a yaw and a pitch.
pub fn direction_of([yaw_deg, pitch_deg]: [f64; 2]) -> DVec3 {
    let (yaw, pitch) = (yaw_deg.to_radians(), pitch_deg.to_radians());
    DVec3::new(yaw.sin() * pitch.cos(), -pitch.sin(), -yaw.cos() * pitch.cos())
}

/// The cell of a yaw and a pitch: whole steps of [`CELL_DEG`], the middle cell around the frontal view.
pub fn cell([yaw, pitch]: [f64; 2]) -> [i32; 2] {
    [yaw, pitch].map(|v| (v / CELL_DEG + 0.5).floor() as i32)
}

/// How well a choice covers the views that a capture has.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Coverage {
    /// Cells of [`CELL_DEG`] that any usable frame looks from.
    pub cells: usize,
    /// Those that a chosen frame looks from.
    pub cells_chosen: usize,
    /// Entropy of the chosen frames over the cells, as a share of the largest possible; 1 is perfectly even.
    pub entropy: f64,
    /// Mean angle from a usable frame's view to the nearest chosen one, degrees.
    pub mean_gap_deg: f64,
    /// The largest such angle, degrees.
    pub largest_gap_deg: f64,
    /// Smallest and largest yaw of the chosen views, degrees.
    pub yaw_deg: [f64; 2],
    /// Smallest and largest pitch of the chosen views, degrees.
    pub pitch_deg: [f64; 2],
}

/// How `chosen` (indices into `views`, yaw and pitch in degrees) covers `views`; zeros without any.
pub fn coverage(views: &[[f64; 2]], chosen: &[usize]) -> Coverage {
    let cells: BTreeSet<_> = views.iter().map(|&v| cell(v)).collect();
    let mut counts: BTreeMap<[i32; 2], usize> = BTreeMap::new();
    for &c in chosen {
        *counts.entry(cell(views[c])).or_default() += 1;
    }
    let total = chosen.len() as f64;
    let entropy: f64 = counts.values().map(|&c| c as f64 / total).map(|p| -p * p.ln()).sum();
    let near: Vec<DVec3> = chosen.iter().map(|&c| direction_of(views[c])).collect();
    let gap = |view: &[f64; 2]| {
        let d = direction_of(*view);
        // The chord is exact where the cosine of a small angle is not.
        let chord = near.iter().map(|n| n.distance_squared(d)).fold(f64::INFINITY, f64::min).sqrt();
        2.0 * (chord / 2.0).clamp(0.0, 1.0).asin().to_degrees()
    };
    let gaps: Vec<f64> = if near.is_empty() { Vec::new() } else { views.iter().map(gap).collect() };
    let span = |axis: usize| {
        let values = chosen.iter().map(|&c| views[c][axis]);
        let range = values.fold([f64::INFINITY, f64::NEG_INFINITY], |[lo, hi], v| [lo.min(v), hi.max(v)]);
        if chosen.is_empty() { [0.0; 2] } else { range }
    };
    Coverage {
        cells: cells.len(),
        cells_chosen: counts.len(),
        entropy: if cells.len() > 1 && total > 0.0 { entropy / (cells.len() as f64).ln() } else { 1.0 },
        mean_gap_deg: gaps.iter().sum::<f64>() / gaps.len().max(1) as f64,
        largest_gap_deg: gaps.iter().copied().fold(0.0, f64::max),
        yaw_deg: span(0),
        pitch_deg: span(1),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use risorius_formats::Intrinsics;

    use super::*;

    #[test]
    fn a_camera_to_the_right_and_above_has_positive_angles() {
        // The head frame is the world; a camera in front stands at negative z.
        let at = |p: DVec3| Camera {
            intrinsics: Intrinsics::pinhole(10, 10, 10.0),
            camera_from_world: Isometry::new(glam::DMat3::IDENTITY, -p),
        };
        let angles = |p: DVec3| yaw_pitch_deg(direction(&at(p), &Isometry::IDENTITY).unwrap());
        assert_eq!(angles(DVec3::new(0.0, 0.0, -2.0)), [0.0, 0.0]);
        let right = angles(DVec3::new(1.0, 0.0, -1.0));
        assert!((right[0] - 45.0).abs() < 1e-9 && right[1].abs() < 1e-9);
        assert!((angles(DVec3::new(0.0, -1.0, -1.0))[1] - 45.0).abs() < 1e-9);
        assert!(direction(&at(DVec3::ZERO), &Isometry::IDENTITY).is_none());
    }

    #[test]
    fn coverage_of_known_views() {
        // Two cells, 20° apart, one of them chosen: the other view is 20° from it.
        let views = [[0.0, 0.0], [1.0, 0.0], [20.0, 0.0]];
        let c = coverage(&views, &[0]);
        assert_eq!((c.cells, c.cells_chosen, c.entropy), (2, 1, 0.0));
        assert!((c.largest_gap_deg - 20.0).abs() < 1e-9 && (c.mean_gap_deg - 7.0).abs() < 1e-9);
        let all = coverage(&views, &[0, 2]);
        assert!((all.entropy - 1.0).abs() < 1e-12 && all.yaw_deg == [0.0, 20.0]);
        assert_eq!(coverage(&[], &[]).cells, 0);
    }

    proptest! {
        #[test]
        fn directions_and_angles_are_inverse(yaw in -179f64..179.0, pitch in -89f64..89.0) {
            let back = yaw_pitch_deg(direction_of([yaw, pitch]));
            prop_assert!((back[0] - yaw).abs() < 1e-9 && (back[1] - pitch).abs() < 1e-9);
        }
    }
}
