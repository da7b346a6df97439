//! Where the face is: its axes, how much a place belongs to the head, and which region of the masks it lies in.

use glam::{DMat3, DVec3};
use rayon::prelude::*;
use risorius_formats::Isometry;

use super::Seed;
use crate::model::REGIONS;
use crate::scene::{Scene, camera_from_head};

/// Frames with masks that are looked at.
const MASK_FRAMES: usize = 60;
/// A point is in the face where more than this share of the masks that see it say so.
const IN_FACE: f32 = 0.55;
/// What is added to the face's box, radii of the face.
const MARGIN: f64 = 0.2;

/// The face's own axes: x to the image's right of a frontal picture, y down, z into the head; the origin is the scene's.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Axes {
    /// `face_from_head`.
    pub(crate) rotation: DMat3,
    /// Distance of the farthest landmark from the origin, metres.
    pub(crate) radius: f64,
}

impl Axes {
    /// From landmarks in the head frame, else from the cameras: the face looks at their mean, upright in their pictures.
    pub(crate) fn new(scene: &Scene<'_>, rest: Option<&[[f64; 3]; 68]>) -> Self {
        let radius = f64::from(scene.face_radius_m);
        let radius = if radius > 0.0 && radius.is_finite() { radius } else { 0.1 };
        let rotation = rest.and_then(from_landmarks).unwrap_or_else(|| from_cameras(scene));
        Self { rotation, radius }
    }

    /// A place in the head frame by the face's axes, in radii of the face.
    pub(crate) fn in_radii(&self, at: DVec3) -> DVec3 {
        self.rotation * at / self.radius
    }

    /// How much of the head's motion a place follows, 0–1: 1 in the head, falling to 0 along the neck, over the
    /// shoulders and a hand's breadth away from the head.
    pub(crate) fn head_weight(&self, at: DVec3) -> f32 {
        let p = self.in_radii(at);
        // The skull: an ellipsoid behind and above the middle of the face.
        let q = (p - DVec3::new(0.0, -0.25, 0.75)) / DVec3::new(1.25, 1.55, 1.45);
        let skull = 1.0 - smooth((q.length() - 1.0) / 0.25);
        // The neck leaves the head below the chin.
        let neck = 1.0 - smooth((p.y - 0.85 + 0.25 * p.z.max(0.0)) / 0.75);
        (skull * neck) as f32
    }
}

fn smooth(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * (3.0 - 2.0 * x)
}

/// Right from the eyes' corners, down from the eyes to the mouth.
fn from_landmarks(rest: &[[f64; 3]; 68]) -> Option<DMat3> {
    let mean = |points: &[usize]| points.iter().map(|&i| DVec3::from(rest[i])).sum::<DVec3>() / points.len() as f64;
    let (left, right) = (mean(&[36, 39]), mean(&[42, 45]));
    let right_axis = (right - left).try_normalize()?;
    let down = mean(&[48, 54]) - 0.5 * (left + right);
    let down = (down - right_axis * down.dot(right_axis)).try_normalize()?;
    let into = right_axis.cross(down);
    Some(DMat3::from_cols(right_axis, down, into).transpose())
}

fn from_cameras(scene: &Scene<'_>) -> DMat3 {
    let poses = scene.frames.iter().map(|f| camera_from_head(&f.camera, &f.room_from_head));
    let (mut center, mut down) = (DVec3::ZERO, DVec3::ZERO);
    for pose in poses.filter(|p| p.camera_center().is_finite() && p.rotation.is_finite()) {
        center += pose.camera_center().normalize_or_zero();
        down += pose.rotation.row(1);
    }
    let into = -center.normalize_or(DVec3::NEG_Z);
    let down = (down - into * down.dot(into)).try_normalize().unwrap_or_else(|| into.any_orthonormal_vector());
    DMat3::from_cols(down.cross(into), down, into).transpose()
}

/// Fills in the region shares of the seeds and whether they may carry deltas.
pub(crate) fn label(scene: &Scene<'_>, head_poses: &[Isometry], axes: &Axes, seeds: &mut [Seed]) {
    shares(scene, head_poses, seeds);
    let Some([low, high]) = face_box(axes, seeds) else { return };
    for seed in seeds {
        let p = axes.rotation * DVec3::from(seed.mean.map(f64::from));
        seed.deformable = p.cmpge(low).all() && p.cmple(high).all();
    }
}

/// Fills in the region shares of the seeds.
pub(crate) fn shares(scene: &Scene<'_>, head_poses: &[Isometry], seeds: &mut [Seed]) {
    let with_masks: Vec<usize> = (0..scene.frames.len()).filter(|&i| scene.frames[i].labels.is_some()).collect();
    let step = with_masks.len().div_ceil(MASK_FRAMES).max(1);
    let views: Vec<(usize, Isometry)> = with_masks
        .iter()
        .step_by(step)
        .map(|&i| (i, camera_from_head(&scene.frames[i].camera, &head_poses[i])))
        .collect();
    seeds.par_iter_mut().for_each(|s| s.regions = shares_of(scene, &views, s));
}

/// The share of masks, of those that see the seed from the front, that have it in each region.
fn shares_of(scene: &Scene<'_>, views: &[(usize, Isometry)], seed: &Seed) -> [f32; REGIONS] {
    let (at, normal) = (DVec3::from(seed.mean.map(f64::from)), DVec3::from(seed.normal.map(f64::from)));
    let mut counts = [0u32; REGIONS];
    let mut seen = 0u32;
    for (frame, pose) in views {
        let lens = &scene.frames[*frame].camera.intrinsics;
        let p = pose.transform_point(at);
        if p.z <= 1e-6 || normal.dot(pose.camera_center() - at) <= 0.0 {
            continue;
        }
        let pixel = lens.project(p);
        let inside =
            pixel.cmpge(glam::DVec2::ZERO).all() && pixel.x < f64::from(lens.width) && pixel.y < f64::from(lens.height);
        if !inside {
            continue;
        }
        let index = pixel.y as usize * lens.width as usize + pixel.x as usize;
        let Some(&label) = scene.frames[*frame].labels.and_then(|l| l.get(index)) else { continue };
        seen += 1;
        if let Some(count) = counts.get_mut(usize::from(label).wrapping_sub(1)) {
            *count += 1;
        }
    }
    counts.map(|c| if seen == 0 { 0.0 } else { c as f32 / seen as f32 })
}

/// The face's box by its axes, metres: what 98 % of its points lie in along each axis, and a margin.
fn face_box(axes: &Axes, seeds: &[Seed]) -> Option<[DVec3; 2]> {
    let of_face = |s: &&Seed| s.regions.iter().sum::<f32>() > IN_FACE && s.head_weight > 0.0;
    let points: Vec<DVec3> =
        seeds.iter().filter(of_face).map(|s| axes.rotation * DVec3::from(s.mean.map(f64::from))).collect();
    if points.is_empty() {
        return None;
    }
    let margin = MARGIN * axes.radius;
    let extent = |axis: usize| {
        let mut values: Vec<f64> = points.iter().map(|p| p[axis]).collect();
        values.sort_by(f64::total_cmp);
        let outer = values.len() / 100;
        [values[outer] - margin, values[values.len() - 1 - outer] + margin]
    };
    let [x, y, z] = [extent(0), extent(1), extent(2)];
    Some([DVec3::new(x[0], y[0], z[0]), DVec3::new(x[1], y[1], z[1])])
}
