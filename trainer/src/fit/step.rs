//! One step: both levels of one batch of rays, and their losses (fact sheet §1.12, §2).

use burn::tensor::{Device, Int, Tensor, TensorData};
use glam::Vec3;

use crate::batch::{self, RayBatch};
use crate::config::{AttributeSource, FitSettings};
use crate::data::TrainData;
use crate::error::{Result, TrainerError};
use crate::loss::{self, LossTerms};
use crate::model::{ConfiesModel, FieldOutputs, Level, RayCodes, Windows};
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
    let device = &model.device();
    let batch = batch::draw(data, space, settings.rays, settings.region_share, settings.seed, step);
    let (regions, attributes) = (data.table.regions.len(), data.table.attributes.len());
    let truth = Truth {
        color: rows(batch.colors.clone(), 3, device),
        masks: rows(batch.masks.clone(), regions, device),
        masks_given: rows(batch.masks_given.clone(), regions, device),
        attributes: rows(batch.attributes.clone(), attributes, device),
        attributes_given: rows(batch.attributes_given.clone(), attributes, device),
    };
    let omega =
        model.latent_codes(Tensor::<1, Int>::from_data(TensorData::new(batch.frames.clone(), [batch.len()]), device));
    let learned = model.attributes_of(omega.clone());
    let alpha = match settings.attributes {
        AttributeSource::Learned => learned.clone(),
        AttributeSource::Annotated => {
            let given = truth.attributes_given.clone();
            truth.attributes.clone() * given.clone() + learned.clone() * (given.neg() + 1.0)
        }
    };
    let directions = rows(batch.directions.iter().flat_map(Vec3::to_array).collect(), 3, device);
    let codes = RayCodes { omega: omega.clone(), alpha, directions };
    let windows = Windows { hyper: settings.hyper_window.at(step), warp: settings.warp_window.at(step) };
    let attribute_weight = settings.attribute_weight.at(step);
    let with_uncertainty = attribute_weight >= settings.attribute_cut;
    let terms_of = |out: &FieldOutputs, weights: &Tensor<2>| {
        // σ is detached for masks and uncertainties: they follow the geometry and never shape it (fact sheet §2.2).
        let still = weights.clone().detach();
        let beta = out.uncertainty.clone().map(|b| volume::composite(still.clone(), b));
        LossTerms {
            reconstruction: loss::reconstruction(
                volume::composite(weights.clone(), out.color.clone()),
                truth.color.clone(),
            ),
            mask: loss::mask(
                volume::composite(still, out.mask_logits.clone()),
                truth.masks.clone(),
                truth.masks_given.clone(),
            ),
            attribute: beta
                .map(|b| loss::attribute(learned.clone(), truth.attributes.clone(), b, truth.attributes_given.clone())),
            latent: loss::latent(omega.clone()),
        }
    };

    let coarse_depths = coarse_depths(&batch, space, settings, step);
    let coarse = render_level(model, Level::Coarse, &batch, &coarse_depths, &codes, windows, with_uncertainty);
    let fine_depths = fine_depths(&coarse_depths, &coarse.1, settings, step);
    let fine = render_level(model, Level::Fine, &batch, &fine_depths, &codes, windows, with_uncertainty);

    let (coarse_terms, fine_terms) = (terms_of(&coarse.0, &coarse.1), terms_of(&fine.0, &fine.1));
    let total =
        coarse_terms.total(&settings.loss, attribute_weight) + fine_terms.total(&settings.loss, attribute_weight);
    (total, numbers(&coarse_terms, &fine_terms))
}

struct Truth {
    color: Tensor<2>,
    masks: Tensor<2>,
    masks_given: Tensor<2>,
    attributes: Tensor<2>,
    attributes_given: Tensor<2>,
}

fn render_level(
    model: &ConfiesModel,
    level: Level,
    batch: &RayBatch,
    depths: &[f32],
    codes: &RayCodes,
    windows: Windows,
    with_uncertainty: bool,
) -> (FieldOutputs, Tensor<2>) {
    let device = &model.device();
    let samples = depths.len() / batch.len();
    let out = model.evaluate(
        level,
        points(&batch.origins, &batch.directions, depths, device),
        codes,
        windows,
        with_uncertainty,
    );
    let weights = volume::weights(out.density.clone(), rows(volume::deltas(depths, samples), samples, device));
    (out, weights)
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

fn fine_depths(coarse: &[f32], weights: &Tensor<2>, settings: &FitSettings, step: u64) -> Vec<f32> {
    let rng = &mut batch::rng_for(settings.seed, step, 2);
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
    // One read instead of seven: on a GPU each is a wait.
    let zero = || fine.latent.clone().detach() * 0.0;
    let attribute = |t: &LossTerms| t.attribute.clone().map_or_else(zero, Tensor::detach);
    let all = Tensor::cat(
        vec![
            coarse.reconstruction.clone().detach(),
            fine.reconstruction.clone().detach(),
            coarse.mask.clone().detach() + fine.mask.clone().detach(),
            attribute(coarse) + attribute(fine),
            fine.latent.clone().detach(),
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
