//! The avatar as files for others. This module: glTF for other engines, a mesh or a cloud of points with one morph target
//! per AU. [`export_gaussians`]: the Gaussians of one expression; [`export_page`]: a page that draws them with every AU.
//!
//! A vertex is a ray of a view: it stands where the ray meets the neutral head. A mesh is sewn from the avatar's own view and
//! views to its sides, each with the surface that it sees best. An AU's target moves it along the ray to
//! where it meets the head with that AU at its strongest, and changes its colour to what is seen there (`POSITION` and
//! `COLOR_0` of the target). What moves across the view, such as a lid, is therefore told by colours rather than by
//! positions: right from about the views that were baked, and wrong the farther one looks from elsewhere. Weights mix
//! linearly, the avatar does not; [`ExportSummary::half_way_levels`] says how far the two are apart half way.
//!
//! Axes are glTF's (x right, y up, z towards the viewer of the avatar's own view), the origin is the head's middle, units
//! are the world's. Colours are linear, on an unlit material: light is part of them.

mod cloud;
mod dot_splat;
mod gaussians;
mod glb;
mod page;
mod ply;
mod sheets;
mod spz;

use std::path::{Path, PathBuf};

use glam::{DVec2, DVec3};
use risorius_formats::{Camera, Intensity, Intrinsics, Reporter, atomic};
use serde::Serialize;
use serde_json::json;

pub use self::gaussians::{SplatFormat, SplatSummary, export_gaussians};
pub use self::page::{PageSettings, PageSummary, export_page};
use self::sheets::Sheet;
use super::transfer::Driver;
use crate::avatar::Avatar;
use crate::error::{Result, TrainerError};
use crate::expression::Expression;
use crate::field::{Look, Outputs, Render};
use crate::path::Orbit;
use crate::studio::Studio;

/// Frames per second of animations.
const FPS: f64 = 25.0;

/// What is written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum ExportKind {
    /// A mesh of several views around the head.
    #[default]
    Mesh,
    /// Points of several views around the head.
    Points,
}

/// How to export.
#[derive(Clone, Copy, Debug)]
pub struct ExportSettings {
    /// Mesh or points.
    pub kind: ExportKind,
    /// Vertices across the picture's width.
    pub columns: u32,
    /// Views: the avatar's own, then to its sides.
    pub views: usize,
}

/// What was written.
#[derive(Clone, Debug, Serialize)]
pub struct ExportSummary {
    /// The file.
    pub file: PathBuf,
    /// Vertices.
    pub vertices: usize,
    /// Triangles; 0 for points.
    pub triangles: usize,
    /// The AUs, in the order of the morph targets.
    pub targets: Vec<String>,
    /// Bytes.
    pub bytes: usize,
    /// Mean difference of colours, levels of 255, between an AU at half its strength and its target at weight ½, over the
    /// vertices that the target changes by a level or more.
    pub half_way_levels: f64,
    /// The same for depth, thousandths of a world unit.
    pub half_way_mm: f64,
}

/// Vertices with their targets.
#[derive(Default)]
struct Baked {
    positions: Vec<[f32; 3]>,
    colors: Vec<[f32; 3]>,
    /// `[target][vertex]`: change of position and of colour.
    moves: Vec<Vec<[f32; 3]>>,
    tints: Vec<Vec<[f32; 3]>>,
    triangles: Vec<u32>,
    errors: HalfWay,
}

#[derive(Default)]
struct HalfWay {
    levels: f64,
    mm: f64,
    count: usize,
}

