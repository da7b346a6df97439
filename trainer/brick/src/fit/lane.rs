//! One thread's share of a step: the rays of its images, forward and back.

use rand::Rng;

use super::{Pixel, Settings, Views, activations, rng_for};
use crate::evaluate::{DeformationGrad, Lot};
use crate::expression::{BlendGrad, CHANNELS, MASKS};
use crate::field::{FieldGrad, Transposed};
use crate::lattice::BRICK;
use crate::model::{Brick, deformation};
use crate::occupancy::PART_COUNT;
use crate::pages::PageGrad;
use crate::rays::{Look, Prior, Rays, Upstream};
use crate::table::TableGrad;

/// Rays that travel together: their samples' activations stay in the cache.
pub(super) const CHUNK: usize = 128;

/// One thread's gradients and scratch.
#[derive(Debug, Default)]
pub(super) struct Lane {
    pub(super) head: FieldGrad,
    pub(super) background: FieldGrad,
    pub(super) masks: TableGrad,
    /// Its images of the step.
    pub(super) images: Vec<Image>,
    /// Gradients of the masks at the vertices.
    d_gates: Vec<f32>,
    pub(super) weights: [Vec<f32>; 2],
    pub(super) rays: Rays,
    pixels: Vec<Pixel>,
    pub(super) numbers: Totals,
}

/// An image of the step: its expression, and what its rays say of it.
#[derive(Debug, Default)]
pub(super) struct Image {
    pub(super) view: usize,
    pub(super) annotated: bool,
    /// Whether its latent code acts in this step.
    pub(super) coded: bool,
    pub(super) activations: Vec<f32>,
    blend: Vec<f32>,
    pub(super) d_blend: BlendGrad,
    latent: Vec<f32>,
    pub(super) d_latent: Vec<f32>,
    pub(super) d_motion: [f32; 6],
}

#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Totals {
    pub(super) rays: usize,
    pub(super) samples: [usize; 2],
    pub(super) color: f64,
    pub(super) mask: f64,
    pub(super) masked: usize,
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
    pub(super) moves: bool,
    pub(super) step: u64,
}

impl Image {
    fn begin(&mut self, work: &Work<'_>, views: &impl Views, number: u64, view: usize) {
        let model = work.model;
        self.view = view;
        self.coded = work.learns_codes() && work.settings.is_coded(number);
        self.annotated = views.attributes(view).is_some();
        self.activations = activations(model, views, view, self.coded);
        let numbers = model.expression.lattice.slots * BRICK * CHANNELS;
        // Written whole, brick by brick.
        self.blend.resize(numbers, 0.0);
        self.d_blend.fit(model.expression.lattice.slots);
        self.d_latent.clear();
        self.d_latent.resize(model.latent_lattice.slots * BRICK * 4, 0.0);
        if self.coded {
            model.latent_blend(model.code(view), &mut self.latent);
        }
        self.d_motion = [0.0; 6];
    }
}

impl Work<'_> {
    fn learns_codes(&self) -> bool {
        self.moves && self.settings.latent
    }
}

impl Lane {
    fn begin(&mut self, model: &Brick) {
        self.head.fit(&model.head.field);
        if let Some(part) = &model.background {
            self.background.fit(&part.field);
        }
        self.masks.fit(&model.expression.masks);
        self.d_gates.resize(model.expression.lattice.slots * BRICK * MASKS, 0.0);
        for w in &mut self.weights {
            w.resize(PART_COUNT, 0.0);
        }
        self.numbers = Totals::default();
    }

    /// Sends the rays of `mine` (number in the step and view) forward and back.
    pub(super) fn run(&mut self, work: &Work<'_>, views: &impl Views, mine: &[(u64, usize)]) {
        self.begin(work.model);
        let mut images = std::mem::take(&mut self.images);
        images.resize_with(mine.len(), Image::default);
        for (image, &(number, view)) in images.iter_mut().zip(mine) {
            image.begin(work, views, number, view);
        }
        // Brick by brick for all images: a brick's residuals stay in the cache.
        let expression = &work.model.expression;
        for slot in 0..expression.lattice.slots {
            for image in &mut images {
                let out = &mut image.blend[slot * BRICK * CHANNELS..(slot + 1) * BRICK * CHANNELS];
                expression.blend_slot(&work.gates, &image.activations, slot, out);
            }
        }
        for (image, &(number, _)) in images.iter_mut().zip(mine) {
            self.image(work, views, image, number);
        }
        self.images = images;
        self.end(work);
        if !work.settings.skips.untouched {
            self.touch_all();
        }
    }

    /// The rays of one image, forward and back.
    fn image(&mut self, work: &Work<'_>, views: &impl Views, image: &mut Image, number: u64) {
        let (model, s, view) = (work.model, work.settings, image.view);
        let mut rng = rng_for(s.seed, work.step, 2 + number);
        let Image { blend, d_blend, latent, d_latent, d_motion, coded, .. } = image;
        let latent = coded.then_some(latent.as_slice());
        let deformation = deformation(model, blend, &work.gates, latent);
        let motion = &model.motions.values[view * 6..(view + 1) * 6];
        let motion = (work.moves && s.refine_cameras).then_some(motion);
        let origin = views.origin(view);
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
            let d_left: Vec<f32> =
                d_color.iter().zip(&behind).map(|(d, behind)| crate::math::dot(*d, *behind)).collect();
            self.rays.backward(
                model,
                &deformation,
                [work.transposed[0].as_ref(), work.transposed[1].as_ref()],
                work.look,
                Upstream { color: &d_color, left: &d_left, masks: d_masks.as_deref(), depth: None, regular: None },
                work.prior,
                Lot { below: if s.skips.faint { s.faint } else { 0.0 }, ticket: rng.random() },
                [&mut self.head, &mut self.background],
                &mut DeformationGrad {
                    blend: d_blend,
                    gates: &mut self.d_gates,
                    latent: d_latent,
                    motion: d_motion,
                    moves: work.moves,
                },
            );
            self.rays.head.weigh(&mut self.weights[0]);
            self.rays.background.weigh(&mut self.weights[1]);
            let counts = self.rays.sample_counts();
            self.numbers.samples = [self.numbers.samples[0] + counts[0], self.numbers.samples[1] + counts[1]];
            self.numbers.rays += self.pixels.len();
        }
    }

    /// Marks every brick of the grids as touched, so that all are updated.
    fn touch_all(&mut self) {
        let grids = self.head.features.iter_mut().chain(&mut self.background.features);
        grids.for_each(PageGrad::touch_all);
    }

    /// Passes the masks' gradients from the vertices' masks on to their logits.
    fn end(&mut self, work: &Work<'_>) {
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
                *out += *d * crate::expression::gate_slope(logit);
                *d = 0.0;
            }
            self.masks.touched[slot] = true;
        }
    }
}

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
