//! `scene.json`: where the scene lies and how it is scaled.
//!
//! The centre is the head. The scale makes everything that is ever sampled fit into the unit ball: the cameras, and
//! the corners of every picture at the far distance. Positional encodings want |x| < 1 (fact sheet §8.26).

use glam::DVec2;
use risorius_formats::Similarity;
use risorius_formats::{Camera, SceneBounds};

use crate::align::TakeInput;

/// Centre, scale, near and far for `cameras`, which stand in the first take's world.
pub fn bounds<'a>(
    inputs: &[TakeInput],
    worlds: &[Similarity],
    cameras: impl Iterator<Item = &'a Camera>,
) -> SceneBounds {
    let near = inputs.iter().zip(worlds).map(|(i, w)| i.report.near * w.scale).fold(f64::INFINITY, f64::min);
    let far = inputs.iter().zip(worlds).map(|(i, w)| i.report.far * w.scale).fold(0.0, f64::max);
    let center_in_world = inputs[0].report.head_center;
    let mut reach: f64 = 0.0;
    for camera in cameras {
        let origin = camera.center();
        reach = reach.max(origin.distance(center_in_world));
        let (w, h) = (f64::from(camera.intrinsics.width), f64::from(camera.intrinsics.height));
        for corner in [DVec2::ZERO, DVec2::new(w, 0.0), DVec2::new(0.0, h), DVec2::new(w, h)] {
            if let Some(direction) = camera.ray_direction(corner) {
                reach = reach.max((origin + direction * far).distance(center_in_world));
            }
        }
    }
    let scale = if reach > 0.0 && reach.is_finite() { 1.0 / reach } else { 1.0 / far };
    SceneBounds { center_in_world, scale, near: near * scale, far: far * scale }
}
