//! Holes of the first Gaussians: where training views would see through, and what lies beyond all views.

use std::collections::{BTreeSet, VecDeque};

use glam::DVec2;
use risorius_formats::{Camera, Isometry};

use super::begin::model;
use crate::init::Seed;
use crate::model::Layout;
use crate::render::transmittance;
use crate::scene::{Frame, Scene, camera_from_head};

/// A pixel that lets more than this through is a hole.
const HOLE: f32 = 0.5;
/// Training views that are looked through for holes, and in how many rounds.
const VIEWS: usize = 60;
const ROUNDS: usize = 3;
/// How many times smaller than the frames they are drawn.
const REDUCE: u32 = 4;
/// Views with twice the field of view that are looked through for what is beyond all frames, and their reduction.
const WIDE_VIEWS: usize = 10;
const WIDE_REDUCE: u32 = 8;
/// Standard deviations of a Gaussian that fills a hole, in pixels of the reduced view: in the surface and across.
const SIGMA_PX: [f64; 2] = [0.55, 0.2];
const OPACITY: f32 = 0.7;

/// Adds seeds until training views and their surroundings are closed. Captures with a plate need none.
pub(super) fn fill(scene: &Scene<'_>, layout: &Layout, seeds: &mut Vec<Seed>, head_poses: &[Isometry]) {
    if scene.plate.is_some() || seeds.is_empty() || scene.frames.is_empty() {
        return;
    }
    let pose = |i: usize| head_poses.get(i).copied().unwrap_or(Isometry::IDENTITY);
    let spread = |count: usize, of: usize| (0..count.min(of)).map(move |i| i * of / count.min(of).max(1));
    let views: Vec<usize> = spread(VIEWS, scene.frames.len()).collect();
    for round in 0..ROUNDS {
        let drawn = model(layout.clone(), seeds, None, None);
        let mut taken = BTreeSet::new();
        let mut more = Vec::new();
        for &i in views.iter().skip(round).step_by(ROUNDS) {
            let frame = &scene.frames[i];
            let camera = super::reduced(&frame.camera, REDUCE);
            let holes = transmittance(&drawn, &camera, &pose(i));
            let color = |x: usize, y: usize| Some(mean_color(frame, x, y, REDUCE as usize));
            close(seeds, &camera, &pose(i), &holes, color, &mut taken, &mut more);
        }
        seeds.append(&mut more);
    }
    let drawn = model(layout.clone(), seeds, None, None);
    let (mut taken, mut more) = (BTreeSet::new(), Vec::new());
    for i in spread(WIDE_VIEWS, scene.frames.len()) {
        let mut camera = super::reduced(&scene.frames[i].camera, WIDE_REDUCE);
        let lens = &mut camera.intrinsics;
        (lens.fx, lens.fy) = (lens.fx / 2.0, lens.fy / 2.0);
        (lens.cx, lens.cy) = (
            f64::from(lens.width) / 2.0 + (lens.cx - f64::from(lens.width) / 2.0) / 2.0,
            f64::from(lens.height) / 2.0 + (lens.cy - f64::from(lens.height) / 2.0) / 2.0,
        );
        lens.distortion = risorius_formats::camera::Distortion::default();
        let holes = transmittance(&drawn, &camera, &pose(i));
        close(seeds, &camera, &pose(i), &holes, |_, _| None, &mut taken, &mut more);
    }
    seeds.append(&mut more);
}

fn mean_color(frame: &Frame<'_>, x: usize, y: usize, reduce: usize) -> [f32; 3] {
    let width = frame.camera.intrinsics.width as usize;
    let mut sum = [0u32; 3];
    for dy in 0..reduce {
        for dx in 0..reduce {
            let at = ((y * reduce + dy) * width + x * reduce + dx) * 3;
            (0..3).for_each(|c| sum[c] += u32::from(frame.rgb[at + c]));
        }
    }
    sum.map(|s| s as f32 / (255.0 * (reduce * reduce) as f32))
}

/// The seed that each pixel's nearest neighbour shows, and how far away that is, pixels.
struct Nearest {
    seed: Vec<u32>,
    distance: Vec<u32>,
}

