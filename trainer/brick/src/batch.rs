//! Rays of one image as one function of all that is learned, with its gradient: for losses of one's own. A fit does the same
//! in pieces, and updates what it touched in place.

use rayon::prelude::*;

use crate::evaluate::{DeformationGrad, Lot};
use crate::expression::{self, BlendGrad, MASKS, REST, Seen};
use crate::field::FieldGrad;
use crate::lattice::BRICK;
use crate::model::{Brick, LATENT, deformation};
use crate::rays::{Look, Prior, Rays, Upstream};

/// Rays that travel together.
const CHUNK: usize = 128;
/// Samples that go through the network together at least.
const BATCH: usize = 128;
/// Gradients are gathered in so many shares, whatever the number of threads: sums do not depend on it.
const SHARES: usize = 8;

/// Rays from one place.
#[derive(Clone, Debug, PartialEq)]
pub struct RayBatch {
    /// Where they begin, world units.
    pub origin: [f32; 3],
    /// Unit directions, world axes.
    pub directions: Vec<[f32; 3]>,
    /// Where each ray's samples stand in their steps, 0–1; 0.5 for all if empty.
    pub jitter: Vec<f32>,
    /// Samples along the head box's edge.
    pub divisions: usize,
    /// Planes of the background.
    pub planes: usize,
    /// A ray that lets less than this through is over; 0 follows all to their ends.
    pub opaque: f32,
    /// Weight of ln(1 + 2σ²), summed over a ray's samples, in head and background.
    pub haze: [f32; 2],
    /// Weight of Σ w_i w_j |t_i − t_j| + ⅓ Σ w_i² step, in head and background.
    pub spread: [f32; 2],
}

/// What a ray shows, or a gradient of it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RayValues {
    /// Colour without what lies behind everything.
    pub color: [f32; 3],
    /// Transmittance behind everything.
    pub left: f32,
    /// Region masks. They have no gradient in the density.
    pub masks: [f32; MASKS],
    /// Σ weight · distance (world units) and Σ weight, of the head.
    pub depth: [f32; 2],
    /// What haze and spread hold against the ray.
    pub regular: f32,
}

/// Gradients of Σ ⟨upstream, values⟩.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BatchGrad {
    /// Of each of [`Brick::shown_by`]'s tables.
    pub tables: Vec<Vec<f32>>,
    /// Of the activations and the code.
    pub activations: Vec<f32>,
    /// Of the camera's turn and shift.
    pub motion: [f32; 6],
}

/// An image's expression.
struct Ready<'a> {
    model: &'a Brick,
    batch: &'a RayBatch,
    motion: &'a [f32],
    gates: Vec<f32>,
    blend: Vec<f32>,
    latent: Vec<f32>,
    look: Look,
    prior: [Prior; 2],
}

impl<'a> Ready<'a> {
    fn new(model: &'a Brick, activations: &[f32], motion: &'a [f32], batch: &'a RayBatch) -> Self {
        let gates = model.expression.gates();
        let (mut blend, mut latent) = (Vec::new(), Vec::new());
        model.expression.blend(&gates, activations, &mut blend);
        model.latent_blend(&activations[activations.len() - LATENT..], &mut latent);
        let look = Look {
            divisions: batch.divisions,
            planes: batch.planes,
            opaque: batch.opaque,
            batch: BATCH,
            faint: None,
            tells_acts: false,
            everywhere: false,
        };
        let prior = [0, 1].map(|part| Prior { haze: batch.haze[part], spread: batch.spread[part] });
        Self { model, batch, motion, gates, blend, latent, look, prior }
    }

    fn forward(&self, rays: &mut Rays, first: usize, directions: &[[f32; 3]]) {
        let Self { model, batch, motion, .. } = self;
        let deformation = deformation(model, &self.blend, &self.gates, Some(&self.latent));
        // The head asks once for each ray, and then the background.
        let mut asked = 0;
        let jitter = || {
            let ray = first + asked % directions.len();
            asked += 1;
            batch.jitter.get(ray).copied().unwrap_or(0.5)
        };
        rays.forward(model, &deformation, Some(motion), batch.origin, directions, jitter, self.look);
    }
}

/// What the rays show, with these activations (AUs and then the code) and this turn and shift of the camera.
pub fn forward(model: &Brick, activations: &[f32], motion: &[f32; 6], batch: &RayBatch) -> Vec<RayValues> {
    let ready = Ready::new(model, activations, motion, batch);
    let mut out = vec![RayValues::default(); batch.directions.len()];
    out.par_chunks_mut(CHUNK).zip(batch.directions.par_chunks(CHUNK)).enumerate().for_each_init(
        Rays::default,
        |rays, (chunk, (out, directions))| {
            ready.forward(rays, chunk * CHUNK, directions);
            let regular = rays.regular(ready.look, ready.prior);
            for (r, out) in out.iter_mut().enumerate() {
                *out = RayValues {
                    color: rays.color[r],
                    left: rays.left[r],
                    masks: rays.masks[r],
                    depth: rays.depth[r],
                    regular: regular[r],
                };
            }
        },
    );
    out
}

/// Gradients that one share of the rays gathered.
#[derive(Default)]
struct Share {
    /// Of head and background.
    fields: [FieldGrad; 2],
    blend: BlendGrad,
    gates: Vec<f32>,
    latent: Vec<f32>,
    motion: [f32; 6],
}

