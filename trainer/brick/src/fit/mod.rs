//! One step of a fit: draw rays, send them through the scene and back, update what was touched.
//!
//! Images are dealt to a fixed number of lanes, each with gradients of its own, merged in the order of the lanes: the
//! result depends on the seed and the number of lanes only.

mod lane;
mod own;
mod settings;

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use self::lane::{CHUNK, Image, Lane, Totals, Work};
use self::own::{Holds, Own};
pub use self::settings::Settings;
use crate::expression::Seen;
use crate::field::LAYERS;
use crate::model::{Brick, activation};
use crate::occupancy::PART_COUNT;
use crate::pages::{self, PageGrad};
use crate::rays::Look;
use crate::table::{Adam, Table, TableGrad};

/// Samples that go through the network together.
const BATCH: usize = 128;
/// A ray that lets less than this through is over: a quarter of a level of a byte.
const OPAQUE: f32 = 1e-3;

/// A pixel to fit.
#[derive(Clone, Copy, Debug, Default)]
pub struct Pixel {
    /// Unit direction of its ray, world axes.
    pub direction: [f32; 3],
    /// Its colour, 0–1.
    pub color: [f32; 3],
    /// What is behind everything there, where that is known.
    pub backdrop: Option<[f32; 3]>,
    /// Its region + 1, 0 for none; `None` where masks are not known.
    pub label: Option<u8>,
}

/// The training images.
pub trait Views: Sync {
    /// How many there are.
    fn count(&self) -> usize;
    /// Where the camera of a view stands, world units.
    fn origin(&self, view: usize) -> [f32; 3];
    /// Its annotated attributes, −1..1, where it has some.
    fn attributes(&self, view: usize) -> Option<&[f32]>;
    /// Draws `rays` pixels into `out`.
    fn draw(&self, view: usize, rng: &mut ChaCha8Rng, rays: usize, out: &mut Vec<Pixel>);
}

/// How far a fit is: all that a step needs to know of those before it, besides the model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Steps done.
    pub step: u64,
    /// 0 coarse … 4 fine.
    pub stage: usize,
    /// Steps since the stage began.
    pub stage_steps: u64,
    /// Samples per ray lately.
    pub samples_per_ray: f32,
}

impl Default for Progress {
    fn default() -> Self {
        Self { step: 0, stage: 0, stage_steps: 0, samples_per_ray: 160.0 }
    }
}

/// What a step measured.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct StepNumbers {
    /// Rays.
    pub rays: usize,
    /// Samples in the head and the background.
    pub samples: [usize; 2],
    /// Mean squared colour error.
    pub color: f64,
    /// Mean squared mask error over rays with masks.
    pub mask: f64,
    /// Mean of eq. 17 over the annotated AUs.
    pub attribute: f64,
}

/// Stages: divisions and planes as a share of the finest, levels, samples per ray that end it, steps that end it.
const STAGES: [(f32, usize, f32, u64); 5] =
    [(0.15, 3, 14.0, 420), (0.25, 3, 14.0, 200), (0.40, 4, 16.0, 200), (0.60, 5, 20.0, 250), (1.00, 6, 0.0, u64::MAX)];

/// The stage in which a fit ends.
pub const LAST_STAGE: usize = STAGES.len() - 1;

/// A fit in progress.
#[derive(Debug)]
pub struct Fitter {
    /// The avatar.
    pub model: Brick,
    /// What decides the fit.
    pub settings: Settings,
    /// How far it is.
    pub progress: Progress,
    lanes: Vec<Lane>,
    own: Own,
}

impl Fitter {
    /// A fit that goes on from `progress`, with a lane per thread of the pool.
    pub fn new(model: Brick, settings: Settings, progress: Progress) -> Self {
        let lanes = rayon::current_num_threads().clamp(1, settings.images);
        let lanes = (0..lanes).map(|_| Lane::default()).collect();
        Self { model, settings, progress, lanes, own: Own::default() }
    }

