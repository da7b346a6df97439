//! One step of a fit: draw rays, send them through the scene and back, update what was touched.
//!
//! Images are dealt to a fixed number of lanes, each with gradients of its own, merged in the order of the lanes: the
//! result depends on the seed and the number of lanes only.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::evaluate::DeformationGrad;
use crate::expression::{CHANNELS, MASKS};
use crate::field::{FieldGrad, Transposed};
use crate::lattice::BRICK;
use crate::model::{Brick, LATENT, activation, deformation};
use crate::occupancy::PART_COUNT;
use crate::rays::{Look, Prior, Rays};
use crate::skips::Skips;
use crate::table::{Adam, Table, TableGrad};

/// Rays that travel together: their samples' activations stay in the cache.
const CHUNK: usize = 64;

/// Samples that a ray takes at a time.
const WAVE: usize = 8;

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

/// What decides a fit, besides the data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// Seed of every random draw.
    pub seed: u64,
    /// Images per step.
    pub images: usize,
    /// Samples per step that the number of rays aims at.
    pub samples: usize,
    /// Learning rate of the grids.
    pub grid_rate: f32,
    /// Learning rate of the AUs' features.
    pub residual_rate: f32,
    /// Learning rate of displacements.
    pub warp_rate: f32,
    /// Learning rate of the networks.
    pub net_rate: f32,
    /// Learning rate of what belongs to single images.
    pub image_rate: f32,
    /// Share of the learning rates that is left at the end.
    pub final_rate: f32,
    /// Weight against haze in the head, before and after the last stage begins.
    pub haze: [f32; 2],
    /// Weight of the spread of weights along a ray, head and background, from the second stage on.
    pub spread: [f32; 2],
    /// How far the AUs' features and displacements move towards their neighbours' mean every 16 steps.
    pub smooth: [f32; 2],
    /// Weight of the masks.
    pub mask_weight: f32,
    /// Weight of eq. 17, first and last.
    pub attribute_weight: [f32; 2],
    /// Weight of ‖ω‖².
    pub latent_weight: f32,
    /// Whether each image has a displacement of its own.
    pub latent: bool,
    /// Whether each camera may move a little.
    pub refine_cameras: bool,
    /// Finest divisions of the head box and planes of the background.
    pub finest: [usize; 2],
    /// What is left out.
    pub skips: Skips,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            seed: 0,
            images: 8,
            samples: 64_000,
            grid_rate: 1e-2,
            residual_rate: 2e-2,
            warp_rate: 3e-3,
            net_rate: 3e-3,
            image_rate: 1e-3,
            final_rate: 0.04,
            haze: [1e-5, 0.0],
            spread: [0.06, 0.02],
            smooth: [0.2, 0.4],
            mask_weight: 0.01,
            attribute_weight: [0.1, 0.01],
            latent_weight: 1e-4,
            latent: true,
            refine_cameras: false,
            finest: [160, 160],
            skips: Skips::default(),
        }
    }
}

impl Settings {
    fn prior(&self, stage: usize) -> [Prior; 2] {
        let haze = self.haze[usize::from(stage >= 3)];
        let spread = if stage >= 1 { self.spread } else { [0.0; 2] };
        [Prior { haze, spread: spread[0] }, Prior { haze: haze * 0.2, spread: spread[1] }]
    }
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

/// One thread's gradients and scratch.
#[derive(Debug, Default)]
struct Lane {
    head: FieldGrad,
    background: FieldGrad,
    residuals: Vec<TableGrad>,
    masks: TableGrad,
    latent_bases: Vec<TableGrad>,
    codes: TableGrad,
    alphas: TableGrad,
    log_betas: TableGrad,
    motions: TableGrad,
    /// Gradients of the masks at the vertices.
    d_gates: Vec<f32>,
    blend: Vec<f32>,
    d_blend: Vec<f32>,
    latent: Vec<f32>,
    d_latent: Vec<f32>,
    weights: [Vec<f32>; 2],
    rays: Rays,
    pixels: Vec<Pixel>,
    numbers: Totals,
}

#[derive(Clone, Copy, Debug, Default)]
struct Totals {
    rays: usize,
    samples: [usize; 2],
    color: f64,
    mask: f64,
    masked: usize,
    attribute: f64,
    annotated: usize,
}

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
}

