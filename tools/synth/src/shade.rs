//! Light on skin, hair, eyes, teeth and cloth. Colours are linear RGB until [`encode`].

use std::sync::LazyLock;

use glam::Vec3;
use risorius_formats::Isometry;

use crate::expression::{FaceState, Lids};
use crate::face;
use crate::mesh::{Material, key_direction};
use crate::noise::{fractal, step, value};
use crate::scene::Scene;
use crate::shape::EYEBALL;

/// What is seen where an opening shows nothing else: the dark of the mouth, or the flesh in the corner of an eye.
pub(crate) fn cavity(label: u8) -> Vec3 {
    if label == face::EYE_LABEL { Vec3::new(0.34, 0.15, 0.13) } else { Vec3::new(0.035, 0.009, 0.010) }
}

/// The lights: one key, one fill, and a sky.
pub(crate) struct Light {
    key: Vec3,
    fill: Vec3,
}

impl Light {
    /// The key light turns with the head: its shadows are baked.
    pub(crate) fn new(world_from_head: &Isometry) -> Self {
        let key = (world_from_head.rotation * key_direction().as_dvec3()).as_vec3();
        Self { key, fill: Vec3::new(0.80, 0.15, 0.55).normalize() }
    }
}

/// A point to shade.
pub(crate) struct Point {
    pub(crate) material: Material,
    pub(crate) rest: Vec3,
    pub(crate) normal: Vec3,
    pub(crate) colour: Vec3,
    pub(crate) light: Vec3,
    pub(crate) to_eye: Vec3,
}

/// The colour that reaches the camera, and the point's label.
pub(crate) fn shade(point: &Point, scene: &Scene, state: &FaceState, light: &Light, mesh_label: u8) -> (Vec3, u8) {
    match point.material {
        Material::Head => {
            let hair = point.light.z;
            let label = if hair > 0.02 { 0 } else { face::region(point.rest) };
            let (albedo, gloss) = face::paint(point.rest, label, point.colour, &scene.person, state);
            if hair > 0.5 {
                let sheen = 0.35 * scene.person.hair + Vec3::splat(0.03);
                return (lit(point, albedo, 0.0, light) + sheen * glint(point, light, 14.0) * point.light.y, label);
            }
            (lit(point, albedo, gloss, light), label)
        }
        Material::Ear => (lit(point, point.colour, 0.06, light), 0),
        Material::Body => (lit(point, cloth(point, scene), 0.02, light), 0),
        Material::Eye => (eyeball(point, scene, state, light), mesh_label),
        Material::UpperTeeth | Material::LowerTeeth => (teeth(point, light), mesh_label),
        Material::Tongue => (lit(point, Vec3::new(0.42, 0.13, 0.13), 0.2, light) * 0.55, mesh_label),
    }
}

fn glint(point: &Point, light: &Light, power: f32) -> f32 {
    (light.key + point.to_eye).normalize().dot(point.normal).max(0.0).powf(power)
}

/// Lambert with a soft terminator, a cool fill, a sky, and a little gloss.
fn lit(point: &Point, albedo: Vec3, gloss: f32, light: &Light) -> Vec3 {
    let n = point.normal;
    let (open, shadow) = (point.light.x, point.light.y);
    let facing = n.dot(light.key);
    // Light that wraps around the terminator is reddish on skin.
    let key = Vec3::new((facing + 0.30) / 1.30, (facing + 0.18) / 1.18, (facing + 0.14) / 1.14).max(Vec3::ZERO);
    let key = key * Vec3::new(1.02, 0.96, 0.88) * (0.25 + 0.75 * shadow);
    let fill = Vec3::new(0.16, 0.18, 0.22) * n.dot(light.fill).max(0.0);
    let sky = Vec3::new(0.30, 0.30, 0.32).lerp(Vec3::new(0.14, 0.12, 0.11), 0.5 - 0.5 * n.y);
    let diffuse = albedo * (key * 0.74 + (fill + sky) * (0.25 + 0.75 * open));
    let rim = (1.0 - n.dot(point.to_eye).max(0.0)).powi(4) * 0.05 * open;
    diffuse + Vec3::splat(gloss * glint(point, light, 22.0) * shadow + rim)
}

