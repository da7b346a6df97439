//! Pictures of a fitted avatar.

use rayon::prelude::*;

use crate::expression::MASKS;
use crate::model::{Brick, LATENT, activation, deformation};
use crate::rays::{Look, Rays};

/// Rays that travel together.
const CHUNK: usize = 256;
/// A ray that lets less than this through is over: half a step of an 8-bit picture.
const OPAQUE: f32 = 2e-3;

/// What a ray shows.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Shown {
    /// Colour without what lies behind everything, 0–1.
    pub color: [f32; 3],
    /// How much of what lies behind everything shows.
    pub left: f32,
    /// Masks of the regions.
    pub masks: [f32; MASKS],
    /// Mean distance of the head along the ray, world units; 0 where it is not met.
    pub depth: f32,
}

/// The avatar in one expression.
#[derive(Debug)]
pub struct Face<'a> {
    model: &'a Brick,
    blend: Vec<f32>,
    gates: Vec<f32>,
    latent: Vec<f32>,
    /// Whether the background is looked at.
    pub background: bool,
}

impl<'a> Face<'a> {
    /// The expression of attributes −1..1.
    pub fn new(model: &'a Brick, attributes: &[f32]) -> Self {
        let gates = model.expression.gates();
        let code = &model.codes.values[model.neutral_image * LATENT..(model.neutral_image + 1) * LATENT];
        let activations: Vec<f32> = attributes.iter().map(|&a| activation(a)).chain(code.iter().copied()).collect();
        let (mut blend, mut latent) = (Vec::new(), Vec::new());
        model.expression.blend(&gates, &activations, &mut blend);
        model.latent_blend(code, &mut latent);
        Self { model, blend, gates, latent, background: true }
    }

    /// What rays from `origin` along `directions` (unit, world) show, in parallel.
    pub fn render(&self, origin: [f32; 3], directions: &[[f32; 3]]) -> Vec<Shown> {
        let model = self.model;
        let deformation = deformation(model, &self.blend, &self.gates, Some(&self.latent));
        let look =
            Look { divisions: model.divisions, planes: model.planes, opaque: OPAQUE, background: self.background };
        let mut out = vec![Shown::default(); directions.len()];
        out.par_chunks_mut(CHUNK).zip(directions.par_chunks(CHUNK)).for_each_init(
            Rays::default,
            |rays, (out, directions)| {
                rays.forward(model, &deformation, None, origin, directions, || 0.5, look);
                for (r, out) in out.iter_mut().enumerate() {
                    let [sum, weight] = rays.depth[r];
                    *out = Shown {
                        color: rays.color[r],
                        left: rays.left[r],
                        masks: rays.masks[r],
                        depth: if weight > 0.5 { sum / weight } else { 0.0 },
                    };
                }
            },
        );
        out
    }
}
