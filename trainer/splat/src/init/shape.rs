//! The head's shape where no parallax shows it: an ellipsoid and a neck, the face drawn out of it by the landmarks.
//!
//! In the face's axes, with lengths in radii of the face, the front of the ellipsoid is z_e(x, y). The landmarks' depths
//! differ from it by d_i; a Gaussian kernel interpolates: z = z_e + Σ c_i φ(|p − p_i|), (Φ + λ I) c = d. Away from the
//! landmarks the ellipsoid is left as it is.

use glam::{DVec2, DVec3};
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use risorius_formats::Isometry;

use super::Seed;
use super::choose;
use super::face::Axes;
use super::view::bilinear;
use crate::scene::{Scene, camera_from_head};

/// Middle and half axes of the ellipsoid, radii of the face.
const MIDDLE: DVec3 = DVec3::new(0.0, -0.3, 0.75);
const HALF: DVec3 = DVec3::new(0.85, 1.2, 1.05);
/// Radius, place and ends of the neck, radii of the face.
const NECK: [f64; 4] = [0.55, 0.75, 0.5, 1.7];
/// Width of the kernel, radii of the face.
const KERNEL: f64 = 0.4;
/// λ.
const RIDGE: f64 = 0.01;
/// Frames that colour the shape.
const FRAMES: usize = 24;
/// Share of the frames that are calm enough to colour it.
const CALM: f64 = 0.3;

/// Seeds of the head's shape that at least one frame sees, `spacing` metres apart; `rest` are the landmarks.
pub(crate) fn seeds(
    scene: &Scene<'_>,
    head_poses: &[Isometry],
    axes: &Axes,
    rest: Option<&[[f64; 3]; 68]>,
    spacing: f64,
) -> Vec<Seed> {
    let r = axes.radius;
    let relief = rest.and_then(|rest| Relief::new(&rest.map(|p| axes.in_radii(DVec3::from(p)))));
    let spacing_in_radii = (spacing / r).clamp(0.005, 1.0);
    let surface: Vec<(DVec3, DVec3)> = ellipsoid(spacing_in_radii, relief.as_ref())
        .into_iter()
        .chain(neck(spacing_in_radii))
        .map(|(at, normal)| (axes.rotation.transpose() * at * r, axes.rotation.transpose() * normal))
        .collect();
    let views = views(scene, head_poses);
    let seed = |&(at, normal): &(DVec3, DVec3)| {
        let narrow = |v: DVec3| v.to_array().map(|v| v as f32);
        Some(Seed {
            mean: narrow(at),
            normal: narrow(normal),
            color: color(scene, &views, at, normal)?,
            sigma: (0.55 * spacing) as f32,
            thickness: (0.2 * spacing) as f32,
            opacity: 0.7,
            regions: [0.0; crate::model::REGIONS],
            head_weight: axes.head_weight(at),
            deformable: false,
        })
    };
    surface.par_iter().filter_map(seed).collect()
}

/// Calm frames in spread views.
pub(crate) fn views(scene: &Scene<'_>, head_poses: &[Isometry]) -> Vec<(usize, Isometry)> {
    let poses: Vec<Isometry> =
        scene.frames.iter().zip(head_poses).map(|(f, h)| camera_from_head(&f.camera, h)).collect();
    let sums: Vec<Option<f32>> =
        scene.frames.iter().map(|f| f.activations.as_ref().map(|a| a.iter().map(|v| v.max(0.0)).sum())).collect();
    let mut pool = choose::smallest(&sums, CALM, FRAMES);
    pool.retain(|&i| poses[i].camera_center().is_finite());
    let distance = pool.first().map_or(1.0, |&i| poses[i].camera_center().length());
    let mut chosen = choose::spread(&pool, &poses, distance, FRAMES);
    // A camera that never moves is one view, but its frames may still differ.
    if chosen.len() < FRAMES {
        let step = pool.len().div_ceil(FRAMES).max(1);
        chosen.extend(pool.iter().step_by(step));
        chosen.sort_unstable();
        chosen.dedup();
    }
    chosen.into_iter().map(|i| (i, poses[i])).collect()
}

