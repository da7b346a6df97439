//! The space of the Gaussians: metres, with the head's middle as origin and the axes of the mean camera (x right, y down,
//! z forward), so that depth, which parallax tells least about, is an axis of its own.

use glam::{DMat3, DVec3};
use risorius_formats::{Camera, Similarity};
use serde::{Deserialize, Serialize};

use crate::data::TrainData;

/// Distance of the farthest landmark from the middle of an adult's face, metres.
const FACE_RADIUS_M: f64 = 0.09;
/// How far a camera is taken to stand from a head where nothing tells sizes, metres.
const CAMERA_DISTANCE_M: f64 = 0.6;

/// `metric = metric_from_world · (world − origin) · metres_per_unit`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MetricSpace {
    /// Metres per world unit.
    pub metres_per_unit: f64,
    /// The head's middle, world units.
    pub origin_in_world: DVec3,
    /// The rotation from the world's axes to those of the mean camera.
    pub metric_from_world: DMat3,
}

impl MetricSpace {
    /// The space of a dataset: its own unit where it is known, else that of a head of usual size.
    pub fn of(data: &TrainData) -> Self {
        let head = data.extras().map(|e| (e.head_center, e.head_radius));
        let origin_in_world = head.map_or(data.dataset.scene.center_in_world, |h| h.0);
        let known = data.extras().and_then(|e| e.units_per_metre).filter(|u| u.is_normal() && *u > 0.0);
        let by_head = || head.filter(|h| h.1.is_normal() && h.1 > 0.0).map(|h| FACE_RADIUS_M / h.1);
        let by_cameras = || {
            let distances = data.frames.iter().map(|f| (f.camera.center() - origin_in_world).length());
            let mean = distances.sum::<f64>() / data.frames.len().max(1) as f64;
            if mean.is_normal() { CAMERA_DISTANCE_M / mean } else { 1.0 }
        };
        let metres_per_unit = known.map(f64::recip).or_else(by_head).unwrap_or_else(by_cameras);
        Self { metres_per_unit, origin_in_world, metric_from_world: mean_axes(data) }
    }

    /// The similarity from the world.
    pub fn from_world(&self) -> Similarity {
        let scale = self.metres_per_unit;
        let rotation = self.metric_from_world;
        Similarity { scale, rotation, translation: -(rotation * self.origin_in_world) * scale }
    }

    /// A camera of the world in this space.
    pub fn camera(&self, camera: &Camera) -> Camera {
        let camera_from_world = self.from_world().transform_pose(&camera.camera_from_world);
        Camera { intrinsics: camera.intrinsics, camera_from_world }
    }

    /// A point of the world in this space.
    pub fn point(&self, point_in_world: DVec3) -> DVec3 {
        self.from_world().transform_point(point_in_world)
    }

    /// Radius of the face, metres: from its landmarks where they are known.
    pub fn face_radius_m(&self, data: &TrainData) -> f64 {
        let radius = data.extras().map_or(0.0, |e| e.head_radius * self.metres_per_unit);
        if radius.is_normal() && radius > 0.0 { radius } else { FACE_RADIUS_M }
    }
}

/// The axes of the mean camera, as rows.
fn mean_axes(data: &TrainData) -> DMat3 {
    let row = |r: usize| data.frames.iter().map(|f| f.camera.camera_from_world.rotation.row(r)).sum::<DVec3>();
    let forward = row(2).normalize_or(DVec3::Z);
    let down = row(1);
    let Some(down) = (down - forward * down.dot(forward)).try_normalize() else { return DMat3::IDENTITY };
    DMat3::from_cols(down.cross(forward), down, forward).transpose()
}

#[cfg(test)]
mod tests {
    use risorius_formats::{Intrinsics, Isometry};

    use super::*;

    #[test]
    fn a_camera_sees_the_same_in_metres() {
        let space = MetricSpace {
            metres_per_unit: 0.09 / 2.5,
            origin_in_world: DVec3::new(1.0, -2.0, 3.0),
            metric_from_world: DMat3::from_rotation_x(0.7),
        };
        let camera = Camera {
            intrinsics: Intrinsics::pinhole(270, 480, 576.0),
            camera_from_world: Isometry::new(DMat3::from_rotation_y(0.4), DVec3::new(0.5, 0.2, 20.0)),
        };
        let point = DVec3::new(2.0, -1.0, 2.5);
        let metric = space.camera(&camera);
        assert!((metric.project(space.point(point)) - camera.project(point)).length() < 1e-9);
        assert!((space.point(space.origin_in_world)).length() < 1e-12);
        let (far, metric_far) = ((camera.center() - point).length(), (metric.center() - space.point(point)).length());
        assert!((far * space.metres_per_unit - metric_far).abs() < 1e-12);
    }
}
