//! Grids over the surfaces of the shape, with what never changes baked into their vertices.

use glam::Vec3;
use rayon::prelude::*;

use crate::face::region;
use crate::noise::{fractal, spots, step, value};
use crate::person::Person;
use crate::shape::{self, BODY_CENTRE, EAR, EYEBALL, EYEBALL_RADIUS, HEAD_CENTRE};

/// What a mesh is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Material {
    /// Skin and hair of the head.
    Head,
    /// Ears.
    Ear,
    /// Neck and shirt.
    Body,
    /// An eyeball.
    Eye,
    /// Teeth of the upper jaw.
    UpperTeeth,
    /// Teeth of the lower jaw.
    LowerTeeth,
    /// The tongue.
    Tongue,
}

/// A grid of `columns` × `rows` vertices; the columns may close to a ring.
#[derive(Clone, Debug)]
pub(crate) struct Mesh {
    pub(crate) material: Material,
    pub(crate) columns: usize,
    pub(crate) rows: usize,
    pub(crate) closed: bool,
    /// Where each vertex is on the skin of the standard head: its name.
    pub(crate) rest: Vec<Vec3>,
    /// Where it is at rest, with hair, before the person's stretch.
    pub(crate) position: Vec<Vec3>,
    pub(crate) normal: Vec<Vec3>,
    /// Unchanging colour, linear RGB.
    pub(crate) colour: Vec<Vec3>,
    /// Ambient light (x) and key light (y) that reach the vertex, 0..1; z is how much of it is hair.
    pub(crate) light: Vec<Vec3>,
    /// 0 the rest, 1.. the regions.
    pub(crate) label: Vec<u8>,
}

/// Direction to the key light in the head frame.
pub(crate) fn key_direction() -> Vec3 {
    Vec3::new(-0.42, 0.62, 0.86).normalize()
}

impl Mesh {
    /// The vertex at a column and row; columns wrap where the grid is closed.
    pub(crate) fn index(&self, column: usize, row: usize) -> usize {
        row * self.columns + if column == self.columns { 0 } else { column }
    }

    /// The normal at a vertex for `position`, outwards.
    pub(crate) fn grid_normal(&self, position: &[Vec3], index: usize) -> Vec3 {
        let (row, column) = (index / self.columns, index % self.columns);
        let (left, right) = if self.closed {
            ((column + self.columns - 1) % self.columns, (column + 1) % self.columns)
        } else {
            (column.saturating_sub(1), (column + 1).min(self.columns - 1))
        };
        let (below, above) = (row.saturating_sub(1), (row + 1).min(self.rows - 1));
        let across = position[row * self.columns + right] - position[row * self.columns + left];
        let along = position[above * self.columns + column] - position[below * self.columns + column];
        across.cross(along).try_normalize().unwrap_or(self.normal.get(index).copied().unwrap_or(Vec3::Y))
    }

    fn new(material: Material, columns: usize, rows: usize, closed: bool, rest: Vec<Vec3>) -> Self {
        let n = rest.len();
        let position = rest.clone();
        let mut mesh = Self {
            material,
            columns,
            rows,
            closed,
            rest,
            position,
            normal: Vec::new(),
            colour: vec![Vec3::ONE; n],
            light: vec![Vec3::new(1.0, 1.0, 0.0); n],
            label: vec![0; n],
        };
        mesh.update_normals();
        mesh
    }

    fn update_normals(&mut self) {
        let normal = (0..self.rest.len()).into_par_iter().map(|i| self.grid_normal(&self.position, i)).collect();
        self.normal = normal;
    }
}

/// A grid of directions around +z, denser in front; `density` 0 is even, towards 1 ever denser.
fn star(columns: usize, rows: usize, density: f32, hit: impl Fn(Vec3) -> Vec3 + Sync) -> Vec<Vec3> {
    let warp = |s: f32| s * (1.0 - density + density * s * s);
    (0..columns * rows)
        .into_par_iter()
        .map(|i| {
            let (row, column) = (i / columns, i % columns);
            let azimuth = std::f32::consts::PI * warp(2.0 * column as f32 / columns as f32 - 1.0);
            let elevation = std::f32::consts::FRAC_PI_2 * warp(2.0 * row as f32 / (rows - 1) as f32 - 1.0) * 0.9999;
            let (sin, cos) = elevation.sin_cos();
            hit(Vec3::new(cos * azimuth.sin(), sin, cos * azimuth.cos()))
        })
        .collect()
}

