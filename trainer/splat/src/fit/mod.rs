//! One step of a fit, and what it needs to know of those before it.
//!
//! A step looks at one training image: project, bin, rasterise with the loss and its gradient, then one pass over the
//! visible groups that goes back through projection and blending and moves them (Adam). The result depends on the seed and
//! the shares `done` that the caller gives, not on threads.

mod begin;
mod checkpoint;
mod densify;
mod fill;
mod images;
mod memberships;
mod pose;
mod settings;

use rand::seq::SliceRandom;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use risorius_formats::{Camera, Isometry};
use serde::{Deserialize, Serialize};

pub use self::begin::gate;
use self::images::ImageRates;
pub use self::images::PerImage;
pub(crate) use self::memberships::logistic;
pub use self::settings::Settings;
use crate::bin::{Bins, Line};
use crate::init::{self, Start};
use crate::model::{Gaussians, LANES, LATENT, Layout};
use crate::project::active_bases;
use crate::raster::{RowNumbers, Target, Tile, TrainRow};
use crate::scene::{Frame, Scene};
use crate::simd;
use crate::update::{Evidence, Moments, Rates, Update, Whole};
use crate::view::View;

/// Pixels of the smallest size that a fit begins at.
const COARSE_PIXELS: f32 = 32_400.0;

/// Early pictures say little about poses.
const POSES_FROM: f32 = 0.05;

/// What is behind a block that lets no more than this through takes no part in a step. More than where pictures are drawn: it
/// saves a tenth of the time at the same error.
const HIDDEN: f32 = 1e-2;

/// How far a fit is.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Steps done.
    pub step: u64,
    /// Densifications done.
    pub densified: u32,
    /// Steps in which each basis acted.
    pub basis_steps: Vec<u32>,
}

/// What a step measured.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct StepNumbers {
    /// Pixels compared.
    pub pixels: usize,
    /// Mean squared colour error.
    pub color: f64,
    /// Mean squared mask error; 0 in steps that fit no masks.
    pub mask: f64,
    /// Mean of eq. 17 over the annotated AUs.
    pub attribute: f64,
    /// Gaussians there are.
    pub gaussians: usize,
    /// Gaussians in the picture.
    pub visible: usize,
    /// Pairs of a Gaussian and a tile.
    pub pairs: usize,
    /// Gaussians whose gradient was not finite.
    pub not_finite: usize,
}

/// A fit in progress.
#[derive(Debug)]
pub struct Fitter {
    /// The avatar.
    pub model: Gaussians,
    /// What belongs to single images.
    pub images: PerImage,
    /// What decides the fit.
    pub settings: Settings,
    /// How far it is.
    pub progress: Progress,
    /// Head pose per frame before corrections.
    pub head_poses: Vec<Isometry>,
    base_moments: Moments,
    delta_moments: Moments,
    membership_moments: Moments,
    movement: Vec<f32>,
    work: Work,
}

/// What a step works in.
#[derive(Debug, Default)]
struct Work {
    bins: Bins,
    sums: Vec<Line>,
    tiles: Vec<Tile>,
    /// The images' order of this pass over them, and which pass it is.
    order: (u64, Vec<u32>),
    gaussians: usize,
    /// How far the scene's cameras are spread, metres; 0 before the first step.
    camera_spread: f32,
}

impl Fitter {
    /// Begins a fit; `say` is told what takes long. The scene is looked at by all threads of the pool.
    pub fn new(scene: &Scene<'_>, settings: Settings, say: &dyn Fn(&str)) -> Self {
        let [head, room] = settings.voxel_mm.map(|v| f64::from(v) * 1e-3);
        let standard = init::StereoSettings::default();
        let seeds = (settings.gaussians as f32 * settings.seed_share.clamp(0.05, 1.0)) as usize;
        let stereo = init::StereoSettings { head_voxel_m: head, room_voxel_m: room, seeds, ..standard };
        let start = init::start(scene, &init::StartSettings { stereo }, say);
        Self::from_start(scene, settings, start, say)
    }