/// Gradients of Σ ⟨upstream, [`forward`]'s values⟩; rays are sent again.
pub fn backward(
    model: &Brick,
    activations: &[f32],
    motion: &[f32; 6],
    batch: &RayBatch,
    upstream: &[RayValues],
) -> BatchGrad {
    let ready = Ready::new(model, activations, motion, batch);
    let count = batch.directions.len();
    let per_share = count.div_ceil(SHARES).next_multiple_of(CHUNK);
    let shares: Vec<Share> = (0..count)
        .step_by(per_share.max(1))
        .collect::<Vec<_>>()
        .into_par_iter()
        .map(|first| ready.backward(first, (first + per_share).min(count), upstream))
        .collect();
    merged(model, activations, &ready, &shares)
}

impl Ready<'_> {
    fn backward(&self, from: usize, to: usize, upstream: &[RayValues]) -> Share {
        let Self { model, batch, .. } = self;
        let deformation = deformation(model, &self.blend, &self.gates, Some(&self.latent));
        let mut share = Share::default();
        let parts = [Some(&model.head), model.background.as_ref()];
        for (grad, part) in share.fields.iter_mut().zip(parts).filter_map(|(grad, part)| Some((grad, part?))) {
            grad.fit(&part.field);
        }
        let transposed = parts.map(|part| part.map(|part| part.field.transposed()));
        share.blend.fit(model.expression.lattice.slots);
        share.gates = vec![0.0; self.gates.len()];
        share.latent = vec![0.0; self.latent.len()];
        let mut rays = Rays::default();
        for first in (from..to).step_by(CHUNK) {
            let last = (first + CHUNK).min(to);
            let upstream = &upstream[first..last];
            self.forward(&mut rays, first, &batch.directions[first..last]);
            let color: Vec<[f32; 3]> = upstream.iter().map(|u| u.color).collect();
            let left: Vec<f32> = upstream.iter().map(|u| u.left).collect();
            let masks: Vec<[f32; MASKS]> = upstream.iter().map(|u| u.masks).collect();
            let depth: Vec<[f32; 2]> = upstream.iter().map(|u| u.depth).collect();
            let regular: Vec<f32> = upstream.iter().map(|u| u.regular).collect();
            rays.backward(
                model,
                &deformation,
                [transposed[0].as_ref(), transposed[1].as_ref()],
                self.look,
                Upstream {
                    color: &color,
                    left: &left,
                    masks: Some(&masks),
                    depth: Some(&depth),
                    regular: Some(&regular),
                },
                self.prior,
                Lot::default(),
                share.fields.each_mut(),
                &mut DeformationGrad {
                    blend: &mut share.blend,
                    gates: &mut share.gates,
                    latent: &mut share.latent,
                    motion: &mut share.motion,
                    moves: true,
                },
            );
        }
        share
    }
}

/// The shares' sum, passed on to tables and activations.
fn merged(model: &Brick, activations: &[f32], ready: &Ready<'_>, shares: &[Share]) -> BatchGrad {
    let add = |sum: &mut [f32], part: &[f32]| sum.iter_mut().zip(part).for_each(|(a, b)| *a += b);
    let mut out = BatchGrad { activations: vec![0.0; activations.len()], ..BatchGrad::default() };
    for (p, part) in [Some(&model.head), model.background.as_ref()].into_iter().enumerate() {
        let Some(part) = part else { continue };
        let grads = || shares.iter().map(|share| &share.fields[p]);
        for (l, table) in part.field.features.iter().enumerate() {
            let mut sum = vec![0.0; table.values.len()];
            for grad in grads() {
                grad.features[l].add_to(&mut sum);
            }
            // A sparse level's first brick is what is not there.
            if part.field.levels[l].sparse {
                sum[..BRICK * crate::field::FEATURES].fill(0.0);
            }
            out.tables.push(sum);
        }
        let mut net = vec![0.0; part.field.net.values.len()];
        for grad in grads() {
            add(&mut net, &grad.net.values);
        }
        out.tables.push(net);
    }
    let expression = &model.expression;
    let mut residuals: Vec<Vec<f32>> = expression.residuals.iter().map(|t| vec![0.0; t.values.len()]).collect();
    let mut gates = vec![0.0; ready.gates.len()];
    let mut latent = vec![0.0; ready.latent.len()];
    for share in shares {
        let seen = Seen { activations, d_blend: &share.blend };
        expression::backward(expression, &ready.gates, seen, &mut residuals, &mut out.activations);
        add(&mut gates, &share.gates);
        add(&mut latent, &share.latent);
        add(&mut out.motion, &share.motion);
    }
    out.tables.extend(residuals);
    let logits = expression.masks.values.as_chunks::<MASKS>().0;
    let d_gates = gates.as_chunks::<MASKS>().0;
    let mut masks = vec![0.0; expression.masks.values.len()];
    for (vertex, (d, logits)) in d_gates.iter().zip(logits).enumerate() {
        for n in (0..REST).filter(|n| expression.allowed[vertex] >> n & 1 == 1) {
            masks[vertex * MASKS + n] = d[n] * expression::gate_slope(logits[n]);
        }
    }
    out.tables.push(masks);
    let first_code = activations.len() - LATENT;
    for (j, basis) in model.latent_bases.iter().enumerate() {
        out.activations[first_code + j] += latent.iter().zip(&basis.values).map(|(d, v)| d * v).sum::<f32>();
        out.tables.push(latent.iter().map(|d| d * activations[first_code + j]).collect());
    }
    out
}
