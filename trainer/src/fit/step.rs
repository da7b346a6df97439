//! One step: both levels of one batch of rays, and their losses (fact sheet §1.12, §2).

use std::ops::{AddAssign, Range};

use burn::optim::{GradientsAccumulator, GradientsParams};
use burn::tensor::{Device, Int, Tensor, TensorData};
use glam::Vec3;
use rand_chacha::ChaCha8Rng;

use crate::batch::{self, Draw, RayBatch};
use crate::config::{AttributeSource, FitSettings, MaskRendering};
use crate::data::TrainData;
use crate::error::{Result, TrainerError};
use crate::loss::{self, Counts, LossTerms};
use crate::model::{ConfiesModel, FieldOutputs, Level, RayCodes, Uncertain, Windows};
use crate::sampling;
use crate::space::NetSpace;
use crate::volume;

/// The unweighted terms of a step as numbers.
#[derive(Clone, Copy, Debug, Default)]
pub struct StepNumbers {
    /// L_recon of the coarse level.
    pub reconstruction_coarse: f64,
    /// L_recon of the fine level.
    pub reconstruction_fine: f64,
    /// L_mask, both levels.
    pub mask: f64,
    /// L_attr, both levels; 0 where it is skipped.
    pub attribute: f64,
    /// L_lat.
    pub latent: f64,
}

impl AddAssign for StepNumbers {
    fn add_assign(&mut self, part: Self) {
        self.reconstruction_coarse += part.reconstruction_coarse;
        self.reconstruction_fine += part.reconstruction_fine;
        self.mask += part.mask;
        self.attribute += part.attribute;
        self.latent += part.latent;
    }
}

impl StepNumbers {
    /// Fails when a term is not a finite number, naming it.
    pub fn check_finite(&self, step: u64) -> Result<()> {
        let Self { reconstruction_coarse, reconstruction_fine, mask, attribute, latent } = *self;
        for (what, value) in [
            ("the reconstruction loss of the coarse level", reconstruction_coarse),
            ("the reconstruction loss", reconstruction_fine),
            ("the mask loss", mask),
            ("the attribute loss", attribute),
            ("the latent prior", latent),
        ] {
            if !value.is_finite() {
                return Err(TrainerError::NotFinite { step, what: what.to_owned() });
            }
        }
        Ok(())
    }
}

/// Rows of `width` numbers as a tensor.
pub(crate) fn rows(values: Vec<f32>, width: usize, device: &Device) -> Tensor<2> {
    let n = values.len() / width.max(1);
    Tensor::from_data(TensorData::new(values, [n, width]), device)
}

/// Sample points, ray after ray: `[r · s, 3]`.
pub(crate) fn points(origins: &[Vec3], directions: &[Vec3], depths: &[f32], device: &Device) -> Tensor<2> {
    let s = depths.len() / origins.len().max(1);
    let mut out = Vec::with_capacity(depths.len() * 3);
    for ((o, d), z) in origins.iter().zip(directions).zip(depths.chunks_exact(s)) {
        out.extend(z.iter().flat_map(|&z| (*o + *d * z).to_array()));
    }
    rows(out, 3, device)
}

/// The loss of one step, ready for `backward`, and its terms as numbers.
pub fn losses(
    model: &ConfiesModel,
    data: &TrainData,
    space: &NetSpace,
    settings: &FitSettings,
    step: u64,
) -> (Tensor<1>, StepNumbers) {
    let mut drawn = Drawn::new(model, data, space, settings, step);
    let all = 0..drawn.batch.len();
    drawn.part(model, settings, step, all)
}

/// The gradients of one step and its terms as numbers; the rays go through in parts of `settings.micro_rays`, whose
/// gradients add up to that of the whole batch.
pub fn gradients(
    model: &ConfiesModel,
    data: &TrainData,
    space: &NetSpace,
    settings: &FitSettings,
    step: u64,
) -> Result<(GradientsParams, StepNumbers)> {
    let mut drawn = Drawn::new(model, data, space, settings, step);
    let rays = drawn.batch.len();
    let size = if settings.micro_rays == 0 { rays } else { settings.micro_rays.min(rays) };
    let mut sum = GradientsAccumulator::new();
    let mut numbers = StepNumbers::default();
    for start in (0..rays).step_by(size.max(1)) {
        let (loss, part) = drawn.part(model, settings, step, start..(start + size).min(rays));
        numbers += part;
        numbers.check_finite(step)?;
        sum.accumulate(model, GradientsParams::from_grads(loss.backward(), model));
    }
    Ok((sum.grads(), numbers))
}

/// What a step draws, and what its means are taken over.
struct Drawn {
    batch: RayBatch,
    coarse_depths: Vec<f32>,
    /// Where the importance samples of the next part's rays come from; parts come in order.
    fine_rng: ChaCha8Rng,
    counts: Counts,
    /// The region that each mask is to cover.
    mask_regions: Vec<usize>,
    regions: usize,
    attributes: usize,
}