/// The median colour, 0–1, of a point in the views that see it from the front; `None` where none does.
pub(crate) fn color(scene: &Scene<'_>, views: &[(usize, Isometry)], at: DVec3, normal: DVec3) -> Option<[f32; 3]> {
    let mut seen: Vec<(f64, [f64; 3])> = Vec::new();
    for (frame, pose) in views {
        let to_camera = (pose.camera_center() - at).normalize_or_zero();
        let facing = normal.dot(to_camera);
        let p = pose.transform_point(at);
        if facing < 0.1 || p.z <= 1e-3 {
            continue;
        }
        let frame = &scene.frames[*frame];
        let lens = &frame.camera.intrinsics;
        if let Some(rgb) = bilinear(frame, lens, lens.project(p)) {
            seen.push((facing, rgb));
        }
    }
    // The better half of what sees it.
    seen.sort_by(|a, b| b.0.total_cmp(&a.0));
    seen.truncate(seen.len().div_ceil(2));
    let median = |channel: usize| {
        let mut values: Vec<f64> = seen.iter().map(|s| s.1[channel]).collect();
        values.sort_by(f64::total_cmp);
        values.get(values.len() / 2).map(|v| (v / 255.0) as f32)
    };
    Some([median(0)?, median(1)?, median(2)?])
}

/// What landmarks draw out of the ellipsoid.
struct Relief {
    centers: Vec<DVec2>,
    weights: DVector<f64>,
}

fn kernel(a: DVec2, b: DVec2) -> f64 {
    (-(a - b).length_squared() / (2.0 * KERNEL * KERNEL)).exp()
}

/// Depth of the ellipsoid's front, radii of the face; beyond its outline that of the outline.
fn front(p: DVec2) -> f64 {
    let q = (p - MIDDLE.truncate()) / HALF.truncate();
    MIDDLE.z - HALF.z * (1.0 - q.length_squared()).max(0.0).sqrt()
}

impl Relief {
    fn new(landmarks: &[DVec3; 68]) -> Option<Self> {
        let centers: Vec<DVec2> = landmarks.iter().map(|p| p.truncate()).collect();
        let n = centers.len();
        let matrix = DMatrix::from_fn(n, n, |i, j| kernel(centers[i], centers[j]) + if i == j { RIDGE } else { 0.0 });
        let depths = DVector::from_iterator(n, landmarks.iter().map(|p| p.z - front(p.truncate())));
        let weights = matrix.cholesky()?.solve(&depths);
        weights.iter().all(|w| w.is_finite()).then_some(Self { centers, weights })
    }

    fn at(&self, p: DVec2) -> f64 {
        self.centers.iter().zip(self.weights.iter()).map(|(&c, w)| w * kernel(p, c)).sum()
    }
}

/// Points and outward normals, evenly spread over the ellipsoid.
fn ellipsoid(spacing: f64, relief: Option<&Relief>) -> Vec<(DVec3, DVec3)> {
    let mean = (HALF.x + HALF.y + HALF.z) / 3.0;
    let count = (4.0 * std::f64::consts::PI * (mean / spacing).powi(2)).clamp(16.0, 200_000.0) as usize;
    let golden = std::f64::consts::PI * (3.0 - 5.0f64.sqrt());
    let place = |unit: DVec3| {
        let mut at = MIDDLE + HALF * unit;
        // Only the front follows the landmarks, and less and less towards the outline.
        if let Some(relief) = relief {
            at.z += (-2.5 * unit.z).clamp(0.0, 1.0) * relief.at(at.truncate());
        }
        at
    };
    let of = |i: usize| {
        let z = 1.0 - (2 * i + 1) as f64 / count as f64;
        let ring = (1.0 - z * z).sqrt();
        let angle = golden * i as f64;
        let unit = DVec3::new(ring * angle.cos(), ring * angle.sin(), z);
        let (a, b) = unit.any_orthonormal_pair();
        let step = 0.02;
        let edge = |t: DVec3| place((unit + step * t).normalize()) - place((unit - step * t).normalize());
        let normal = edge(a).cross(edge(b)).normalize_or(unit);
        (place(unit), if normal.dot(unit) < 0.0 { -normal } else { normal })
    };
    (0..count).into_par_iter().map(of).collect()
}

/// Points and outward normals of a cylinder below the head.
fn neck(spacing: f64) -> Vec<(DVec3, DVec3)> {
    let [radius, z, top, bottom] = NECK;
    let around = (2.0 * std::f64::consts::PI * radius / spacing).max(3.0) as usize;
    let rows = ((bottom - top) / spacing).max(1.0) as usize;
    let of = |i: usize| {
        let angle = 2.0 * std::f64::consts::PI * ((i % around) as f64 + 0.5 * (i / around % 2) as f64) / around as f64;
        let normal = DVec3::new(angle.cos(), 0.0, angle.sin());
        let y = top + (bottom - top) * (i / around) as f64 / rows as f64;
        (DVec3::new(radius * normal.x, y, z + radius * normal.z), normal)
    };
    let inside = |p: &(DVec3, DVec3)| ((p.0 - MIDDLE) / HALF).length() < 1.0;
    (0..around * rows).map(of).filter(|p| !inside(p)).collect()
}