impl Fitter {
    /// A fit that goes on from `progress`, with a lane per thread of the pool.
    pub fn new(model: Brick, settings: Settings, progress: Progress) -> Self {
        let lanes = rayon::current_num_threads().clamp(1, settings.images);
        Self { model, settings, progress, lanes: (0..lanes).map(|_| Lane::default()).collect() }
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
            attribute_weight: s.attribute_weight[0]
                * (s.attribute_weight[1] / s.attribute_weight[0].max(1e-12)).max(1e-6).powf(done.clamp(0.0, 1.0)),
            moves: self.progress.stage >= 2 && (s.latent || s.refine_cameras),
            step,
        };
        let lane_count = self.lanes.len();
        self.lanes.par_iter_mut().enumerate().for_each(|(lane_index, lane)| {
            lane.begin(&self.model);
            for (i, &view) in images.iter().enumerate() {
                if i % lane_count == lane_index {
                    lane.image(&work, views, view, i as u64);
                }
            }
            lane.end(&work);
            if !work.settings.skips.untouched {
                lane.touch_all();
            }
        });
        let moves = work.moves;
        drop(work);
        self.update(rate, moves);
        self.update_occupancy(views);
        self.finish_step()
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
        Look {
            divisions: of(self.settings.finest[0]),
            planes: of(self.settings.finest[1]),
            opaque: if self.settings.skips.hidden { 1e-4 } else { 0.0 },
            wave: WAVE,
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
        let Self { model, settings: s, lanes, .. } = self;
        let grid = Adam::new(s.grid_rate * rate);
        let net = Adam { epsilon: 1e-10, ..Adam::new(s.net_rate * rate) };
        let warp = s.warp_rate * rate;
        let (g, w) = (s.residual_rate * rate, warp);
        let residual = Adam { rates: [g, g, g, g, w, w, w, g], ..grid };
        let image = Adam { epsilon: 1e-8, ..Adam::new(s.image_rate * rate) };
        let motion = Adam { epsilon: 1e-8, ..Adam::new(s.image_rate * rate * 0.2) };
        let mut jobs: Vec<(&mut Table, Vec<&mut TableGrad>, Adam, usize)> = Vec::new();
        let mut columns = Columns::new(lanes);
        let Brick { head, background, expression, latent_bases, codes, alphas, log_betas, motions, .. } = model;
        for (l, (table, level)) in head.field.features.iter_mut().zip(&head.field.levels).enumerate() {
            jobs.push((table, columns.take(|c| &mut c.head[l]), grid, usize::from(level.sparse)));
        }
        jobs.push((&mut head.field.net, columns.take(|c| &mut c.head_net), net, 0));
        if let Some(part) = background {
            for (l, (table, level)) in part.field.features.iter_mut().zip(&part.field.levels).enumerate() {
                jobs.push((table, columns.take(|c| &mut c.background[l]), grid, usize::from(level.sparse)));
            }
            jobs.push((&mut part.field.net, columns.take(|c| &mut c.background_net), net, 0));
        }
        for (k, table) in expression.residuals.iter_mut().enumerate() {
            jobs.push((table, columns.take(|c| &mut c.residuals[k]), residual, 0));
        }
        jobs.push((&mut expression.masks, columns.take(|c| &mut c.masks), Adam::new(0.05 * rate), 1));
        if moves {
            for (j, table) in latent_bases.iter_mut().enumerate() {
                jobs.push((table, columns.take(|c| &mut c.latent_bases[j]), Adam::new(warp), 0));
            }
            let code = Adam { rates: [10.0 * image.rates[0]; 8], ..image };
            jobs.push((codes, columns.take(|c| &mut c.codes), code, 0));
            jobs.push((motions, columns.take(|c| &mut c.motions), motion, 0));
        }
        jobs.push((alphas, columns.take(|c| &mut c.alphas), image, 0));
        jobs.push((log_betas, columns.take(|c| &mut c.log_betas), image, 0));
        jobs.into_par_iter().for_each(|(table, mut grads, adam, from)| table.step(&mut grads, &adam, from));
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
            t.attribute += n.attribute;
            t.annotated += n.annotated;
        }
        self.progress.samples_per_ray = (t.samples[0] + t.samples[1]) as f32 / t.rays.max(1) as f32;
        StepNumbers {
            rays: t.rays,
            samples: t.samples,
            color: t.color / (3 * t.rays.max(1)) as f64,
            mask: t.mask / t.masked.max(1) as f64,
            attribute: t.attribute / t.annotated.max(1) as f64,
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
    out.extend(model.codes.values[view * LATENT..(view + 1) * LATENT].iter().map(|&c| if latent { c } else { 0.0 }));
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

/// The same gradient of every lane, column by column.
struct Columns<'a> {
    lanes: Vec<LaneColumns<'a>>,
}

struct LaneColumns<'a> {
    head: Vec<Option<&'a mut TableGrad>>,
    head_net: Option<&'a mut TableGrad>,
    background: Vec<Option<&'a mut TableGrad>>,
    background_net: Option<&'a mut TableGrad>,
    residuals: Vec<Option<&'a mut TableGrad>>,
    masks: Option<&'a mut TableGrad>,
    latent_bases: Vec<Option<&'a mut TableGrad>>,
    codes: Option<&'a mut TableGrad>,
    alphas: Option<&'a mut TableGrad>,
    log_betas: Option<&'a mut TableGrad>,
    motions: Option<&'a mut TableGrad>,
}