/// How much hair stands at a point of the skin, 0..1.
pub(crate) fn hair_cover(p: Vec3, person: &Person) -> f32 {
    let to_temple = step(0.072, 0.030, p.z);
    let to_ear = step(0.040, 0.004, p.z);
    let to_nape = step(-0.005, -0.060, p.z);
    let parting = 0.006 * ((p.x + 0.02) * 38.0).sin();
    let mut line = 0.0905 + parting - 0.010 * to_temple;
    line += (0.012 - line) * to_ear;
    line += (-0.055 - line) * to_nape;
    line += 0.004 * (value(p * 260.0, person.seed ^ 0x1f) - 0.5);
    step(line - 0.003, line + 0.004, p.y)
}

/// The head with its hair.
pub(crate) fn head(person: &Person) -> Mesh {
    let distance = |p: Vec3| shape::head(p, person);
    let (columns, rows) = (380, 300);
    let rest = star(columns, rows, 0.58, |d| shape::leave(distance, HEAD_CENTRE, d, 0.17));
    let mut mesh = Mesh::new(Material::Head, columns, rows, true, rest);
    let key = key_direction();
    let baked: Vec<(Vec3, Vec3, Vec3, u8)> = (0..mesh.rest.len())
        .into_par_iter()
        .map(|i| {
            let (p, n) = (mesh.rest[i], mesh.normal[i]);
            let hair = hair_cover(p, person);
            let out = (p - HEAD_CENTRE).normalize();
            let crown = step(0.02, 0.12, p.y);
            let lock = fractal(Vec3::new(p.x * 130.0, p.y * 38.0, p.z * 38.0), person.seed ^ 0x29) - 0.5;
            let thickness = hair * person.hair_thickness * (0.45 + 0.75 * crown + 0.55 * lock);
            let light = Vec3::new(shape::openness(distance, p, n), shape::lit(distance, p, key), hair);
            let colour = skin(p, person).lerp(hair_colour(p, person), hair);
            let label = if hair > 0.02 { 0 } else { region(p) };
            (p + out * thickness, colour, light, label)
        })
        .collect();
    for (i, (position, colour, light, label)) in baked.into_iter().enumerate() {
        mesh.position[i] = position;
        mesh.colour[i] = colour;
        mesh.light[i] = light;
        mesh.label[i] = label;
    }
    mesh.update_normals();
    mesh
}

fn hair_colour(p: Vec3, person: &Person) -> Vec3 {
    // Strands run from the crown down: long along y and z, fine along x.
    let angle = p.x.atan2(p.y - 0.03) * 46.0;
    let strand = fractal(Vec3::new(angle, p.z * 55.0, p.y * 22.0), person.seed ^ 0x2b);
    person.hair * (0.45 + 1.0 * strand)
}

/// The unchanging colour of bare skin: mottling, blush, freckles and a few moles.
pub(crate) fn skin(p: Vec3, person: &Person) -> Vec3 {
    let m = Vec3::new(p.x.abs(), p.y, p.z);
    let mottled = fractal(p * 95.0, person.seed ^ 1) - 0.5;
    let mut c = person.skin * (1.0 + 0.16 * mottled);
    let ball = |centre: Vec3, radius: f32| (-(m - centre).length_squared() / (radius * radius)).exp();
    let blush = 0.75 * ball(Vec3::new(0.042, -0.020, 0.070), 0.020) + 0.60 * ball(Vec3::new(0.0, -0.021, 0.106), 0.013);
    let blush = blush + 0.35 * ball(Vec3::new(0.0, -0.092, 0.088), 0.016);
    c *= Vec3::ONE - Vec3::new(0.03, 0.24, 0.22) * blush;
    // Cooler, darker hollows around the eyes.
    c *= Vec3::ONE - Vec3::new(0.20, 0.22, 0.16) * (0.8 * ball(Vec3::new(0.020, 0.020, 0.075), 0.013));
    if p.z > 0.02 {
        let (d, which) = spots(p * 190.0, person.seed ^ 2);
        let field = ball(Vec3::new(0.036, -0.012, 0.075), 0.026).max(ball(Vec3::new(0.0, 0.004, 0.095), 0.016)) + 0.16;
        if which < person.freckles * field.min(1.0) {
            c *= Vec3::ONE - Vec3::new(0.24, 0.36, 0.44) * step(0.34, 0.12, d);
        }
        let (d, which) = spots(p * 42.0, person.seed ^ 3);
        if which < 0.10 {
            c *= Vec3::ONE - Vec3::new(0.60, 0.68, 0.72) * step(0.062, 0.035, d);
        }
    }
    c
}