/// Bakes the avatar and writes `file` (`.glb`); `driver` adds an animation besides the one that shows each AU in turn.
pub fn export(
    avatar: &Avatar,
    settings: &ExportSettings,
    driver: Option<&Driver>,
    file: &Path,
    reporter: &dyn Reporter,
) -> Result<ExportSummary> {
    let saved = &avatar.saved;
    let active: Vec<usize> = (0..saved.table.attributes.len()).filter(|&k| saved.table.attributes[k].active).collect();
    let reference = Camera::from(&saved.default_camera);
    let count = settings.views.max(1);
    let mut baked =
        Baked { moves: vec![Vec::new(); active.len()], tints: vec![Vec::new(); active.len()], ..Baked::default() };
    reporter.stage("bake", Some((count * (1 + 2 * active.len())) as u64));
    let mut views = (0..count)
        .map(|view| {
            let angle = std::f64::consts::TAU * view.saturating_sub(1) as f64 / (count - 1).max(1) as f64;
            let spread = if view == 0 { 0.0 } else { 1.0 };
            let orbit = Orbit {
                yaw_deg: (saved.orbit_rad[0] * spread * angle.cos()).to_degrees(),
                pitch_deg: (saved.orbit_rad[1] * spread * angle.sin()).to_degrees(),
                ..Orbit::default()
            };
            View::new(avatar, coarse(&orbit.camera(&reference, saved.center_in_world), settings.columns), reporter)
        })
        .collect::<Result<Vec<View<'_>>>>()?;
    let kept: Vec<Option<Vec<[usize; 3]>>> = match settings.kind {
        ExportKind::Points => vec![None; count],
        ExportKind::Mesh => {
            let sheets: Vec<Sheet<'_>> = views.iter().map(|v| Sheet::new(&v.camera, &v.rest.depth)).collect();
            (0..count).map(|own| Some(sheets::triangles(&sheets, own))).collect()
        }
    };
    for (view, triangles) in views.iter_mut().zip(&kept) {
        bake_view(avatar, &active, view, triangles.as_deref(), &reference, &mut baked, reporter)?;
    }
    if baked.positions.len() < 3 {
        return Err(TrainerError::Setting {
            message: "the avatar's view meets no head".to_owned(),
            hint: "look at it with `trainer view`".to_owned(),
        });
    }
    let names: Vec<String> = active.iter().map(|&k| saved.table.attributes[k].unit.to_string()).collect();
    let bytes = file_of(avatar, &active, &names, &baked, driver);
    atomic::write_file(file, &bytes)?;
    let count = baked.errors.count.max(1) as f64;
    Ok(ExportSummary {
        file: file.to_owned(),
        vertices: baked.positions.len(),
        triangles: baked.triangles.len() / 3,
        targets: names,
        bytes: bytes.len(),
        half_way_levels: baked.errors.levels / count,
        half_way_mm: baked.errors.mm / count,
    })
}

/// The same view with `columns` pixels across.
fn coarse(camera: &Camera, columns: u32) -> Camera {
    let i = &camera.intrinsics;
    let share = f64::from(columns) / f64::from(i.width);
    let height = ((f64::from(i.height) * share).round() as u32).max(2);
    let down = f64::from(height) / f64::from(i.height);
    let intrinsics = Intrinsics {
        width: columns,
        height,
        fx: i.fx * share,
        fy: i.fy * down,
        cx: i.cx * share,
        cy: i.cy * down,
        skew: i.skew * share,
        ..*i
    };
    Camera { intrinsics, camera_from_world: camera.camera_from_world }
}

/// A view at work, and the neutral face in it.
struct View<'a> {
    camera: Camera,
    studio: Studio<'a>,
    rest: Render,
}

impl<'a> View<'a> {
    fn new(avatar: &'a Avatar, camera: Camera, reporter: &dyn Reporter) -> Result<Self> {
        let outputs = Outputs { depth: true, ..Outputs::default() };
        let mut studio = Studio::new(avatar, Look { full: true, outputs, ..Look::default() });
        let rest = take(&mut studio, &camera, &avatar.neutral(), reporter)?;
        Ok(Self { camera, studio, rest })
    }
}

fn take(studio: &mut Studio<'_>, camera: &Camera, expression: &Expression, reporter: &dyn Reporter) -> Result<Render> {
    if reporter.cancelled() {
        return Err(TrainerError::Interrupted { done: "part of a bake; nothing was written".to_owned() });
    }
    let render = studio.render(camera, expression, reporter)?;
    reporter.advance(1);
    Ok(render)
}