impl<'a> Columns<'a> {
    fn new(lanes: &'a mut [Lane]) -> Self {
        let lanes = lanes
            .iter_mut()
            .map(|l| LaneColumns {
                head: l.head.features.iter_mut().map(Some).collect(),
                head_net: Some(&mut l.head.net),
                background: l.background.features.iter_mut().map(Some).collect(),
                background_net: Some(&mut l.background.net),
                residuals: l.residuals.iter_mut().map(Some).collect(),
                masks: Some(&mut l.masks),
                latent_bases: l.latent_bases.iter_mut().map(Some).collect(),
                codes: Some(&mut l.codes),
                alphas: Some(&mut l.alphas),
                log_betas: Some(&mut l.log_betas),
                motions: Some(&mut l.motions),
            })
            .collect();
        Self { lanes }
    }

    fn take(
        &mut self,
        which: impl for<'c> Fn(&'c mut LaneColumns<'a>) -> &'c mut Option<&'a mut TableGrad>,
    ) -> Vec<&'a mut TableGrad> {
        self.lanes.iter_mut().filter_map(|lane| which(lane).take()).collect()
    }
}

/// What every lane reads.
struct Work<'a> {
    model: &'a Brick,
    settings: &'a Settings,
    gates: Vec<f32>,
    transposed: [Option<Transposed>; 2],
    look: Look,
    rays: usize,
    prior: [Prior; 2],
    attribute_weight: f32,
    moves: bool,
    step: u64,
}

impl Lane {
    fn begin(&mut self, model: &Brick) {
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
    fn image(&mut self, work: &Work<'_>, views: &impl Views, view: usize, slot: u64) {
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
    fn touch_all(&mut self) {
        let grids = self.head.features.iter_mut().chain(&mut self.background.features).chain(&mut self.residuals);
        grids.for_each(|g| g.touched.fill(true));
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

#[cfg(test)]
#[path = "fit_tests.rs"]
mod tests;