impl Drawn {
    fn new(model: &ConfiesModel, data: &TrainData, space: &NetSpace, settings: &FitSettings, step: u64) -> Self {
        let batch = batch::draw(data, space, &Draw::from(settings), step);
        let (regions, attributes) = (data.table.regions.len(), data.table.attributes.len());
        let mask_regions = model.mask_regions();
        let given = |values: &[f32]| values.iter().map(|&v| f64::from(v)).sum::<f64>();
        let masks = batch
            .masks_given
            .chunks_exact(regions.max(1))
            .map(|g| mask_regions.iter().map(|&n| f64::from(g[n])).sum::<f64>());
        let counts =
            Counts { rays: batch.len() as f64, masks: masks.sum(), attributes: given(&batch.attributes_given) };
        let coarse_depths = coarse_depths(&batch, space, settings, step);
        let fine_rng = batch::rng_for(settings.seed, step, 2);
        Self { batch, coarse_depths, fine_rng, counts, mask_regions, regions, attributes }
    }

    /// The share of the loss of a part of the rays.
    fn part(
        &mut self,
        model: &ConfiesModel,
        settings: &FitSettings,
        step: u64,
        rays: Range<usize>,
    ) -> (Tensor<1>, StepNumbers) {
        let device = &model.device();
        let truth = self.truth(&rays, device);
        let kind = model.config().kind;
        let frames = TensorData::new(self.batch.frames[rays.clone()].to_vec(), [rays.len()]);
        let omega = model.latent_codes(Tensor::<1, Int>::from_data(frames, device));
        let learned = model.attributes_of(omega.clone());
        let alpha = match (&learned, settings.attributes) {
            (None, _) => Tensor::zeros([rays.len(), self.attributes], device),
            (Some(learned), AttributeSource::Learned) => learned.clone(),
            (Some(learned), AttributeSource::Annotated) => {
                let given = truth.attributes_given.clone();
                truth.attributes.clone() * given.clone() + learned.clone() * (given.neg() + 1.0)
            }
        };
        let directions = &self.batch.directions[rays.clone()];
        let directions_in = rows(directions.iter().flat_map(Vec3::to_array).collect(), 3, device);
        let codes = RayCodes { omega: omega.clone(), alpha, directions: directions_in };
        let windows = Windows { hyper: settings.hyper_window.at(step), warp: settings.warp_window.at(step) };
        let attribute_weight = settings.attribute_weight.at(step);
        let (uncertain, weighed) = if kind.has_uncertainty() && attribute_weight >= settings.attribute_cut {
            self.annotated(&rays, device)
        } else {
            (Uncertain::None, None)
        };
        let counts = self.counts;
        let of_weighed = |t: &Tensor<2>| match &weighed {
            Some(index) => t.clone().select(0, index.clone()),
            None => t.clone(),
        };
        let terms_of = |out: &FieldOutputs, weights: &Tensor<2>| {
            // σ is detached for masks and uncertainties: they follow the geometry and never shape it (fact sheet §2.2).
            let still = weights.clone().detach();
            let mask = out.mask_logits.clone().map(|logits| {
                let rendered = match settings.mask_rendering {
                    MaskRendering::Logits => volume::composite(still.clone(), logits),
                    MaskRendering::Probabilities => {
                        let masks = burn::tensor::activation::sigmoid(logits);
                        loss::logits_of(volume::composite(still.clone(), masks))
                    }
                };
                loss::mask(rendered, truth.masks.clone(), truth.masks_given.clone(), counts)
            });
            let attribute = learned.as_ref().filter(|_| attribute_weight > 0.0).and_then(|learned| {
                let [alpha, gt, given] = [learned, &truth.attributes, &truth.attributes_given].map(of_weighed);
                if !kind.has_uncertainty() {
                    return Some(loss::plain_attribute(alpha, gt, given, counts));
                }
                let beta = volume::composite(of_weighed(&still), out.uncertainty.clone()?);
                Some(loss::attribute(alpha, gt, beta, given, counts))
            });
            LossTerms {
                reconstruction: loss::reconstruction(
                    volume::composite(weights.clone(), out.color.clone()),
                    truth.color.clone(),
                    counts,
                ),
                mask,
                attribute,
                latent: kind.has_latent().then(|| loss::latent(omega.clone(), counts)),
            }
        };

        let samples = settings.coarse_samples;
        let place = Place { origins: &self.batch.origins[rays.clone()], directions };
        let coarse_depths = &self.coarse_depths[rays.start * samples..rays.end * samples];
        let coarse = place.render(model, Level::Coarse, coarse_depths, &codes, windows, &uncertain);
        let fine_depths = fine_depths(coarse_depths, &coarse.1, settings, &mut self.fine_rng);
        let fine = place.render(model, Level::Fine, &fine_depths, &codes, windows, &uncertain);
        let (coarse, fine) = (terms_of(&coarse.0, &coarse.1), terms_of(&fine.0, &fine.1));
        let total = coarse.total(&settings.loss, attribute_weight) + fine.total(&settings.loss, attribute_weight);
        (total, numbers(&coarse, &fine))
    }