    /// Begins a fit with given Gaussians.
    pub fn from_start(scene: &Scene<'_>, settings: Settings, start: Start, say: &dyn Fn(&str)) -> Self {
        let Start { mut seeds, motion, head_poses, mouth } = start;
        let layout = Layout {
            region_of: scene.region_of.clone(),
            also_in: scene.also_in.clone(),
            regions: scene.regions,
            latent: if settings.latent { LATENT } else { 0 },
            images: scene.frames.len(),
        };
        fill::fill(scene, &layout, &mut seeds, &head_poses);
        let mouth = if begin::thin_out(&mut seeds, settings.gaussians) { None } else { mouth };
        say(&format!("{} Gaussians to begin with", seeds.len()));
        let model = begin::model(layout, &seeds, motion.as_ref(), mouth.as_ref());
        let mut rng = rng_for(settings.seed, 0, 2);
        let images = PerImage::new(scene.frames.len(), scene.region_of.len(), &mut rng);
        Self::assemble(model, images, settings, Progress::default(), head_poses)
    }

    fn assemble(
        model: Gaussians,
        images: PerImage,
        settings: Settings,
        progress: Progress,
        head_poses: Vec<Isometry>,
    ) -> Self {
        Self {
            base_moments: Moments::zero(model.base.len()),
            delta_moments: Moments::zero(model.deltas.len()),
            membership_moments: Moments::zero(model.membership.len()),
            movement: vec![0.0; model.groups() * LANES],
            work: Work { gaussians: model.count(), ..Work::default() },
            model,
            images,
            settings,
            progress,
            head_poses,
        }
    }

    /// One step; `done` (0–1) is the share of the fit that lies behind, which sets rates, size and growth.
    pub fn step(&mut self, scene: &Scene<'_>, done: f32) -> StepNumbers {
        let done = done.clamp(0.0, 1.0);
        if densify::is_due(&self.settings, self.progress.densified, done) {
            self.densify();
            self.work.gaussians = self.model.count();
        }
        if self.work.camera_spread <= 0.0 {
            self.work.camera_spread = camera_spread(scene);
        }
        self.progress.step += 1;
        let step = self.progress.step;
        let image = self.draw_image(scene.frames.len());
        let mut rng = rng_for(self.settings.seed, step, 1);
        let coded = self.settings.latent && rng.random::<f32>() < self.settings.code_share;
        let frame = &scene.frames[image];
        let reduce = reduce_at(frame, self.settings.coarse_share, done);
        let room_from_head = self.room_from_head(frame, image);
        let camera = reduced(&frame.camera, reduce);
        let view = View::new(&camera, &room_from_head);
        let activations = self.activations(frame, image, coded);
        let active = active_bases(&self.model.layout, &activations, !self.settings.skips.untouched);
        self.work.bins.fill(&self.model, &view, &active, None);
        let target = Target {
            rgb: frame.rgb,
            // Before a plate the whole picture is explained: by Gaussians where it differs from the plate.
            valid: if scene.plate.is_some() { None } else { frame.valid },
            backdrop: scene.plate.as_ref().map(|p| p.rgb),
            width: frame.camera.intrinsics.width as usize,
            reduce: reduce as usize,
            gain: self.images.gain(image),
        };
        let opaque = if self.settings.skips.hidden { HIDDEN } else { 0.0 };
        let numbers = self.work.rasterise(&view, &target, opaque);
        self.progress.basis_steps.resize(self.model.layout.bases(), 0);
        for a in &active {
            self.progress.basis_steps[a.basis] += 1;
        }
        let correction: Vec<f32> =
            active.iter().map(|a| bias_correction(u64::from(self.progress.basis_steps[a.basis]))).collect();
        let corrects_poses = self.corrects_poses();
        let evidence = Evidence {
            view: &view,
            active: &active,
            bins: &self.work.bins,
            sums: &self.work.sums,
            rates: self.rates(scene, &view, done),
            base_correction: bias_correction(step),
            correction: &correction,
            poses: corrects_poses,
        };
        let whole = Update {
            model: &mut self.model,
            base: &mut self.base_moments,
            deltas: &mut self.delta_moments,
            movement: &mut self.movement,
        }
        .apply(&evidence);
        let attribute = self.step_image(frame, image, &active, &whole, coded, &numbers, done);
        if corrects_poses && done > POSES_FROM {
            let face_radius_m = f64::from(scene.face_radius_m);
            let look = pose::Look { camera: &camera, target: &target, face_radius_m, numbers: &numbers };
            self.images.step_pose(image, &look, &whole);
        }
        let mut out = StepNumbers {
            pixels: numbers.pixels,
            color: numbers.squared / (3 * numbers.pixels.max(1)) as f64,
            attribute,
            mask: 0.0,
            gaussians: self.work.gaussians,
            visible: self.work.bins.visible.len(),
            pairs: self.work.bins.slots.len(),
            not_finite: whole.not_finite,
        };
        if self.settings.mask_every > 0 && step.is_multiple_of(self.settings.mask_every) && frame.labels.is_some() {
            out.mask = self.fit_memberships(frame, &view, reduce as usize, done);
        }
        out
    }

