//! Where the head box and the background lie.

use glam::{DVec2, DVec3};
use risorius_brick::{BackgroundFrame, HeadBox, Layout};
use risorius_formats::pose_report::PoseMethod;

use crate::data::TrainData;

/// Half the head box's edge in radii of the face (farthest landmark from its middle): hair, ears and neck.
const BOX_RADII: f64 = 2.4;
/// The head's middle behind the face's, and below it, in radii.
const BEHIND_RADII: f64 = 0.9;
const BELOW_RADII: f64 = 0.3;

/// How far beyond what 96 % of the pictures' corners see the background may reach, in widths of that.
const MOST_ASIDE: f32 = 0.35;

/// The mean camera: position, and its axes as rows.
struct MeanCamera {
    position: DVec3,
    axes: [DVec3; 3],
}

fn mean_camera(data: &TrainData) -> MeanCamera {
    let n = data.frames.len().max(1) as f64;
    let position = data.frames.iter().map(|f| f.camera.center()).sum::<DVec3>() / n;
    let axis = |row: usize| {
        data.frames.iter().map(|f| f.camera.camera_from_world.rotation.transpose().col(row)).sum::<DVec3>()
    };
    let forward = axis(2).normalize_or(DVec3::Z);
    let down = axis(1);
    let down = (down - forward * down.dot(forward)).normalize_or(DVec3::Y);
    MeanCamera { position, axes: [down.cross(forward), down, forward] }
}

/// The layout of a dataset.
pub fn of(data: &TrainData, expression_vertices: usize, finest: usize) -> Layout {
    let camera = mean_camera(data);
    let head_box = head_box(data, &camera);
    let still = data.extras().is_some_and(|e| e.method == PoseMethod::Head);
    Layout {
        head_box,
        background: (!still).then(|| background(data, &camera, &head_box)),
        region_of: data.table.attributes.iter().map(|a| a.region).collect(),
        regions: data.table.regions.len(),
        images: data.frames.len(),
        expression_vertices,
        finest,
    }
}

fn head_box(data: &TrainData, camera: &MeanCamera) -> HeadBox {
    let as_box = |center: DVec3, half: f64| HeadBox { center: center.as_vec3().to_array(), half: half as f32 };
    if let Some(hull) = data.extras().and_then(|e| e.head_hull_in_world.as_ref()) {
        let low = hull.iter().copied().fold(DVec3::INFINITY, DVec3::min);
        let high = hull.iter().copied().fold(DVec3::NEG_INFINITY, DVec3::max);
        return as_box((low + high) * 0.5, (high - low).max_element() * 0.5 * 1.05);
    }
    match data.extras() {
        Some(e) if e.head_radius > 0.0 => {
            let [_, down, forward] = camera.axes;
            let center = e.head_center + (forward * BEHIND_RADII + down * BELOW_RADII) * e.head_radius;
            as_box(center, e.head_radius * BOX_RADII)
        }
        // A folder of another tool: the middle third of what lies between near and far.
        _ => {
            let scene = &data.dataset.scene;
            let distance = (camera.position - scene.center_in_world).length();
            as_box(scene.center_in_world, (distance - scene.near / scene.scale).abs().max(distance * 0.25))
        }
    }
}

fn background(data: &TrainData, camera: &MeanCamera, head: &HeadBox) -> BackgroundFrame {
    let [_, _, forward] = camera.axes;
    let center = glam::Vec3::from_array(head.center).as_dvec3();
    let near = ((center - camera.position).dot(forward) + f64::from(head.half)).max(1e-6);
    let far = (data.dataset.scene.far / data.dataset.scene.scale).max(near * 1.5);
    let mut frame = BackgroundFrame {
        position: camera.position.as_vec3().to_array(),
        axes: camera.axes.map(|a| a.as_vec3().to_array()),
        near: near as f32,
        far: far as f32,
        middle: [0.0; 2],
        extent: [1.0; 2],
    };
    // Where the pictures' corners meet the nearest and the farthest plane.
    let mut seen: [Vec<f32>; 2] = Default::default();
    for training in &data.frames {
        let i = &training.camera.intrinsics;
        let (w, h) = (f64::from(i.width), f64::from(i.height));
        let origin = frame.camera_from_world(training.camera.center().as_vec3().to_array());
        for corner in [DVec2::ZERO, DVec2::new(w, 0.0), DVec2::new(0.0, h), DVec2::new(w, h)] {
            let Some(direction) = training.camera.ray_direction(corner) else { continue };
            let d = frame.turn(direction.as_vec3().to_array());
            if let Some(march) = frame.march(origin, d, 1, 0.0) {
                (0..2).for_each(|a| seen[a].extend([march.origin[a], march.origin[a] + 2.0 * march.direction[a]]));
            }
        }
    }
    for (a, values) in seen.iter_mut().enumerate() {
        values.sort_by(f32::total_cmp);
        let at = |q: f64| {
            values.get((values.len() as f64 * q) as usize).copied().unwrap_or(if q < 0.5 { -1.0 } else { 1.0 })
        };
        // The views from farthest aside are few and the only ones to see what they see; a camera that went astray must
        // not take all the vertices.
        let (low, high) = (at(0.02), at(0.98));
        let most = MOST_ASIDE * (high - low);
        let first = values.first().copied().unwrap_or(low).max(low - most);
        let last = values.last().copied().unwrap_or(high).min(high + most);
        let (low, high) = (first, last);
        frame.middle[a] = (low + high) * 0.5;
        frame.extent[a] = ((high - low) * 0.5).max(1e-3);
    }
    frame
}
