//! The whole avatar: a head box, the expression that deforms it, a static background, and what belongs to single images.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::evaluate::Deformation;
use crate::expression::Expression;
use crate::field::Field;
use crate::lattice::{BRICK, Lattice};
use crate::march::{March, crossing};
use crate::math::{dot, rotate};
use crate::occupancy::Occupancy;
use crate::table::Table;

/// Numbers of a latent code ω.
pub const LATENT: usize = 8;
/// A direction of unit length has no larger part, with room for lengths that are not quite 1.
const STEEPEST: f32 = 10.0;
/// Vertices along each edge of the latent displacement's lattice.
const LATENT_VERTICES: usize = 16;

/// A cube in the world that becomes [−1, 1]³.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct HeadBox {
    /// Its middle, world units.
    pub center: [f32; 3],
    /// Half its edge, world units.
    pub half: f32,
}

/// The background's space: the frustum of a mean camera between two depths, evenly divided in 1/depth.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct BackgroundFrame {
    /// Where the mean camera stands, world units.
    pub position: [f32; 3],
    /// Rows: its x, y and forward axes in the world.
    pub axes: [[f32; 3]; 3],
    /// Depth of the nearest and the farthest plane, world units.
    pub near: f32,
    /// See `near`.
    pub far: f32,
    /// Middle of x/depth and y/depth.
    pub middle: [f32; 2],
    /// Half the extent of x/depth and y/depth.
    pub extent: [f32; 2],
}

impl BackgroundFrame {
    /// A ray in the frame's camera as a march through the frame's box, from its nearest plane to its farthest; `None`
    /// for rays that look away from it.
    ///
    /// Dividing by the depth turns lines into lines: with d = 1/depth, x/depth is linear in d along a ray.
    #[inline(always)]
    pub fn march(&self, origin: [f32; 3], direction: [f32; 3], planes: usize, jitter: f32) -> Option<March> {
        // Directions are of unit length: what fails this is none, or looks away.
        if !(direction[2] > 0.05 && direction[0].abs() <= STEEPEST && direction[1].abs() <= STEEPEST) {
            return None;
        }
        let at = |disparity: f32, s: f32| {
            let slope = [direction[0] / direction[2], direction[1] / direction[2]];
            let x = |a: usize| slope[a] + disparity * (origin[a] - origin[2] * slope[a]);
            [(x(0) - self.middle[0]) / self.extent[0], (x(1) - self.middle[1]) / self.extent[1], s]
        };
        let (near, far) = (at(1.0 / self.near, 1.0), at(1.0 / self.far, -1.0));
        let along = std::array::from_fn(|a| (far[a] - near[a]) * 0.5);
        let step = 2.0 / planes as f32;
        Some(March::new(near, along, jitter * step, 2.0, step))
    }

    /// A point of the world in the frame's camera.
    pub fn camera_from_world(&self, p: [f32; 3]) -> [f32; 3] {
        let d = std::array::from_fn(|a| p[a] - self.position[a]);
        self.turn(d)
    }

    /// The direction (unit, world) in which the mean camera sees a point of the frame's box.
    pub fn seen(&self, p: [f32; 3]) -> [f32; 3] {
        let slope = [p[0] * self.extent[0] + self.middle[0], p[1] * self.extent[1] + self.middle[1], 1.0];
        unit(std::array::from_fn(|a| (0..3).map(|row| slope[row] * self.axes[row][a]).sum()))
    }

    /// A direction of the world in the frame's camera.
    pub fn turn(&self, d: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|a| dot(self.axes[a], d))
    }
}

/// What a fit is about, in numbers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Layout {
    /// Where the head is.
    pub head_box: HeadBox,
    /// The background, unless the camera stands still and its picture is known.
    pub background: Option<BackgroundFrame>,
    /// Region of each AU.
    pub region_of: Vec<usize>,
    /// Number of regions.
    pub regions: usize,
    /// Training images.
    pub images: usize,
    /// Vertices of the expression's lattice.
    pub expression_vertices: usize,
    /// Finest level of the head, vertices along an edge.
    pub finest: usize,
}