    /// One step; `done` is the share of the fit that lies behind, which sets the learning rate.
    pub fn step(&mut self, views: &impl Views, done: f32) -> StepNumbers {
        self.begin_step();
        let step = self.progress.step;
        let s = &self.settings;
        let mut rng = rng_for(s.seed, step, 0);
        let images: Vec<usize> = (0..s.images).map(|_| rng.random_range(0..views.count())).collect();
        let warm = (step as f32 / 100.0).min(1.0);
        let rate = warm * s.final_rate.powf(done.clamp(0.0, 1.0));
        let per_image = s.samples as f32 / s.images as f32 / self.progress.samples_per_ray.max(1.0);
        let rays = (per_image as usize).clamp(CHUNK, 2048) / CHUNK * CHUNK;
        let work = Work {
            model: &self.model,
            settings: s,
            gates: self.model.expression.gates(),
            transposed: [
                Some(self.model.head.field.transposed()),
                self.model.background.as_ref().map(|p| p.field.transposed()),
            ],
            look: self.look(),
            rays,
            prior: s.prior(self.progress.stage),
            moves: self.progress.stage >= 2 && (s.latent || s.refine_cameras),
            step,
        };
        let lane_count = self.lanes.len();
        self.lanes.par_iter_mut().enumerate().for_each(|(lane_index, lane)| {
            let mine: Vec<(u64, usize)> =
                (0u64..).zip(images.iter().copied()).skip(lane_index).step_by(lane_count).collect();
            lane.run(&work, views, &mine);
        });
        let Work { gates, moves, .. } = work;
        let holds = Holds {
            attribute_weight: s.attribute_weight[0]
                * (s.attribute_weight[1] / s.attribute_weight[0].max(1e-12)).max(1e-6).powf(done.clamp(0.0, 1.0)),
            latent_weight: (moves && s.latent).then_some(s.latent_weight),
            cameras: moves && s.refine_cameras,
            scale: 3.0 * rays as f32,
        };
        self.learn_expression(&gates, rate, images.len(), holds);
        self.update(rate, moves);
        self.update_occupancy(views);
        self.finish_step()
    }

    /// Updates what AUs do, and gathers what the images say of themselves.
    fn learn_expression(&mut self, gates: &[f32], rate: f32, count: usize, holds: Holds) {
        let Self { model, settings: s, lanes, own, .. } = self;
        let images: Vec<&Image> = (0..count).map(|i| &lanes[i % lanes.len()].images[i / lanes.len()]).collect();
        let seen: Vec<Seen<'_>> =
            images.iter().map(|i| Seen { activations: &i.activations, d_blend: &i.d_blend }).collect();
        let (g, w) = (s.residual_rate * rate, s.warp_rate * rate);
        let adam = Adam { rates: [g, g, g, g, w, w, w, g], ..Adam::new(g) };
        let d_activations = model.expression.learn(gates, &seen, &adam);
        own.gather(model, &images, &d_activations, holds);
    }

    /// The largest weight per part of head and background since occupancy was last decided; a checkpoint needs them.
    pub fn pending_weights(&mut self) -> [Vec<f32>; 2] {
        let mut merged = [vec![0.0f32; PART_COUNT], vec![0.0f32; PART_COUNT]];
        for lane in &self.lanes {
            for (sum, own) in merged.iter_mut().zip(&lane.weights) {
                sum.iter_mut().zip(own).for_each(|(a, b)| *a = a.max(*b));
            }
        }
        merged
    }

    /// Puts back what [`Self::pending_weights`] gave.
    pub fn set_pending_weights(&mut self, weights: &[Vec<f32>]) {
        if let Some(lane) = self.lanes.first_mut() {
            lane.weights.iter_mut().zip(weights).for_each(|(own, read)| own.clone_from(read));
        }
    }