/// Bakes a view's corners of `triangles`, or all its points.
fn bake_view(
    avatar: &Avatar,
    active: &[usize],
    view: &mut View<'_>,
    triangles: Option<&[[usize; 3]]>,
    reference: &Camera,
    baked: &mut Baked,
    reporter: &dyn Reporter,
) -> Result<()> {
    let View { camera, studio, rest } = view;
    let neutral = avatar.neutral();
    let (width, height) = (rest.rgb.width() as usize, rest.rgb.height() as usize);
    let mut wanted = vec![triangles.is_none(); width * height];
    triangles.iter().copied().flatten().flatten().for_each(|&i| wanted[i] = true);
    let center = avatar.saved.center_in_world;
    // World to glTF: the reference camera's axes with y and z turned round.
    let place = |p: DVec3| {
        let c = reference.camera_from_world.rotation * (p - center);
        [c.x as f32, -c.y as f32, -c.z as f32]
    };
    let ray = |i: usize| camera.ray_direction(DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5));
    let first = baked.positions.len();
    let mut vertex_of = vec![u32::MAX; width * height];
    let mut pixels: Vec<(usize, DVec3)> = Vec::new();
    for (i, vertex) in vertex_of.iter_mut().enumerate() {
        if let (Some(direction), true) = (ray(i), wanted[i] && rest.depth[i] > 0.0) {
            *vertex = (first + pixels.len()) as u32;
            pixels.push((i, direction.normalize()));
        }
    }
    let eye = camera.center();
    let at = |depth: f32, direction: DVec3| place(eye + direction * f64::from(depth));
    baked.positions.extend(pixels.iter().map(|(i, d)| at(rest.depth[*i], *d)));
    baked.colors.extend(pixels.iter().map(|(i, _)| linear(rest, *i)));
    for (target, &k) in active.iter().enumerate() {
        let spec = &avatar.saved.table.attributes[k];
        let half = Intensity(f32::midpoint(spec.neutral, spec.au_max));
        let half_way = take(studio, camera, &neutral.with(k, half), reporter)?;
        let full = take(studio, camera, &neutral.with(k, spec.scale().most()), reporter)?;
        for (v, (i, direction)) in pixels.iter().enumerate() {
            let from = baked.positions[first + v];
            let depth = if full.depth[*i] > 0.0 { full.depth[*i] } else { rest.depth[*i] };
            let to = at(depth, *direction);
            baked.moves[target].push(std::array::from_fn(|c| to[c] - from[c]));
            let (a, b) = (baked.colors[first + v], linear(&full, *i));
            baked.tints[target].push(std::array::from_fn(|c| b[c] - a[c]));
            baked.errors.add(rest, &half_way, &full, *i);
        }
    }
    for corners in triangles.iter().copied().flatten() {
        baked.triangles.extend(corners.map(|i| vertex_of[i]));
    }
    Ok(())
}

impl HalfWay {
    fn add(&mut self, rest: &Render, half: &Render, full: &Render, i: usize) {
        let levels = |r: &Render, c: usize| f64::from(r.rgb.as_raw()[i * 3 + c]);
        let change = (0..3).map(|c| (levels(full, c) - levels(rest, c)).abs()).sum::<f64>() / 3.0;
        if change < 1.0 {
            return;
        }
        let mixed = |c: usize| srgb(f32::midpoint(linear(rest, i)[c], linear(full, i)[c]));
        self.levels += (0..3).map(|c| (levels(half, c) - mixed(c)).abs()).sum::<f64>() / 3.0;
        if half.depth[i] > 0.0 && full.depth[i] > 0.0 {
            self.mm += f64::from((half.depth[i] - f32::midpoint(rest.depth[i], full.depth[i])).abs()) * 1e3;
        }
        self.count += 1;
    }
}

/// The colour of a pixel without the curve of sRGB, 0–1.
fn linear(render: &Render, pixel: usize) -> [f32; 3] {
    std::array::from_fn(|c| {
        let v = f32::from(render.rgb.as_raw()[pixel * 3 + c]) / 255.0;
        if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
    })
}

