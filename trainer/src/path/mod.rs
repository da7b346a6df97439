//! Camera paths around the head.

mod file;
mod orbit;

pub use file::{CameraPath, Moment, PathKey};
pub use orbit::Orbit;

use glam::{DMat3, DVec3};
use risorius_formats::{Camera, Isometry};

/// Yaw (sideways) and pitch (up) of a camera around `center`, relative to where `reference` stands, radians.
fn angles(reference: &Camera, camera: &Camera, center: DVec3) -> [f64; 2] {
    let r = reference.camera_from_world.rotation;
    // In the reference camera's axes: the direction from the head to the camera; straight back is −z.
    let d = r * (camera.center() - center).normalize_or_zero();
    let d0 = r * (reference.center() - center).normalize_or_zero();
    let yaw = |v: DVec3| v.x.atan2(-v.z);
    let pitch = |v: DVec3| (-v.y).clamp(-1.0, 1.0).asin();
    [yaw(d) - yaw(d0), pitch(d) - pitch(d0)]
}

/// Three quarters of the angles that nine tenths of the cameras stay within.
pub fn spread(reference: &Camera, cameras: &[Camera], center: DVec3) -> [f64; 2] {
    std::array::from_fn(|axis| {
        let mut all: Vec<f64> = cameras.iter().map(|c| angles(reference, c, center)[axis].abs()).collect();
        all.sort_by(f64::total_cmp);
        let at = (all.len() * 9 / 10).min(all.len().saturating_sub(1));
        all.get(at).copied().unwrap_or(0.0) * 0.75
    })
}

/// `camera` with the head turned before it: the whole scene turns about the head's middle, in the camera's axes.
pub fn turned(camera: &Camera, center_in_world: DVec3, turn: DMat3) -> Camera {
    if turn == DMat3::IDENTITY {
        return *camera;
    }
    let middle = camera.camera_from_world.transform_point(center_in_world);
    let about = Isometry::new(turn, middle - turn * middle);
    Camera { intrinsics: camera.intrinsics, camera_from_world: about.compose(&camera.camera_from_world) }
}

/// `reference` swung around `center` by yaw and pitch, looking at the same spot of its image.
pub fn swing(reference: &Camera, center: DVec3, yaw_rad: f64, pitch_rad: f64) -> Camera {
    // The world turns the other way round: X' = Q (X − c) + c seen by the unmoved camera.
    let r = reference.camera_from_world.rotation;
    let turn_in_camera = DMat3::from_rotation_x(pitch_rad) * DMat3::from_rotation_y(yaw_rad);
    let q = r.transpose() * turn_in_camera * r;
    let world_turn = Isometry::new(q, center - q * center);
    Camera { intrinsics: reference.intrinsics, camera_from_world: reference.camera_from_world.compose(&world_turn) }
}

/// `count` cameras on a closed ellipse of half angles `extent_rad` around the head.
pub fn orbit(reference: &Camera, center: DVec3, extent_rad: [f64; 2], count: usize) -> Vec<Camera> {
    (0..count)
        .map(|i| {
            let (sin, cos) = (std::f64::consts::TAU * i as f64 / count.max(1) as f64).sin_cos();
            swing(reference, center, extent_rad[0] * sin, extent_rad[1] * cos)
        })
        .collect()
}

/// `count` cameras that wind outwards from the middle to an ellipse of half angles `extent_rad`, `turns` times around.
pub fn spiral(reference: &Camera, center: DVec3, extent_rad: [f64; 2], turns: f64, count: usize) -> Vec<Camera> {
    (0..count)
        .map(|i| {
            let t = i as f64 / count.saturating_sub(1).max(1) as f64;
            let (sin, cos) = (std::f64::consts::TAU * turns * t).sin_cos();
            swing(reference, center, extent_rad[0] * t * sin, extent_rad[1] * t * cos)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use risorius_formats::Intrinsics;

    use super::*;

    #[test]
    fn swinging_keeps_the_distance_and_moves_by_the_angle() {
        let camera = Camera {
            intrinsics: Intrinsics::pinhole(64, 64, 80.0),
            camera_from_world: Isometry::new(DMat3::from_rotation_y(0.3), DVec3::new(0.1, -0.2, 2.0)),
        };
        let center = DVec3::new(0.05, 0.1, 0.0);
        let swung = swing(&camera, center, 0.4, 0.2);
        assert!(((swung.center() - center).length() - (camera.center() - center).length()).abs() < 1e-12);
        assert!((swung.project(center) - camera.project(center)).length() < 1e-9);
        let [yaw, _] = angles(&camera, &swing(&camera, center, 0.4, 0.0), center);
        assert!((yaw.abs() - 0.4).abs() < 0.02, "{yaw}");
        let up = swing(&camera, center, 0.0, 0.2).center() - camera.center();
        // Up is −y of the camera.
        assert!((camera.camera_from_world.rotation * up).y < 0.0);
    }
}
