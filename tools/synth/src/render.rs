//! From meshes to pixels: a z-buffer over bands of rows, 2×2 samples per pixel, shaded once per sample.
//!
//! Bands are independent and triangles keep their order, so the picture does not depend on the number of threads.

use glam::{DVec2, Vec2, Vec3};
use image::RgbImage;
use rayon::prelude::*;
use risorius_formats::mask::LabelImage;
use risorius_formats::{Camera, Isometry};

use crate::expression::FaceState;
use crate::face;
use crate::mesh::{Material, Mesh};
use crate::scene::Scene;
use crate::shade::{self, Light};

/// Samples per pixel along one side.
const SAMPLES: usize = 2;
/// Pixel rows per band.
const BAND: usize = 8;
/// Behind a hole in the skin, nothing further away than this belongs to the inside of the head, metres.
const CAVITY_DEPTH: f32 = 0.045;

/// A picture with its truth.
#[derive(Clone, Debug)]
pub struct RenderedView {
    /// 8-bit sRGB.
    pub rgb: RgbImage,
    /// Distance along the camera's axis of what each pixel shows, metres, row by row.
    pub depth: Vec<f32>,
    /// 0 the rest, 1 brows and forehead, 2 eyes, 3 mouth and lower face.
    pub labels: LabelImage,
    /// Whether a pixel mostly shows head, hair or ears, row by row.
    pub head: Vec<bool>,
}

/// A mesh as the camera sees it.
struct Seen<'a> {
    mesh: &'a Mesh,
    triangles: &'a [[u32; 3]],
    may_open: &'a [bool],
    /// x, y in samples; z along the camera's axis in metres.
    screen: Vec<Vec3>,
    /// World normals.
    normal: Vec<Vec3>,
}

#[derive(Clone, Copy)]
struct Sample {
    depth: f32,
    /// Nearest hole in the skin.
    hole: f32,
    hole_label: u8,
    mesh: u8,
    triangle: u32,
    weights: [f32; 2],
}

const NOTHING: u8 = u8::MAX;
const EMPTY: Sample =
    Sample { depth: f32::MAX, hole: f32::MAX, hole_label: 0, mesh: NOTHING, triangle: 0, weights: [0.0; 2] };

struct Band {
    rgb: Vec<u8>,
    depth: Vec<f32>,
    labels: Vec<u8>,
    head: Vec<bool>,
}

pub(crate) fn render(scene: &Scene, camera: &Camera, state: &FaceState, world_from_head: &Isometry) -> RenderedView {
    let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
    let seen: Vec<Seen> = scene.meshes.iter().map(|part| see(part, scene, camera, state, world_from_head)).collect();
    let bands = height.div_ceil(BAND);
    let bins = bin(&seen, bands, width * SAMPLES);
    let eye = camera.center().as_vec3();
    let light = Light::new(world_from_head);
    let rows: Vec<Band> = bins
        .par_iter()
        .enumerate()
        .map(|(band, bin)| {
            let first_row = band * BAND;
            let row_count = BAND.min(height - first_row);
            let samples = rasterise(&seen, bin, state, first_row * SAMPLES, row_count * SAMPLES, width * SAMPLES);
            resolve(scene, &seen, camera, state, &light, eye, &samples, first_row, row_count, width)
        })
        .collect();
    let mut view = RenderedView {
        rgb: RgbImage::new(camera.intrinsics.width, camera.intrinsics.height),
        depth: Vec::with_capacity(width * height),
        labels: LabelImage { width: width as u32, height: height as u32, labels: Vec::with_capacity(width * height) },
        head: Vec::with_capacity(width * height),
    };
    for (target, band) in view.rgb.chunks_mut(width * BAND * 3).zip(&rows) {
        target.copy_from_slice(&band.rgb);
    }
    for band in rows {
        view.depth.extend(band.depth);
        view.labels.labels.extend(band.labels);
        view.head.extend(band.head);
    }
    view
}

fn see<'a>(
    part: &'a crate::scene::Part,
    scene: &Scene,
    camera: &Camera,
    state: &FaceState,
    world_from_head: &Isometry,
) -> Seen<'a> {
    let mesh = &part.mesh;
    let (position, normal) = Scene::deform(part, state);
    // Neck and shirt stay when the head turns.
    let world_from_part = if mesh.material == Material::Body { &Isometry::IDENTITY } else { world_from_head };
    let camera_from_part = camera.camera_from_world.compose(world_from_part);
    let stretch = scene.person.proportions;
    let scale = SAMPLES as f64;
    let screen = position
        .par_iter()
        .map(|p| {
            let c = camera_from_part.transform_point((*p * stretch).as_dvec3());
            let pixel = camera.intrinsics.project(c) * scale;
            Vec3::new(pixel.x as f32, pixel.y as f32, c.z as f32)
        })
        .collect();
    let turn = world_from_part.rotation.as_mat3();
    let normal = normal.par_iter().map(|n| turn * (*n / stretch).normalize()).collect();
    Seen { mesh, triangles: &part.triangles, may_open: &part.may_open, screen, normal }
}