/// The level (of 255) of a linear value.
fn srgb(v: f32) -> f64 {
    let v = f64::from(v.clamp(0.0, 1.0));
    255.0 * if v <= 0.0031308 { v * 12.92 } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 }
}

fn file_of(avatar: &Avatar, active: &[usize], names: &[String], baked: &Baked, driver: Option<&Driver>) -> Vec<u8> {
    let mut numbers = glb::Numbers::default();
    let position = numbers.vectors(&baked.positions, true);
    let color = numbers.vectors(&baked.colors, false);
    let targets: Vec<serde_json::Value> = baked
        .moves
        .iter()
        .zip(&baked.tints)
        .map(|(moves, tints)| {
            json!({"POSITION": numbers.vectors(moves, true), "COLOR_0": numbers.vectors(tints, false)})
        })
        .collect();
    let mut primitive = json!({
        "attributes": {"POSITION": position, "COLOR_0": color},
        "targets": targets,
        "material": 0,
        "mode": if baked.triangles.is_empty() { 0 } else { 4 },
    });
    if !baked.triangles.is_empty() {
        primitive["indices"] = json!(numbers.indices(&baked.triangles));
    }
    let mut animations = vec![animation(&mut numbers, "each AU in turn", &in_turn(active.len()))];
    if let Some(driver) = driver {
        animations.push(animation(&mut numbers, "curves", &weights_of(avatar, active, driver)));
    }
    numbers.into_file(json!({
        "asset": {"version": "2.0", "generator": concat!("risorius ", env!("CARGO_PKG_VERSION"))},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "head", "mesh": 0}],
        "meshes": [{
            "name": "head",
            "primitives": [primitive],
            "weights": vec![0.0; names.len()],
            "extras": {"targetNames": names},
        }],
        "materials": [{
            "name": "skin",
            "doubleSided": true,
            "pbrMetallicRoughness": {"baseColorFactor": [1.0, 1.0, 1.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0},
            "extensions": {"KHR_materials_unlit": {}},
        }],
        "animations": animations,
    }))
}

/// Weights of all targets at times.
type Weights = Vec<(f32, Vec<f32>)>;

fn animation(numbers: &mut glb::Numbers, name: &str, weights: &Weights) -> serde_json::Value {
    let times: Vec<f32> = weights.iter().map(|(t, _)| *t).collect();
    let values: Vec<f32> = weights.iter().flat_map(|(_, w)| w.iter().copied()).collect();
    let (input, output) = (numbers.scalars(&times, true), numbers.scalars(&values, false));
    json!({
        "name": name,
        "samplers": [{"input": input, "output": output, "interpolation": "LINEAR"}],
        "channels": [{"sampler": 0, "target": {"node": 0, "path": "weights"}}],
    })
}

/// Every target up and down, one after the other, a second each.
fn in_turn(count: usize) -> Weights {
    let mut weights = vec![(0.0, vec![0.0; count])];
    for k in 0..count {
        let mut raised = vec![0.0; count];
        raised[k] = 1.0;
        weights.push((k as f32 + 0.5, raised));
        weights.push((k as f32 + 1.0, vec![0.0; count]));
    }
    weights
}

fn weights_of(avatar: &Avatar, active: &[usize], driver: &Driver) -> Weights {
    let last = driver.times_secs.last().copied().unwrap_or(0.0);
    let weight = |k: usize, secs: f64| {
        let spec = &avatar.saved.table.attributes[k];
        let Some(curve) = driver.intensities.get(&spec.unit) else { return 0.0 };
        let value = risorius_formats::curves::interpolate(&driver.times_secs, curve, secs);
        ((value - spec.neutral) / (spec.au_max - spec.neutral).max(0.1)).clamp(0.0, 1.0)
    };
    (0..=(last * FPS) as usize)
        .map(|i| {
            let secs = i as f64 / FPS;
            (secs as f32, active.iter().map(|&k| weight(k, secs)).collect())
        })
        .collect()
}
