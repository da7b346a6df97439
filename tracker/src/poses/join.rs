//! Two sub-models of one video made one, by the frames that both hold.
//!
//! COLMAP starts a second model where it loses the first, and repeats up to twenty pictures. The similarity between the
//! two worlds follows from the poses of those: turn from the rotations, size and place from the camera centres (and from
//! the turn alone where the cameras stand too close together to tell a size, which is refused).

use std::collections::BTreeMap;

use glam::{DMat3, DVec3};
use nalgebra::Matrix3;
use risorius_formats::Isometry;

use super::model::TakeModel;
use super::triangulate::median;
use crate::se3::rotation_angle;

/// Common frames needed.
const LEAST_COMMON: usize = 3;
/// Common cameras have to agree within this share of their spread …
const MOST_OFF: f64 = 0.1;
/// … and this angle, radians.
const MOST_TURN: f64 = 0.02;

/// `a = scale · rotation · b + translation`.
#[derive(Clone, Copy, Debug)]
struct Similarity {
    scale: f64,
    rotation: DMat3,
    translation: DVec3,
}

/// Adds to `base` the frames and points that only `other` holds; false where they cannot be brought together.
pub(crate) fn join(base: &mut TakeModel, other: &TakeModel) -> bool {
    let common: Vec<(Isometry, Isometry)> = base
        .frames
        .iter()
        .filter_map(|(f, a)| Some((a.camera_from_world, other.frames.get(f)?.camera_from_world)))
        .collect();
    let Some(s) = similarity(&common) else { return false };
    let lens = base.lenses.keys().next().copied().unwrap_or(1);
    let next_id = base.points.keys().next_back().map_or(1, |id| id + 1);
    let mut renamed: BTreeMap<u64, u64> = BTreeMap::new();
    for (&frame, placed) in &other.frames {
        if base.frames.contains_key(&frame) {
            continue;
        }
        let pose = placed.camera_from_world;
        // camera = s⁻¹-scaled: the camera's own units become those of the base.
        let rotation = pose.rotation * s.rotation.transpose();
        let center = s.apply(pose.camera_center());
        let mut added = placed.clone();
        added.lens = lens;
        added.camera_from_world = Isometry::new(rotation, -(rotation * center));
        for p in &mut added.points {
            p.point3d = p.point3d.filter(|id| other.points.contains_key(id)).map(|id| {
                renamed.insert(id, next_id + id);
                next_id + id
            });
        }
        base.frames.insert(frame, added);
    }
    for (old, new) in renamed {
        if let Some(point) = other.points.get(&old) {
            let mut point = point.clone();
            point.position = s.apply(point.position);
            // Image ids are frame + 1; views of frames that the base had already stay the base's.
            point.track.retain(|(image, at)| {
                base.frames
                    .get(&(image - 1))
                    .and_then(|f| f.points.get(*at as usize))
                    .is_some_and(|p| p.point3d == Some(new))
            });
            base.points.insert(new, point);
        }
    }
    true
}

fn similarity(common: &[(Isometry, Isometry)]) -> Option<Similarity> {
    if common.len() < LEAST_COMMON {
        return None;
    }
    // Chordal mean of a_from_b = Rₐᵀ R_b.
    let sum = common.iter().fold(Matrix3::zeros(), |sum, (a, b)| {
        sum + Matrix3::from_column_slice(&(a.rotation.transpose() * b.rotation).to_cols_array())
    });
    let svd = sum.svd(true, true);
    let (u, vt) = (svd.u?, svd.v_t?);
    let sign = (u * vt).determinant().signum();
    let rotation = u * Matrix3::from_diagonal(&nalgebra::Vector3::new(1.0, 1.0, sign)) * vt;
    let rotation = DMat3::from_cols_slice(rotation.as_slice());
    let n = common.len() as f64;
    let centres: Vec<(DVec3, DVec3)> =
        common.iter().map(|(a, b)| (a.camera_center(), rotation * b.camera_center())).collect();
    let (ma, mb) = centres.iter().fold((DVec3::ZERO, DVec3::ZERO), |m, c| (m.0 + c.0 / n, m.1 + c.1 / n));
    let (across, along) = centres
        .iter()
        .fold((0.0, 0.0), |sum, (a, b)| (sum.0 + (*a - ma).dot(*b - mb), sum.1 + (*b - mb).length_squared()));
    let scale = across / along;
    if !(scale.is_finite() && scale > 0.0) {
        return None;
    }
    let s = Similarity { scale, rotation, translation: ma - mb * scale };
    let spread = (centres.iter().map(|(a, _)| a.distance_squared(ma)).sum::<f64>() / n).sqrt();
    let mut off: Vec<f64> =
        common.iter().map(|(a, b)| a.camera_center().distance(s.apply(b.camera_center()))).collect();
    let mut turn: Vec<f64> = common
        .iter()
        .map(|(a, b)| rotation_angle(&(a.rotation * (b.rotation * rotation.transpose()).transpose())))
        .collect();
    (median(&mut off)? <= MOST_OFF * spread && median(&mut turn)? <= MOST_TURN).then_some(s)
}