    /// A random image, each once before any comes again.
    fn draw_image(&mut self, count: usize) -> usize {
        let (pass, at) = ((self.progress.step - 1) / count as u64, (self.progress.step - 1) % count as u64);
        let order = &mut self.work.order;
        if order.0 != pass || order.1.len() != count {
            let mut list: Vec<u32> = (0..count as u32).collect();
            list.shuffle(&mut rng_for(self.settings.seed, pass, 0));
            *order = (pass, list);
        }
        order.1[at as usize] as usize
    }

    /// The head's pose in an image, with its correction.
    fn room_from_head(&self, frame: &Frame<'_>, image: usize) -> Isometry {
        let head = self.head_poses.get(image).copied().unwrap_or(frame.room_from_head);
        self.images.head_motion(image).compose(&head)
    }

    /// Whether the head's poses are corrected: those of a head that sways came from landmarks.
    fn corrects_poses(&self) -> bool {
        self.settings.refine_poses && self.head_poses.iter().any(|p| *p != Isometry::IDENTITY)
    }

    /// Activations of an image: annotated ones with their offsets, then the code where it acts.
    fn activations(&self, frame: &Frame<'_>, image: usize, coded: bool) -> Vec<f32> {
        let aus = self.model.layout.region_of.len();
        let mut out = vec![0.0; self.model.layout.bases()];
        if let Some(annotated) = &frame.activations {
            let alphas = &self.images.alphas[image * aus..(image + 1) * aus];
            for ((out, a), alpha) in out.iter_mut().zip(annotated).zip(alphas) {
                *out = (a + 0.5 * alpha).max(0.0);
            }
        }
        if coded {
            out[aus..].copy_from_slice(&self.images.code(image)[..self.model.layout.latent]);
        }
        out
    }

    fn rates(&self, scene: &Scene<'_>, view: &View, done: f32) -> Rates {
        let s = &self.settings;
        let decay = s.final_rate.powf(done);
        let full = scene.frames[0].camera.intrinsics.fx as f32;
        Rates {
            // A pixel of the full size, whatever size the step is at.
            mean: s.mean_px / full.max(view.lens.focal[0]) * s.mean_final.powf(done),
            depth: s.depth_factor / self.work.camera_spread.max(0.02),
            delta: s.delta_factor,
            log_scale: s.log_scale_rate * decay,
            quaternion: s.quaternion_rate * decay,
            opacity: s.opacity_rate * decay,
            color: s.color_rate * decay,
            sh1: s.sh_rate * decay,
        }
    }