/// One ear; `side` is 1 for the subject's left, −1 for the right.
pub(crate) fn ear(person: &Person, side: f32) -> Mesh {
    let centre = Vec3::new(EAR.x * side, EAR.y, EAR.z);
    let rest = star(72, 60, 0.0, |d| shape::leave(shape::ear, centre, d, 0.05));
    let mut mesh = Mesh::new(Material::Ear, 72, 60, true, rest);
    let key = key_direction();
    let both = |p: Vec3| shape::ear(p).min(shape::head(p, person));
    for i in 0..mesh.rest.len() {
        let (p, n) = (mesh.rest[i], mesh.normal[i]);
        mesh.colour[i] = skin(p, person) * Vec3::new(1.0, 0.84, 0.82);
        mesh.light[i] = Vec3::new(shape::openness(both, p, n), shape::lit(both, p, key), 0.0);
    }
    mesh
}

/// Neck, shoulders and shirt.
pub(crate) fn body(person: &Person) -> Mesh {
    let (columns, rows) = (240, 160);
    let rest = star(columns, rows, 0.0, |d| shape::leave(shape::body, BODY_CENTRE, d, 0.36));
    let mut mesh = Mesh::new(Material::Body, columns, rows, true, rest);
    let key = key_direction();
    let both = |p: Vec3| shape::body(p).min(shape::head(p, person));
    let baked: Vec<(Vec3, Vec3)> = (0..mesh.rest.len())
        .into_par_iter()
        .map(|i| {
            let (p, n) = (mesh.rest[i], mesh.normal[i]);
            let light = Vec3::new(shape::openness(both, p, n), shape::lit(both, p, key), 0.0);
            (skin(p, person) * Vec3::new(0.96, 0.92, 0.90), light)
        })
        .collect();
    for (i, (colour, light)) in baked.into_iter().enumerate() {
        mesh.colour[i] = colour;
        mesh.light[i] = light;
    }
    mesh
}

/// An eyeball; `side` as in [`ear`].
pub(crate) fn eyeball(side: f32) -> Mesh {
    let centre = Vec3::new(EYEBALL.x * side, EYEBALL.y, EYEBALL.z);
    // The cornea bulges a little.
    let hit = |d: Vec3| centre + d * (EYEBALL_RADIUS + 0.0007 * step(0.86, 0.97, d.z));
    let mut mesh = Mesh::new(Material::Eye, 64, 48, true, star(64, 48, 0.4, hit));
    mesh.label.fill(crate::face::EYE_LABEL);
    mesh
}

/// A bent strip in the mouth between two heights.
fn strip(material: Material, half_width: f32, heights: [f32; 2], z: f32, bend: f32) -> Mesh {
    let (columns, rows) = (33, 9);
    let rest = (0..columns * rows)
        .map(|i| {
            let (u, v) = ((i % columns) as f32 / (columns - 1) as f32, (i / columns) as f32 / (rows - 1) as f32);
            let x = half_width * (2.0 * u - 1.0);
            let belly = 0.0016 * (std::f32::consts::PI * v).sin();
            Vec3::new(x, heights[0] + (heights[1] - heights[0]) * v, z - bend * x * x + belly)
        })
        .collect();
    let mut mesh = Mesh::new(material, columns, rows, false, rest);
    mesh.label.fill(crate::face::MOUTH_LABEL);
    mesh
}

/// Teeth and tongue.
pub(crate) fn mouth_parts() -> [Mesh; 3] {
    [
        strip(Material::UpperTeeth, 0.0225, [-0.0570, -0.0440], 0.0865, 22.0),
        strip(Material::LowerTeeth, 0.0200, [-0.0740, -0.0625], 0.0835, 22.0),
        strip(Material::Tongue, 0.0180, [-0.0780, -0.0655], 0.0760, 12.0),
    ]
}