impl Similarity {
    fn apply(&self, p: DVec3) -> DVec3 {
        self.rotation * p * self.scale + self.translation
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::poses::model::PlacedFrame;
    use crate::se3::{self, Twist};
    use risorius_formats::Intrinsics;
    use risorius_formats::colmap::{Point2d, Point3d};

    fn pose(i: u32) -> Isometry {
        let t = f64::from(i) * 0.05;
        let turn = [0.2 * (3.0 * t).sin(), 0.8 * t, 0.1 * t, 0.0, 0.0, 0.0];
        Isometry::new(DMat3::IDENTITY, DVec3::Z * 2.0).compose(&se3::exp(Twist::from_array(turn)))
    }

    /// Frames of an orbit, in a world of its own: `b = s (turn a + shift)`.
    fn model(frames: std::ops::Range<u32>, scale: f64, turn: DMat3, shift: DVec3) -> TakeModel {
        let lens = Intrinsics::pinhole(640, 480, 600.0);
        let point = DVec3::new(0.1, 0.2, 0.3);
        let first = frames.start;
        let frames = frames.map(|i| {
            let rotation = pose(i).rotation * turn.transpose();
            let center = (turn * pose(i).camera_center() + shift) * scale;
            let position_px = lens.project(pose(i).transform_point(point)).to_array();
            let points = vec![Point2d { position_px, point3d: Some(1) }];
            (i, PlacedFrame { lens: 1, camera_from_world: Isometry::new(rotation, -(rotation * center)), points })
        });
        let frames: BTreeMap<u32, PlacedFrame> = frames.collect();
        let track = frames.keys().map(|f| (f + 1, 0)).collect();
        let position = (turn * point + shift) * scale;
        assert!(frames.contains_key(&first));
        TakeModel {
            lenses: BTreeMap::from([(1, lens)]),
            frames,
            points: BTreeMap::from([(1, Point3d { position, rgb: [0; 3], error_px: 0.0, track })]),
        }
    }

    #[test]
    fn a_second_world_is_brought_into_the_first() {
        let mut base = model(0..10, 1.0, DMat3::IDENTITY, DVec3::ZERO);
        let turn = se3::rotation_exp(DVec3::new(0.4, -1.0, 2.0));
        assert!(join(&mut base, &model(6..15, 3.7, turn, DVec3::new(1.0, -2.0, 0.5))));
        assert_eq!(base.frames.len(), 15);
        for (&i, placed) in &base.frames {
            let off = se3::log(&placed.camera_from_world.compose(&pose(i).inverse()));
            assert!(off.rotation.length() < 1e-9 && off.translation.length() < 1e-9, "{i}: {off:?}");
        }
        // The points of the new frames came along and project where they were seen.
        assert_eq!(base.points.len(), 2);
        assert!(base.reprojection_error_px().unwrap() < 1e-9);
        assert_eq!(base.points.values().last().unwrap().track.len(), 5);
    }

    #[test]
    fn worlds_without_common_frames_or_that_disagree_stay_apart() {
        let mut base = model(0..10, 1.0, DMat3::IDENTITY, DVec3::ZERO);
        assert!(!join(&mut base, &model(8..15, 2.0, DMat3::IDENTITY, DVec3::ZERO)));
        let mut wrong = model(4..15, 2.0, DMat3::IDENTITY, DVec3::ZERO);
        for (i, frame) in &mut wrong.frames {
            frame.camera_from_world = pose(i * 7 % 20);
        }
        assert!(!join(&mut base, &wrong));
        assert_eq!((base.frames.len(), base.points.len()), (10, 1));
    }
}
