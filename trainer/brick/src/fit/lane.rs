//! One thread's share of a step: the rays of its images, forward and back.

use rand::Rng;

use super::{Pixel, Settings, Views, activations, rng_for};
use crate::evaluate::DeformationGrad;
use crate::expression::{CHANNELS, MASKS};
use crate::field::{FieldGrad, Transposed};
use crate::lattice::BRICK;
use crate::model::{Brick, LATENT, deformation};
use crate::occupancy::PART_COUNT;
use crate::rays::{Look, Prior, Rays};
use crate::table::{Table, TableGrad};

/// Rays that travel together: their samples' activations stay in the cache.
pub(super) const CHUNK: usize = 64;

/// One thread's gradients and scratch.
#[derive(Debug, Default)]
pub(super) struct Lane {
    pub(super) head: FieldGrad,
    pub(super) background: FieldGrad,
    pub(super) residuals: Vec<TableGrad>,
    pub(super) masks: TableGrad,
    pub(super) latent_bases: Vec<TableGrad>,
    pub(super) codes: TableGrad,
    pub(super) alphas: TableGrad,
    pub(super) log_betas: TableGrad,
    pub(super) motions: TableGrad,
    /// Gradients of the masks at the vertices.
    d_gates: Vec<f32>,
    blend: Vec<f32>,
    d_blend: Vec<f32>,
    latent: Vec<f32>,
    d_latent: Vec<f32>,
    pub(super) weights: [Vec<f32>; 2],
    pub(super) rays: Rays,
    pixels: Vec<Pixel>,
    pub(super) numbers: Totals,
}

#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Totals {
    pub(super) rays: usize,
    pub(super) samples: [usize; 2],
    pub(super) color: f64,
    pub(super) mask: f64,
    pub(super) masked: usize,
    pub(super) attribute: f64,
    pub(super) annotated: usize,
}

/// What every lane reads.
pub(super) struct Work<'a> {
    pub(super) model: &'a Brick,
    pub(super) settings: &'a Settings,
    pub(super) gates: Vec<f32>,
    pub(super) transposed: [Option<Transposed>; 2],
    pub(super) look: Look,
    pub(super) rays: usize,
    pub(super) prior: [Prior; 2],
    pub(super) attribute_weight: f32,
    pub(super) moves: bool,
    pub(super) step: u64,
}

impl Lane {
    pub(super) fn begin(&mut self, model: &Brick) {
        self.head.fit(&model.head.field);
        if let Some(part) = &model.background {
            self.background.fit(&part.field);
        }
        let each = |grads: &mut Vec<TableGrad>, tables: &[Table]| {
            grads.resize_with(tables.len(), TableGrad::default);
            grads.iter_mut().zip(tables).for_each(|(g, t)| g.fit(t));
        };
        each(&mut self.residuals, &model.expression.residuals);
        each(&mut self.latent_bases, &model.latent_bases);
        self.masks.fit(&model.expression.masks);
        self.codes.fit(&model.codes);
        self.alphas.fit(&model.alphas);
        self.log_betas.fit(&model.log_betas);
        self.motions.fit(&model.motions);
        let slots = model.expression.lattice.slots;
        self.d_gates.resize(slots * BRICK * MASKS, 0.0);
        self.d_blend.resize(slots * BRICK * CHANNELS, 0.0);
        self.d_latent.resize(model.latent_lattice.slots * BRICK * 4, 0.0);
        for w in &mut self.weights {
            w.resize(PART_COUNT, 0.0);
        }
        self.numbers = Totals::default();
    }

    /// The rays of one image, forward and back.
    pub(super) fn image(&mut self, work: &Work<'_>, views: &impl Views, view: usize, slot: u64) {
        let (model, s) = (work.model, work.settings);
        let k = model.layout.region_of.len();
        let mut rng = rng_for(s.seed, work.step, 2 + slot);
        let annotated = views.attributes(view);
        let activations = activations(model, views, view, work.moves && s.latent);
        model.expression.blend(&work.gates, &activations, &mut self.blend);
        let code = &model.codes.values[view * LATENT..(view + 1) * LATENT];
        if work.moves && s.latent {
            model.latent_blend(code, &mut self.latent);
        }
        let latent = (work.moves && s.latent).then_some(self.latent.as_slice());
        let deformation = deformation(model, &self.blend, &work.gates, latent);
        let motion = &model.motions.values[view * 6..(view + 1) * 6];
        let motion = (work.moves && s.refine_cameras).then_some(motion);
        let origin = views.origin(view);
        let mut d_motion = [0.0f32; 6];
        let mut left_to_draw = work.rays;
        while left_to_draw > 0 {
            let count = left_to_draw.min(CHUNK);
            left_to_draw -= count;
            self.pixels.clear();
            views.draw(view, &mut rng, count, &mut self.pixels);
            if self.pixels.is_empty() {
                break;
            }
            let directions: Vec<[f32; 3]> = self.pixels.iter().map(|p| p.direction).collect();
            let behind: Vec<[f32; 3]> = self
                .pixels
                .iter()
                .map(|p| p.backdrop.unwrap_or_else(|| std::array::from_fn(|_| rng.random::<f32>())))
                .collect();
            self.rays.forward(model, &deformation, motion, origin, &directions, || rng.random::<f32>(), work.look);
            let (d_color, d_masks) =
                losses(&self.rays, &self.pixels, &behind, s.mask_weight, model.layout.regions, &mut self.numbers);
            self.rays.backward(
                model,
                &deformation,
                [work.transposed[0].as_ref(), work.transposed[1].as_ref()],
                work.look,
                &d_color,
                d_masks.as_deref(),
                &behind,
                work.prior,
                [&mut self.head, &mut self.background],
                &mut DeformationGrad {
                    blend: &mut self.d_blend,
                    gates: &mut self.d_gates,
                    latent: &mut self.d_latent,
                    motion: &mut d_motion,
                    moves: work.moves,
                },
            );
            self.rays.head.weigh(&mut self.weights[0]);
            self.rays.background.weigh(&mut self.weights[1]);
            let counts = self.rays.sample_counts();
            self.numbers.samples = [self.numbers.samples[0] + counts[0], self.numbers.samples[1] + counts[1]];
            self.numbers.rays += self.pixels.len();
        }
        let mut d_activations = vec![0.0; k + LATENT];
        model.expression.backward(&work.gates, &activations, &self.d_blend, &mut self.residuals, &mut d_activations);
        self.d_blend.fill(0.0);
        let scale = 3.0 * work.rays as f32;
        if annotated.is_some() {
            self.attributes(work, view, &d_activations[..k], scale);
        }
        if work.moves && s.latent {
            self.codes(work, view, code, &d_activations[k..], scale);
        }
        if motion.is_some() {
            let row = &mut self.motions.values[view * 6..(view + 1) * 6];
            row.iter_mut().zip(d_motion).for_each(|(a, b)| *a += b);
            self.motions.touched[view] = true;
        }
    }