/// Twice the signed area of a triangle on the screen; negative when it is seen from outside.
fn area(a: Vec3, b: Vec3, c: Vec3) -> f32 {
    (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x)
}

/// Which triangles each band of rows has to look at.
fn bin(seen: &[Seen], bands: usize, width: usize) -> Vec<Vec<(u8, u32)>> {
    let mut bins = vec![Vec::new(); bands];
    let per_band = (BAND * SAMPLES) as f32;
    for (mesh, part) in seen.iter().enumerate() {
        for (index, t) in part.triangles.iter().enumerate() {
            let [a, b, c] = t.map(|i| part.screen[i as usize]);
            let behind = a.z < 0.02 || b.z < 0.02 || c.z < 0.02;
            if behind || area(a, b, c) >= 0.0 || a.x.max(b.x).max(c.x) < 0.0 || a.x.min(b.x).min(c.x) > width as f32 {
                continue;
            }
            let top = (a.y.min(b.y).min(c.y) / per_band).floor().max(0.0);
            let bottom = (a.y.max(b.y).max(c.y) / per_band).floor().min(bands as f32 - 1.0);
            if bottom >= top {
                for band in &mut bins[top as usize..=bottom as usize] {
                    band.push((mesh as u8, index as u32));
                }
            }
        }
    }
    bins
}

fn rasterise(
    seen: &[Seen],
    bin: &[(u8, u32)],
    state: &FaceState,
    top: usize,
    rows: usize,
    width: usize,
) -> Vec<Sample> {
    let mut samples = vec![EMPTY; rows * width];
    for &(mesh, index) in bin {
        let part = &seen[mesh as usize];
        let corners = part.triangles[index as usize];
        let [a, b, c] = corners.map(|i| part.screen[i as usize]);
        let over = 1.0 / area(a, b, c);
        let bounds = |x: f32, y: f32, z: f32, first: f32, count: usize| {
            let low = (x.min(y).min(z) - first - 0.5).ceil().max(0.0);
            let high = (x.max(y).max(z) - first - 0.5).floor().min(count as f32 - 1.0);
            (low as usize, if high < low { None } else { Some(high as usize) })
        };
        let (x0, Some(x1)) = bounds(a.x, b.x, c.x, 0.0, width) else { continue };
        let (y0, Some(y1)) = bounds(a.y, b.y, c.y, top as f32, rows) else { continue };
        let inverse = [1.0 / a.z, 1.0 / b.z, 1.0 / c.z];
        for y in y0..=y1 {
            for x in x0..=x1 {
                let p = Vec3::new(x as f32 + 0.5, (top + y) as f32 + 0.5, 0.0);
                let (wa, wb, wc) = (area(b, c, p) * over, area(c, a, p) * over, area(a, b, p) * over);
                // The hair's breadth closes the seam between neighbours.
                if wa < -1e-5 || wb < -1e-5 || wc < -1e-5 {
                    continue;
                }
                let (wa, wb, wc) = (wa * inverse[0], wb * inverse[1], wc * inverse[2]);
                let depth = 1.0 / (wa + wb + wc);
                let sample = &mut samples[y * width + x];
                if depth >= sample.depth {
                    continue;
                }
                let weights = [wb * depth, wc * depth];
                if part.may_open[index as usize] {
                    let rest = blend(&part.mesh.rest, corners, weights);
                    let label = face::region(rest);
                    if face::is_open(rest, label, state) {
                        if depth < sample.hole {
                            sample.hole = depth;
                            sample.hole_label = label;
                        }
                        continue;
                    }
                }
                *sample = Sample { depth, mesh, triangle: index, weights, ..*sample };
            }
        }
    }
    samples
}

fn blend(values: &[Vec3], corners: [u32; 3], weights: [f32; 2]) -> Vec3 {
    let [a, b, c] = corners.map(|i| values[i as usize]);
    a + (b - a) * weights[0] + (c - a) * weights[1]
}

/// What one sample shows.
struct Shown {
    colour: Vec3,
    depth: f32,
    label: u8,
    head: bool,
}