impl Nearest {
    /// Spreads the pixels that show a seed over the others.
    fn of(shown: &[Option<(f32, u32)>], width: usize) -> Self {
        let mut out = Self { seed: vec![u32::MAX; shown.len()], distance: vec![u32::MAX; shown.len()] };
        let mut open: VecDeque<usize> = VecDeque::new();
        for (i, s) in shown.iter().enumerate() {
            if let Some((_, seed)) = s {
                out.seed[i] = *seed;
                out.distance[i] = 0;
                open.push_back(i);
            }
        }
        let height = shown.len() / width.max(1);
        while let Some(i) = open.pop_front() {
            let (x, y) = (i % width, i / width);
            for (nx, ny) in [(x.wrapping_sub(1), y), (x + 1, y), (x, y.wrapping_sub(1)), (x, y + 1)] {
                if nx < width && ny < height && out.distance[ny * width + nx] == u32::MAX {
                    out.distance[ny * width + nx] = out.distance[i] + 1;
                    out.seed[ny * width + nx] = out.seed[i];
                    open.push_back(ny * width + nx);
                }
            }
        }
        out
    }
}

/// Puts a seed into every hole of a view, as deep as the nearest far point (or a near one that is much nearer by).
fn close(
    seeds: &[Seed],
    camera: &Camera,
    room_from_head: &Isometry,
    holes: &[f32],
    color: impl Fn(usize, usize) -> Option<[f32; 3]>,
    taken: &mut BTreeSet<[i32; 3]>,
    out: &mut Vec<Seed>,
) {
    let width = camera.intrinsics.width as usize;
    if width == 0 || holes.iter().all(|t| *t <= HOLE) {
        return;
    }
    let head = camera_from_head(camera, room_from_head);
    let mut shown = [vec![None; holes.len()], vec![None; holes.len()]];
    for (i, seed) in seeds.iter().enumerate() {
        let p = glam::DVec3::from_array(seed.mean.map(f64::from));
        let near = seed.head_weight > 0.5;
        let t = if near { head.transform_point(p) } else { camera.camera_from_world.transform_point(p) };
        if t.z <= 0.02 {
            continue;
        }
        let pixel = camera.intrinsics.project(t);
        if !(pixel.x >= 0.0 && pixel.y >= 0.0) {
            continue;
        }
        let (x, y) = (pixel.x as usize, pixel.y as usize);
        let at = y.saturating_mul(width).saturating_add(x);
        if x < width && at < holes.len() {
            let cell: &mut Option<(f32, u32)> = &mut shown[usize::from(near)][at];
            if cell.is_none_or(|(z, _)| (t.z as f32) < z) {
                *cell = Some((t.z as f32, i as u32));
            }
        }
    }
    let [far, near] = shown.map(|s| Nearest::of(&s, width));
    let room_from_camera = camera.camera_from_world.inverse();
    for (at, _) in holes.iter().enumerate().filter(|(_, t)| **t > HOLE) {
        let (x, y) = (at % width, at / width);
        let use_near = far.seed[at] == u32::MAX
            || (near.seed[at] != u32::MAX && near.distance[at].saturating_mul(2) < far.distance[at]);
        let source = if use_near { near.seed[at] } else { far.seed[at] };
        let Some(source) = seeds.get(source as usize) else { continue };
        let p = glam::DVec3::from_array(source.mean.map(f64::from));
        let z = camera.camera_from_world.transform_point(p).z;
        let Some(ray) = camera.intrinsics.unproject(DVec2::new(x as f64 + 0.5, y as f64 + 0.5)) else { continue };
        let mean = room_from_camera.transform_point(ray.extend(1.0) * z);
        let pixel_m = z / camera.intrinsics.fx;
        let cell = (mean / (1.5 * pixel_m)).floor().as_ivec3().to_array();
        if !mean.is_finite() || !taken.insert(cell) {
            continue;
        }
        let normal = (camera.center() - mean).normalize_or(glam::DVec3::NEG_Z);
        out.push(Seed {
            mean: mean.as_vec3().to_array(),
            normal: normal.as_vec3().to_array(),
            color: color(x, y).unwrap_or(source.color),
            sigma: (SIGMA_PX[0] * pixel_m) as f32,
            thickness: (SIGMA_PX[1] * pixel_m) as f32,
            opacity: OPACITY,
            regions: [0.0; crate::model::REGIONS],
            head_weight: source.head_weight,
            deformable: false,
        });
    }
}