    /// α and β of the image: what the pixels ask for against eq. 17.
    fn attributes(&mut self, work: &Work<'_>, view: usize, d_activations: &[f32], scale: f32) {
        let k = d_activations.len();
        let (deltas, logs) = (&work.model.alphas.values, &work.model.log_betas.values);
        for (i, d) in d_activations.iter().enumerate() {
            let at = view * k + i;
            // β has a floor, or a perfect AU would push it to 0 and the next spike to infinity.
            let log_beta = logs[at].max(LOG_BETA_FLOOR);
            let precise = (deltas[at] * (-log_beta).exp()).powi(2);
            let weight = work.attribute_weight * scale / k as f32;
            self.alphas.values[at] += d * 0.5 + weight * deltas[at] * (-2.0 * log_beta).exp();
            self.log_betas.values[at] += weight * (log_beta - precise);
            self.numbers.attribute += f64::from(0.5 * (precise + log_beta * log_beta));
        }
        self.numbers.annotated += k;
        self.alphas.touched[view] = true;
        self.log_betas.touched[view] = true;
    }

    /// ω of the image and the displacements it mixes.
    fn codes(&mut self, work: &Work<'_>, view: usize, code: &[f32], d_activations: &[f32], scale: f32) {
        for (j, (&c, basis)) in code.iter().zip(&work.model.latent_bases).enumerate() {
            let grad = &mut self.latent_bases[j];
            let mut d_code = d_activations[j] + 2.0 * work.settings.latent_weight * scale * c;
            for ((out, &d), &v) in grad.values.iter_mut().zip(&self.d_latent).zip(&basis.values) {
                *out += c * d;
                d_code += d * v;
            }
            grad.touched.fill(true);
            self.codes.values[view * LATENT + j] += d_code;
        }
        self.codes.touched[view] = true;
        self.d_latent.fill(0.0);
    }

    /// Marks every brick of the grids as touched, so that all are updated.
    pub(super) fn touch_all(&mut self) {
        let grids = self.head.features.iter_mut().chain(&mut self.background.features).chain(&mut self.residuals);
        grids.for_each(|g| g.touched.fill(true));
    }

    /// Passes the masks' gradients from the vertices' masks on to their logits.
    pub(super) fn end(&mut self, work: &Work<'_>) {
        let masks = &work.model.expression.masks;
        for (slot, (d, values)) in
            self.d_gates.chunks_exact_mut(BRICK * MASKS).zip(masks.values.chunks_exact(BRICK * MASKS)).enumerate()
        {
            if slot == 0 || d.iter().all(|&v| v == 0.0) {
                d.fill(0.0);
                continue;
            }
            let out = &mut self.masks.values[slot * BRICK * MASKS..(slot + 1) * BRICK * MASKS];
            for ((out, d), &logit) in out.iter_mut().zip(d.iter_mut()).zip(values) {
                // The soft mask's slope also where the hard one is 0: a mask may come back.
                let m = crate::math::sigmoid(logit);
                *out += *d * (m * (1.0 - m)).max(1e-3);
                *d = 0.0;
            }
            self.masks.touched[slot] = true;
        }
    }
}

/// ln 0.03
const LOG_BETA_FLOOR: f32 = -3.506_558;

/// Gradients of the colours and, where there are labels, of the masks.
fn losses(
    rays: &Rays,
    pixels: &[Pixel],
    behind: &[[f32; 3]],
    mask_weight: f32,
    regions: usize,
    totals: &mut Totals,
) -> (Vec<[f32; 3]>, Option<Vec<[f32; MASKS]>>) {
    let d_color = pixels
        .iter()
        .enumerate()
        .map(|(r, pixel)| {
            std::array::from_fn(|c| {
                let e = rays.color[r][c] + rays.left[r] * behind[r][c] - pixel.color[c];
                totals.color += f64::from(e * e);
                2.0 * e
            })
        })
        .collect();
    if pixels.iter().all(|p| p.label.is_none()) {
        return (d_color, None);
    }
    let d_masks = pixels
        .iter()
        .zip(&rays.masks)
        .map(|(pixel, masks)| {
            let mut d = [0.0; MASKS];
            if let Some(label) = pixel.label {
                for n in 0..regions {
                    let e = masks[n] - f32::from(u8::from(usize::from(label) == n + 1));
                    totals.mask += f64::from(e * e);
                    d[n] = 2.0 * mask_weight * e;
                }
                totals.masked += regions;
            }
            d
        })
        .collect();
    (d_color, Some(d_masks))
}