    #[allow(clippy::too_many_arguments, reason = "what a step knows of its image")]
    fn step_image(
        &mut self,
        frame: &Frame<'_>,
        image: usize,
        active: &[crate::project::Active],
        whole: &Whole,
        coded: bool,
        numbers: &RowNumbers,
        done: f32,
    ) -> f64 {
        let s = &self.settings;
        let aus = self.model.layout.region_of.len();
        let mut d = vec![0.0; self.model.layout.bases()];
        active.iter().zip(&whole.activations).for_each(|(a, &g)| d[a.basis] = g);
        let decay = s.final_rate.powf(done);
        let pixels = 3.0 * numbers.pixels as f32;
        let [first, last] = s.attribute_weight;
        let rates = ImageRates {
            image: s.image_rate * decay,
            code: s.code_rate * decay,
            attribute: first * (last / first.max(1e-12)).max(1e-6).powf(done) * pixels / aus.max(1) as f32,
            latent: s.latent_weight * pixels,
        };
        let codes = (coded && self.model.layout.latent > 0).then(|| &d[aus..]);
        let annotated = frame.activations.is_some().then(|| &d[..aus]);
        let eq17 = self.images.step(image, (annotated, codes), &rates);
        if s.refine_light {
            self.images.step_light(image, &numbers.light, numbers.pixels);
        }
        eq17 / aus.max(1) as f64
    }

    /// The avatar as it is to be saved.
    pub fn avatar(&self) -> Gaussians {
        self.model.clone()
    }
}

impl Work {
    /// Compositing, loss and sums of every entry, row of tiles by row of tiles.
    fn rasterise(&mut self, view: &View, target: &Target<'_>, opaque: f32) -> RowNumbers {
        let columns = view.columns();
        let rows = view.tiles() / columns.max(1);
        let bins = &self.bins;
        self.sums.resize(bins.slots.len(), Line::ZERO);
        self.tiles.resize_with(rows, Tile::default);
        let mut rest = self.sums.as_mut_slice();
        let mut work = Vec::with_capacity(rows);
        for (row, tile) in self.tiles.iter_mut().enumerate() {
            tile.opaque = opaque;
            let len = bins.entries((row + 1) * columns - 1).end - bins.entries(row * columns).start;
            let (own, more) = rest.split_at_mut(len);
            rest = more;
            work.push((row, own, tile));
        }
        let (width, height) = (view.width, view.height);
        let numbers: Vec<RowNumbers> = work
            .into_par_iter()
            .map(|(row, sums, tile)| simd::run(TrainRow { bins, target, row, columns, width, height, sums, tile }))
            .collect();
        numbers.iter().fold(RowNumbers::default(), RowNumbers::and)
    }
}

/// √(1 − β₂ᵗ)/(1 − β₁ᵗ)
fn bias_correction(t: u64) -> f32 {
    let t = t.clamp(1, 10_000) as i32;
    (1.0 - 0.99f32.powi(t)).sqrt() / (1.0 - 0.9f32.powi(t))
}

/// How many times smaller than its frame a step's picture is.
fn reduce_at(frame: &Frame<'_>, coarse_share: f32, done: f32) -> u32 {
    let i = &frame.camera.intrinsics;
    let pixels = (i.width * i.height) as f32;
    let levels = ((pixels / COARSE_PIXELS).sqrt().log2().round().max(0.0) as u32).min(4);
    // Each finer size takes as long as all before it together.
    (0..levels).find(|l| done < coarse_share * (1 << l) as f32).map_or(1, |l| 1 << (levels - l))
}

/// The camera of a picture of whole means of `reduce`² pixels; what is left over at the right and below is not looked at.
fn reduced(camera: &Camera, reduce: u32) -> Camera {
    if reduce == 1 {
        return *camera;
    }
    let mut out = camera.reduced(reduce);
    out.intrinsics.width = camera.intrinsics.width / reduce;
    out.intrinsics.height = camera.intrinsics.height / reduce;
    out
}

/// How far the cameras are spread about their middle, metres: twice the root of the mean square, sideways and up.
pub(crate) fn camera_spread(scene: &Scene<'_>) -> f32 {
    let n = scene.frames.len().max(1) as f64;
    let centers = || scene.frames.iter().map(|f| f.camera.center());
    let mean = centers().sum::<glam::DVec3>() / n;
    let square = centers().map(|c| (c - mean).length_squared()).sum::<f64>() / n;
    (2.0 * square.sqrt()) as f32
}

/// The random numbers of one purpose at one step.
fn rng_for(seed: u64, step: u64, purpose: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(step.wrapping_mul(1024).wrapping_add(purpose));
    rng
}