    fn truth(&self, rays: &Range<usize>, device: &Device) -> Truth {
        let part =
            |values: &[f32], width: usize| rows(values[rays.start * width..rays.end * width].to_vec(), width, device);
        let masks = |values: &[f32]| {
            let of = |ray: usize| self.mask_regions.iter().map(move |&n| values[ray * self.regions + n]);
            rows(rays.clone().flat_map(of).collect(), self.mask_regions.len(), device)
        };
        Truth {
            color: part(&self.batch.colors, 3),
            masks: masks(&self.batch.masks),
            masks_given: masks(&self.batch.masks_given),
            attributes: part(&self.batch.attributes, self.attributes),
            attributes_given: part(&self.batch.attributes_given, self.attributes),
        }
    }

    /// The rays that an uncertainty can weigh anything for: exactly those with an annotation (fact sheet §5.4, item 1).
    fn annotated(&self, rays: &Range<usize>, device: &Device) -> (Uncertain, Option<Tensor<1, Int>>) {
        let given = |ray: usize| {
            self.batch.attributes_given[ray * self.attributes..][..self.attributes].iter().any(|&g| g > 0.0)
        };
        let index: Vec<i32> = (0..rays.len()).filter(|i| given(rays.start + i)).map(|i| i as i32).collect();
        if index.len() == rays.len() {
            return (Uncertain::All, None);
        }
        if index.is_empty() {
            return (Uncertain::None, None);
        }
        let count = index.len();
        let index = Tensor::<1, Int>::from_data(TensorData::new(index, [count]), device);
        (Uncertain::Rays(Box::new(index.clone())), Some(index))
    }
}

struct Truth {
    color: Tensor<2>,
    masks: Tensor<2>,
    masks_given: Tensor<2>,
    attributes: Tensor<2>,
    attributes_given: Tensor<2>,
}

/// Rays in space.
struct Place<'a> {
    origins: &'a [Vec3],
    directions: &'a [Vec3],
}

impl Place<'_> {
    fn render(
        &self,
        model: &ConfiesModel,
        level: Level,
        depths: &[f32],
        codes: &RayCodes,
        windows: Windows,
        uncertain: &Uncertain,
    ) -> (FieldOutputs, Tensor<2>) {
        let device = &model.device();
        let samples = depths.len() / self.origins.len();
        let points = points(self.origins, self.directions, depths, device);
        let out = model.evaluate(level, points, codes, windows, uncertain);
        let weights = volume::weights(out.density.clone(), rows(volume::deltas(depths, samples), samples, device));
        (out, weights)
    }
}

fn coarse_depths(batch: &RayBatch, space: &NetSpace, settings: &FitSettings, step: u64) -> Vec<f32> {
    let rng = &mut batch::rng_for(settings.seed, step, 1);
    let mut depths = Vec::with_capacity(batch.len() * settings.coarse_samples);
    for _ in 0..batch.len() {
        let (near, far) = (space.near as f32, space.far as f32);
        sampling::stratified(&mut depths, settings.coarse_samples, near, far, settings.spacing, Some(&mut *rng));
    }
    depths
}

fn fine_depths(coarse: &[f32], weights: &Tensor<2>, settings: &FitSettings, rng: &mut ChaCha8Rng) -> Vec<f32> {
    let samples = settings.coarse_samples;
    let weights = host(weights.clone().detach());
    let mut depths = Vec::with_capacity(coarse.len() / samples * (samples + settings.fine_samples));
    for (z, w) in coarse.chunks_exact(samples).zip(weights.chunks_exact(samples)) {
        sampling::union(&mut depths, z, w, settings.fine_samples, Some(&mut *rng));
    }
    depths
}

/// The numbers of a tensor, row by row. A read that fails gives not-a-numbers, which the step's check then reports.
pub(crate) fn host<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    let count = tensor.shape().num_elements();
    tensor.try_into_vec_as::<f32>().unwrap_or_else(|_| vec![f32::NAN; count])
}

fn numbers(coarse: &LossTerms, fine: &LossTerms) -> StepNumbers {
    // One read instead of many: on a GPU each is a wait.
    let zero = || fine.reconstruction.clone().detach() * 0.0;
    let of = |term: &Option<Tensor<1>>| term.clone().map_or_else(zero, Tensor::detach);
    let all = Tensor::cat(
        vec![
            coarse.reconstruction.clone().detach(),
            fine.reconstruction.clone().detach(),
            of(&coarse.mask) + of(&fine.mask),
            of(&coarse.attribute) + of(&fine.attribute),
            of(&fine.latent),
        ],
        0,
    );
    let v = host(all);
    StepNumbers {
        reconstruction_coarse: f64::from(v[0]),
        reconstruction_fine: f64::from(v[1]),
        mask: f64::from(v[2]),
        attribute: f64::from(v[3]),
        latent: f64::from(v[4]),
    }
}