/// A field with its occupancy.
#[derive(Clone, Debug)]
pub struct Part {
    /// The field.
    pub field: Field,
    /// Where it is not empty.
    pub occupancy: Occupancy,
}

/// A fitted or growing avatar.
#[derive(Clone, Debug)]
pub struct Brick {
    /// What it is about.
    pub layout: Layout,
    /// The head.
    pub head: Part,
    /// The rest.
    pub background: Option<Part>,
    /// What AUs do.
    pub expression: Expression,
    /// Vertices of the latent displacements.
    pub latent_lattice: Lattice,
    /// One displacement field per number of ω.
    pub latent_bases: Vec<Table>,
    /// ω of each image.
    pub codes: Table,
    /// α of each image, as a difference from what was annotated.
    pub alphas: Table,
    /// ln β of each image and AU.
    pub log_betas: Table,
    /// A small turn and shift of each image's camera, box units.
    pub motions: Table,
    /// Samples along the box edge when rendering.
    pub divisions: usize,
    /// Planes of the background when rendering.
    pub planes: usize,
    /// The image whose latent code stands for a neutral face.
    pub neutral_image: usize,
}

impl Brick {
    /// An untrained avatar; `hull(world point)` gives the bits of the regions that hold it.
    pub fn new(layout: Layout, seed: u64, hull: impl Fn([f32; 3]) -> u8) -> Self {
        let mut model = Self::with_hull(layout, hull);
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        model.head.field.draw(&mut rng);
        if let Some(background) = &mut model.background {
            background.field.draw(&mut rng);
        }
        for basis in &mut model.latent_bases {
            *basis = Table::new(model.latent_lattice.slots, basis.block, || (rng.random::<f32>() - 0.5) * 1e-3);
        }
        let images = model.layout.images;
        model.codes = Table::new(images, LATENT, || (rng.random::<f32>() - 0.5) * 0.2);
        for table in [&mut model.alphas, &mut model.log_betas, &mut model.motions] {
            *table = Table::new(images, table.block, || 0.0);
        }
        model
    }

    /// An avatar of this layout without bricks and numbers, for those of a file.
    pub fn empty(layout: Layout) -> Self {
        Self::with_hull(layout, |_| 0)
    }

    /// Lattices and residuals; of all other tables the size of their blocks.
    fn with_hull(layout: Layout, hull: impl Fn([f32; 3]) -> u8) -> Self {
        let mut levels: Vec<Lattice> = [16, 32, 64].map(|n| Lattice::dense([n; 3])).into();
        let mut n = 128;
        while n <= layout.finest {
            levels.push(Lattice::sparse([n; 3]));
            n *= 2;
        }
        let part = |levels| Part { field: Field::empty(levels), occupancy: Occupancy::default() };
        let head = part(levels);
        let background = layout.background.map(|_| {
            let levels = [[32, 24, 16], [64, 48, 32], [128, 96, 32], [256, 192, 16], [512, 384, 8]];
            part(levels.map(Lattice::dense).into())
        });
        let HeadBox { center, half } = layout.head_box;
        let expression =
            Expression::new([layout.expression_vertices; 3], layout.region_of.clone(), layout.regions, LATENT, |p| {
                hull(std::array::from_fn(|a| center[a] + p[a] * half))
            });
        let units = layout.region_of.len();
        Self {
            head,
            background,
            expression,
            latent_lattice: Lattice::dense([LATENT_VERTICES; 3]),
            latent_bases: vec![Table::empty(BRICK * 4); LATENT],
            codes: Table::empty(LATENT),
            alphas: Table::empty(units),
            log_betas: Table::empty(units),
            motions: Table::empty(6),
            divisions: 96,
            planes: 96,
            neutral_image: 0,
            layout,
        }
    }