fn cloth(point: &Point, scene: &Scene) -> Vec3 {
    let p = point.rest;
    let person = &scene.person;
    let round = (p.x * p.x + (p.z - 0.01) * (p.z - 0.01)).sqrt();
    let collar = -0.176 - 0.25 * (p.z - 0.01).max(0.0) + 0.12 * (round - 0.07).max(0.0);
    if p.y > collar {
        return point.colour;
    }
    let stripes = step(0.42, 0.5, (p.y * 42.0 + 0.02 * (p.x * 30.0).sin()).rem_euclid(1.0))
        * step(1.0, 0.92, (p.y * 42.0).rem_euclid(1.0));
    let weave = fractal(p * 240.0, person.seed ^ 0x33);
    let hem = step(collar - 0.007, collar - 0.006, p.y);
    let base = person.shirt[0].lerp(person.shirt[1], stripes * (1.0 - hem));
    base * (0.70 + 0.45 * weave)
}

fn eyeball(point: &Point, scene: &Scene, state: &FaceState, light: &Light) -> Vec3 {
    let side = if point.rest.x < 0.0 { -1.0 } else { 1.0 };
    let out = (point.rest - Vec3::new(EYEBALL.x * side, EYEBALL.y, EYEBALL.z)).normalize();
    let off = out.truncate().length();
    let angle = out.y.atan2(out.x);
    let corner = step(0.35, 1.0, (point.rest.x.abs() - Lids::CENTRE[0]).abs() / Lids::HALF_WIDTH);
    let vein = value(Vec3::new(angle * 6.0, off * 5.0, side), scene.person.seed ^ 0x3d);
    let mut albedo = Vec3::new(0.80, 0.79, 0.78) * (0.96 + 0.06 * vein);
    albedo *= Vec3::ONE - Vec3::new(0.06, 0.24, 0.22) * corner;
    // Iris with fibres and a dark rim, then the pupil.
    let fibre = value(Vec3::new(angle.cos() * 7.0, angle.sin() * 7.0, off * 12.0), scene.person.seed ^ 0x3e);
    let iris = scene.person.iris * (0.75 + 0.9 * fibre) * (1.0 + 0.9 * step(0.36, 0.24, off));
    let iris = iris.lerp(scene.person.iris * 0.16, step(0.39, 0.46, off));
    albedo = albedo.lerp(iris, step(0.475, 0.445, off));
    albedo = albedo.lerp(Vec3::splat(0.008), step(0.205, 0.180, off));
    // The upper lid throws a shadow.
    let u = (point.rest.x.abs() - Lids::CENTRE[0]) / Lids::HALF_WIDTH;
    let [upper, _] = state.lids.edges(u);
    let shadow = 0.45 + 0.55 * step(0.0005, 0.0046, upper - point.rest.y);
    let base = lit(point, albedo * 0.96, 0.0, light) * shadow;
    // A catch-light that always sits at the same place, up and to the side of the key light.
    let catch = step(0.105, 0.070, (out.x + 0.17).hypot(out.y - 0.20));
    base + Vec3::splat(0.75 * catch * step(0.0, 0.001, upper - point.rest.y))
        + Vec3::splat(0.25 * glint(point, light, 160.0))
}

fn teeth(point: &Point, light: &Light) -> Vec3 {
    let p = point.rest;
    let upper = point.material == Material::UpperTeeth;
    let width = if upper { 0.0078 } else { 0.0062 };
    let across = (p.x / width).rem_euclid(1.0);
    let gap = step(0.07, 0.0, across.min(1.0 - across));
    let mut albedo = Vec3::new(0.84, 0.80, 0.72) * (1.0 - 0.55 * gap);
    let gum = if upper { step(-0.0478, -0.0466, p.y) } else { step(-0.0706, -0.0718, p.y) };
    albedo = albedo.lerp(Vec3::new(0.52, 0.20, 0.19), gum);
    // Deep in the corners it is dark.
    lit(point, albedo, 0.10, light) * (0.92 - 0.72 * step(0.008, 0.021, p.x.abs()))
}

/// sRGB codes of linear values 0..1 in steps of 1/4095, after a soft shoulder that keeps highlights from clipping hard.
static CODES: LazyLock<Vec<u8>> = LazyLock::new(|| {
    (0..=CODE_STEPS * 2)
        .map(|i| {
            let c = i as f32 / CODE_STEPS as f32;
            let c = if c > 0.8 { 0.8 + 0.2 * (1.0 - (-(c - 0.8) / 0.2).exp()) } else { c };
            let s = if c <= 0.003_130_8 { 12.92 * c } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 };
            (s * 255.0 + 0.5) as u8
        })
        .collect()
});
const CODE_STEPS: usize = 4095;

/// Linear RGB as 8-bit sRGB.
pub(crate) fn encode(colour: Vec3) -> [u8; 3] {
    // A float-to-integer cast limits to 0 from below.
    colour.to_array().map(|c| CODES[((c * CODE_STEPS as f32 + 0.5) as usize).min(CODE_STEPS * 2)])
}