#[expect(clippy::too_many_arguments, reason = "everything a band needs, named at its only call")]
fn resolve(
    scene: &Scene,
    seen: &[Seen],
    camera: &Camera,
    state: &FaceState,
    light: &Light,
    eye: Vec3,
    samples: &[Sample],
    first_row: usize,
    row_count: usize,
    width: usize,
) -> Band {
    let mut band = Band {
        rgb: Vec::with_capacity(row_count * width * 3),
        depth: Vec::with_capacity(row_count * width),
        labels: Vec::with_capacity(row_count * width),
        head: Vec::with_capacity(row_count * width),
    };
    let rays = Rays::new(camera);
    for row in 0..row_count {
        for column in 0..width {
            let look = |k: usize| {
                let (sx, sy) = (column * SAMPLES + k % SAMPLES, row * SAMPLES + k / SAMPLES);
                let x = (sx as f32 + 0.5) / SAMPLES as f32;
                let y = (sy as f32 + 0.5) / SAMPLES as f32 + first_row as f32;
                let (direction, along_axis) = rays.at(x, y);
                show(scene, seen, state, light, eye, direction, along_axis, &samples[sy * width * SAMPLES + sx])
            };
            // Where two opposite samples agree and all four see the same mesh, the other two would add nothing.
            let mesh_at = |k: usize| {
                let sample = &samples[(row * SAMPLES + k / SAMPLES) * width * SAMPLES + column * SAMPLES + k % SAMPLES];
                (sample.mesh, sample.hole < f32::MAX)
            };
            let (first, last) = (look(0), look(3));
            let alike = (1..SAMPLES * SAMPLES).all(|k| mesh_at(k) == mesh_at(0)) && first.agrees_with(&last);
            let rest = if alike { Vec::new() } else { vec![look(1), look(2)] };
            let shown: Vec<Shown> = [first, last].into_iter().chain(rest).collect();
            let colour = shown.iter().map(|s| s.colour).sum::<Vec3>() / shown.len() as f32;
            band.rgb.extend(shade::encode(colour));
            let nearest = shown.iter().fold(f32::MAX, |m, s| m.min(s.depth));
            let farthest = shown.iter().fold(0.0f32, |m, s| m.max(s.depth));
            let mean = shown.iter().map(|s| s.depth).sum::<f32>() / shown.len() as f32;
            band.depth.push(if farthest - nearest < 0.01 { mean } else { nearest });
            let votes = |label: u8| shown.iter().filter(|s| s.label == label).count();
            let label = (0..=face::MOUTH_LABEL).rev().max_by_key(|&l| votes(l)).unwrap_or(0);
            band.labels.push(label);
            band.head.push(shown.iter().filter(|s| s.head).count() * 2 >= shown.len());
        }
    }
    band
}

impl Shown {
    fn agrees_with(&self, other: &Self) -> bool {
        let apart = (self.colour - other.colour).abs().max_element();
        self.label == other.label
            && (self.depth - other.depth).abs() < 0.01
            && apart < 0.02 * (0.2 + self.colour.max_element())
    }
}

#[expect(clippy::too_many_arguments, reason = "everything a sample needs, named at its only call")]
fn show(
    scene: &Scene,
    seen: &[Seen],
    state: &FaceState,
    light: &Light,
    eye: Vec3,
    direction: Vec3,
    along_axis: f32,
    sample: &Sample,
) -> Shown {
    if sample.hole < f32::MAX && sample.depth - sample.hole > CAVITY_DEPTH {
        return Shown {
            colour: shade::cavity(sample.hole_label),
            depth: sample.hole + 0.01,
            label: sample.hole_label,
            head: true,
        };
    }
    if sample.mesh == NOTHING {
        let (t, colour) = scene.room.look(eye, direction);
        return Shown { colour, depth: t * along_axis, label: 0, head: false };
    }
    let part = &seen[sample.mesh as usize];
    let corners = part.triangles[sample.triangle as usize];
    let mix = |values: &[Vec3]| blend(values, corners, sample.weights);
    let rest = mix(&part.mesh.rest);
    let normal = mix(&part.normal).normalize();
    let point = shade::Point {
        material: part.mesh.material,
        rest,
        normal,
        colour: mix(&part.mesh.colour),
        light: mix(&part.mesh.light),
        to_eye: -direction,
    };
    let (colour, label) = shade::shade(&point, scene, state, light, part.mesh.label[corners[0] as usize]);
    Shown { colour, depth: sample.depth, label, head: part.mesh.material != Material::Body }
}

/// World rays of pixels.
struct Rays<'a> {
    camera: &'a Camera,
    pinhole: Option<(glam::Mat3, Vec2, Vec2)>,
}

impl<'a> Rays<'a> {
    fn new(camera: &'a Camera) -> Self {
        let i = &camera.intrinsics;
        let plain = i.distortion.is_none() && i.skew == 0.0;
        let world_from_camera = camera.camera_from_world.rotation.transpose().as_mat3();
        let pinhole = plain.then(|| {
            (world_from_camera, DVec2::new(i.cx, i.cy).as_vec2(), DVec2::new(1.0 / i.fx, 1.0 / i.fy).as_vec2())
        });
        Self { camera, pinhole }
    }

    /// Unit direction, and how much of a step along it goes along the camera's axis.
    fn at(&self, x: f32, y: f32) -> (Vec3, f32) {
        if let Some((turn, centre, scale)) = self.pinhole {
            let d = ((Vec2::new(x, y) - centre) * scale).extend(1.0).normalize();
            return (turn * d, d.z);
        }
        let axis = self.camera.camera_from_world.rotation.row(2);
        let d = self.camera.ray_direction(DVec2::new(x.into(), y.into())).unwrap_or(axis);
        (d.as_vec3(), d.dot(axis) as f32)
    }
}