    /// What rays show depends on these tables: the head's levels and network, the background's, residuals, masks, latent
    /// displacements.
    pub fn shown_by(&self) -> Vec<&Table> {
        let parts = [Some(&self.head), self.background.as_ref()];
        let fields = parts.into_iter().flatten().flat_map(|p| p.field.features.iter().chain([&p.field.net]));
        fields.chain(&self.expression.residuals).chain([&self.expression.masks]).chain(&self.latent_bases).collect()
    }

    /// As [`Self::shown_by`], to be changed.
    pub fn shown_by_mut(&mut self) -> Vec<&mut Table> {
        let parts = [Some(&mut self.head), self.background.as_mut()];
        let fields = parts.into_iter().flatten().flat_map(|p| p.field.features.iter_mut().chain([&mut p.field.net]));
        let Expression { residuals, masks, .. } = &mut self.expression;
        fields.chain(residuals).chain([masks]).chain(&mut self.latent_bases).collect()
    }

    /// Numbers that are learned.
    pub fn parameters(&self) -> usize {
        let of_images = [&self.codes, &self.alphas, &self.log_betas, &self.motions];
        self.shown_by().into_iter().chain(of_images).map(|table| table.values.len()).sum()
    }

    /// The code ω of an image.
    pub fn code(&self, image: usize) -> &[f32] {
        &self.codes.values[image * LATENT..(image + 1) * LATENT]
    }

    /// The displacement of a code ω, 4 numbers per vertex.
    pub fn latent_blend(&self, code: &[f32], out: &mut Vec<f32>) {
        out.clear();
        out.resize(self.latent_lattice.slots * BRICK * 4, 0.0);
        for (&c, basis) in code.iter().zip(&self.latent_bases) {
            for (o, v) in out.iter_mut().zip(&basis.values) {
                *o += c * v;
            }
        }
    }

    /// The direction (unit, world) in which `eye` (world) sees a point of the head box.
    pub fn seen_in_head(&self, eye: [f32; 3], p: [f32; 3]) -> [f32; 3] {
        let HeadBox { center, half } = self.layout.head_box;
        unit(std::array::from_fn(|a| center[a] + p[a] * half - eye[a]))
    }

    /// A world ray through the head box, after a small turn and shift of its camera; `t` counts box units.
    pub fn head_march(
        &self,
        origin: [f32; 3],
        direction: [f32; 3],
        motion: Option<&[f32]>,
        divisions: usize,
        jitter: f32,
    ) -> March {
        let HeadBox { center, half } = self.layout.head_box;
        let mut origin: [f32; 3] = std::array::from_fn(|a| (origin[a] - center[a]) / half);
        let mut direction = direction;
        if let Some(m) = motion {
            let turn = [m[0], m[1], m[2]];
            let turned = rotate(turn, origin);
            origin = std::array::from_fn(|a| turned[a] + m[3 + a]);
            direction = rotate(turn, direction);
        }
        let (enter, exit) = crossing(origin, direction);
        let step = 2.0 / divisions as f32;
        March::new(origin, direction, enter + jitter * step, exit, step)
    }
}

fn unit(v: [f32; 3]) -> [f32; 3] {
    let length = dot(v, v).sqrt();
    if length > 0.0 { v.map(|x| x / length) } else { [0.0, 0.0, 1.0] }
}

/// How strongly an AU acts at attribute α (−1..1): 0 at the AU's least, 1 at its most.
#[inline]
pub fn activation(alpha: f32) -> f32 {
    (alpha + 1.0) * 0.5
}

/// Everything an image's rays need of the expression.
pub fn deformation<'a>(
    model: &'a Brick,
    blend: &'a [f32],
    gates: &'a [f32],
    latent: Option<&'a [f32]>,
) -> Deformation<'a> {
    Deformation { lattice: &model.expression.lattice, blend, gates, latent: latent.map(|l| (&model.latent_lattice, l)) }
}