    /// How rays look at the scene at this stage.
    fn look(&self) -> Look {
        let share = if self.settings.skips.coarse_first { STAGES[self.progress.stage].0 } else { 1.0 };
        let of = |n: usize| ((n as f32 * share) as usize).max(16);
        let settled = self.settings.settled_planes.min(self.settings.finest[1]).max(16);
        Look {
            divisions: of(self.settings.finest[0]),
            planes: if self.progress.stage == LAST_STAGE { settled } else { of(self.settings.finest[1]) },
            opaque: if self.settings.skips.hidden { OPAQUE } else { 0.0 },
            batch: BATCH,
            faint: None,
            tells_acts: false,
            everywhere: false,
        }
    }

    fn begin_step(&mut self) {
        let Self { model, progress, settings, .. } = self;
        progress.step += 1;
        progress.stage_steps += 1;
        let (_, _, sparse_enough, at_most) = STAGES[progress.stage];
        let settled = progress.samples_per_ray < sparse_enough && progress.stage_steps > 60;
        if progress.step > 200 && progress.stage + 1 < STAGES.len() && (settled || progress.stage_steps > at_most) {
            progress.stage += 1;
            progress.stage_steps = 0;
        }
        let mut live = if progress.step < 110 { 2 } else { STAGES[progress.stage].1 };
        if live == 6 && progress.stage_steps < 1500 {
            live = 5;
        }
        if !settings.skips.coarse_first {
            live = crate::field::LEVELS;
        }
        let mut rng = rng_for(settings.seed, progress.step, 1);
        for part in [Some(&mut model.head), model.background.as_mut()].into_iter().flatten() {
            let live = live.min(part.field.levels.len());
            if live != part.field.live || progress.step % 64 == 0 {
                part.field.live = live;
                crate::cull::allocate(part, &mut rng);
            }
            if progress.step == 96 {
                // What was seen while everything was fog says nothing.
                part.occupancy.density.fill(0.0);
            }
        }
        let look = self.look();
        self.model.divisions = look.divisions;
        self.model.planes = look.planes;
    }

    fn update(&mut self, rate: f32, moves: bool) {
        let Self { model, settings: s, lanes, own, .. } = self;
        let grid = Adam::new(s.grid_rate * rate);
        let net = Adam { epsilon: 1e-10, ..Adam::new(s.net_rate * rate) };
        let warp = s.warp_rate * rate;
        let image = Adam { epsilon: 1e-8, ..Adam::new(s.image_rate * rate) };
        let motion = Adam { epsilon: 1e-8, ..Adam::new(s.image_rate * rate * 0.2) };
        let mut jobs: Vec<(&mut Table, Vec<&mut TableGrad>, Adam, usize)> = Vec::new();
        let mut levels: Vec<(&mut Table, Vec<&PageGrad>, usize)> = Vec::new();
        // The same gradient of every lane: merged in the order of the lanes.
        let (mut features, mut nets, mut masks) = ([Vec::new(), Vec::new()], [Vec::new(), Vec::new()], Vec::new());
        for lane in lanes {
            for (part, grad) in [&mut lane.head, &mut lane.background].into_iter().enumerate() {
                features[part].push(&grad.features);
                nets[part].push(&mut grad.net);
            }
            masks.push(&mut lane.masks);
        }
        let Brick { head, background, expression, latent_bases, codes, alphas, log_betas, motions, .. } = model;
        let parts = [Some(head), background.as_mut()].into_iter().flatten();
        for (part, (features, nets)) in parts.zip(features.into_iter().zip(nets)) {
            for (l, (table, level)) in part.field.features.iter_mut().zip(&part.field.levels).enumerate() {
                let grads = features.iter().map(|lane| &lane[l]).collect();
                levels.push((table, grads, LAYERS * usize::from(level.sparse)));
            }
            jobs.push((&mut part.field.net, nets, net, 0));
        }
        jobs.push((&mut expression.masks, masks, Adam::new(0.05 * rate), 1));
        if moves {
            for (table, grad) in latent_bases.iter_mut().zip(&mut own.latent_bases) {
                jobs.push((table, vec![grad], Adam::new(warp), 0));
            }
            let code = Adam { rates: [10.0 * image.rates[0]; 8], ..image };
            jobs.push((codes, vec![&mut own.codes], code, 0));
            jobs.push((motions, vec![&mut own.motions], motion, 0));
        }
        jobs.push((alphas, vec![&mut own.alphas], image, 0));
        jobs.push((log_betas, vec![&mut own.log_betas], image, 0));
        rayon::join(
            || levels.into_par_iter().for_each(|(table, grads, from)| pages::step(table, &grads, &grid, from)),
            || jobs.into_par_iter().for_each(|(table, mut grads, adam, from)| table.step(&mut grads, &adam, from)),
        );
        let [share, warp_share] = self.settings.smooth;
        if self.progress.step.is_multiple_of(16) && share.max(warp_share) > 0.0 {
            // Less and less: towards the end the pixels decide.
            self.model.expression.smooth(share * rate, warp_share * rate);
        }
        if moves && self.settings.refine_cameras {
            center(&mut self.model.motions);
        }
    }

    fn update_occupancy(&mut self, views: &impl Views) {
        let Progress { step, stage, .. } = self.progress;
        if !self.settings.skips.empty_space
            || step <= 96
            || !(step.is_multiple_of(crate::cull::EVERY) || (step < 400 && step.is_multiple_of(8)))
        {
            return;
        }
        let mut weights = [vec![0.0f32; PART_COUNT], vec![0.0f32; PART_COUNT]];
        for lane in &mut self.lanes {
            for (sum, own) in weights.iter_mut().zip(&mut lane.weights) {
                for (a, b) in sum.iter_mut().zip(own.iter_mut()) {
                    *a = a.max(*b);
                    *b = 0.0;
                }
            }
        }
        crate::cull::update(&mut self.model, views, self.settings.seed, step, stage, &weights);
    }

    fn finish_step(&mut self) -> StepNumbers {
        let mut t = Totals::default();
        for lane in &self.lanes {
            let n = lane.numbers;
            t.rays += n.rays;
            t.samples = [t.samples[0] + n.samples[0], t.samples[1] + n.samples[1]];
            t.color += n.color;
            t.mask += n.mask;
            t.masked += n.masked;
        }
        self.progress.samples_per_ray = (t.samples[0] + t.samples[1]) as f32 / t.rays.max(1) as f32;
        StepNumbers {
            rays: t.rays,
            samples: t.samples,
            color: t.color / (3 * t.rays.max(1)) as f64,
            mask: t.mask / t.masked.max(1) as f64,
            attribute: self.own.attribute.0 / self.own.attribute.1.max(1) as f64,
        }
    }
}

/// Activations of an image's AUs, then the numbers of its latent code (0 while these are not learned).
pub(crate) fn activations(model: &Brick, views: &impl Views, view: usize, latent: bool) -> Vec<f32> {
    let k = model.layout.region_of.len();
    let deltas = &model.alphas.values[view * k..(view + 1) * k];
    let mut out: Vec<f32> = match views.attributes(view) {
        Some(a) => a.iter().zip(deltas).map(|(&a, &d)| activation(a + d)).collect(),
        None => vec![0.0; k],
    };
    out.extend(model.code(view).iter().map(|&c| if latent { c } else { 0.0 }));
    out
}

/// The random numbers of one purpose at one step.
pub(crate) fn rng_for(seed: u64, step: u64, purpose: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(step.wrapping_mul(1024).wrapping_add(purpose));
    rng
}

/// Takes the mean out of a table of rows: turning every camera alike is no refinement.
fn center(table: &mut Table) {
    let (rows, n) = (table.blocks().max(1) as f32, table.block);
    let mut mean = vec![0.0; n];
    for row in table.values.chunks_exact(n) {
        for (m, v) in mean.iter_mut().zip(row) {
            *m += v / rows;
        }
    }
    for row in table.values.chunks_exact_mut(n) {
        for (v, m) in row.iter_mut().zip(&mean) {
            *v -= m;
        }
    }
}

#[cfg(test)]
mod tests;
