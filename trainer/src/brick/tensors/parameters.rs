//! The learned numbers as modules of Burn, and with them the records that checkpoints hold.

use burn::module::{Module, Param};
use burn::tensor::{Device, Int, Tensor, TensorData};
use risorius_brick::Brick;
use risorius_brick::expression::{CHANNELS, MASKS};
use risorius_brick::field::{FEATURES, Field};
use risorius_brick::model::LATENT;
use risorius_brick::table::Table;

/// A field's numbers.
#[derive(Module, Debug)]
pub struct FieldParameters {
    /// `[vertices, 4]` per level: features, brick by brick.
    pub levels: Vec<Param<Tensor<2>>>,
    /// `[2816]`: the weights of both tiny networks, layer by layer.
    pub net: Param<Tensor<1>>,
}

/// All that a fit learns. The record of this module is a checkpoint's `weights.bpk`.
#[derive(Module, Debug)]
pub struct BrickParameters {
    /// The head's.
    pub head: FieldParameters,
    /// The background's.
    pub background: Option<FieldParameters>,
    /// `[vertices, 8]` per AU, and per latent number after these: features 0–3, displacement, feature 4.
    pub residuals: Vec<Param<Tensor<2>>>,
    /// `[vertices, 4]`: logits of the region masks.
    pub masks: Param<Tensor<2>>,
    /// `[vertices, 4]` per latent number: displacements.
    pub latent_bases: Vec<Param<Tensor<2>>>,
    /// `[images, 8]`: ω.
    pub codes: Param<Tensor<2>>,
    /// `[images, K]`: α, as differences from what was annotated.
    pub alphas: Param<Tensor<2>>,
    /// `[images, K]`: ln β.
    pub log_betas: Param<Tensor<2>>,
    /// `[images, 6]`: a small turn and shift of each image's camera, box units.
    pub motions: Param<Tensor<2>>,
}

/// Which of a table's arrays.
type Pick = fn(&Table) -> &[f32];

fn matrix(values: &[f32], width: usize, device: &Device) -> Param<Tensor<2>> {
    let data = TensorData::new(values.to_vec(), [values.len() / width.max(1), width]);
    Param::from_tensor(Tensor::from_data(data, device))
}

fn field(field: &Field, pick: Pick, device: &Device) -> FieldParameters {
    let net = pick(&field.net).to_vec();
    let size = [net.len()];
    FieldParameters {
        levels: field.features.iter().map(|t| matrix(pick(t), FEATURES, device)).collect(),
        net: Param::from_tensor(Tensor::from_data(TensorData::new(net, size), device)),
    }
}

impl BrickParameters {
    /// The numbers of a model.
    pub fn of(model: &Brick, device: &Device) -> Self {
        Self::picked(model, |table| &table.values, device)
    }

    fn picked(model: &Brick, pick: Pick, device: &Device) -> Self {
        let units = model.layout.region_of.len();
        let all = |tables: &[Table], width| tables.iter().map(|t| matrix(pick(t), width, device)).collect();
        Self {
            head: field(&model.head.field, pick, device),
            background: model.background.as_ref().map(|part| field(&part.field, pick, device)),
            residuals: all(&model.expression.residuals, CHANNELS),
            masks: matrix(pick(&model.expression.masks), MASKS, device),
            latent_bases: all(&model.latent_bases, 4),
            codes: matrix(pick(&model.codes), LATENT, device),
            alphas: matrix(pick(&model.alphas), units, device),
            log_betas: matrix(pick(&model.log_betas), units, device),
            motions: matrix(pick(&model.motions), 6, device),
        }
    }

    /// What rays depend on, one after the other: the first input of [`super::render_rays`].
    pub fn flat(&self) -> Tensor<1> {
        let matrix = |p: &Param<Tensor<2>>| -> Tensor<1> { p.val().flatten(0, 1) };
        let mut parts = Vec::new();
        for field in [Some(&self.head), self.background.as_ref()].into_iter().flatten() {
            parts.extend(field.levels.iter().map(matrix));
            parts.push(field.net.val());
        }
        parts.extend(self.residuals.iter().map(matrix));
        parts.push(matrix(&self.masks));
        parts.extend(self.latent_bases.iter().map(matrix));
        Tensor::cat(parts, 0)
    }

    /// Activations (0 at an AU's least, 1 at its most) and the code of training image `image`, whose annotated attributes are
    /// `attributes` (−1..1): the second input of [`super::render_rays`], differentiable in α and ω.
    pub fn activations(&self, image: usize, attributes: &[f32]) -> Tensor<1> {
        let device = self.codes.val().device();
        let row = |p: &Param<Tensor<2>>| -> Tensor<1> { p.val().narrow(0, image, 1).flatten(0, 1) };
        let annotated = Tensor::<1>::from_data(TensorData::new(attributes.to_vec(), [attributes.len()]), &device);
        Tensor::cat(vec![(annotated + row(&self.alphas) + 1.0) * 0.5, row(&self.codes)], 0)
    }

    /// The camera's turn and shift of training image `image`: the third input of [`super::render_rays`].
    pub fn motion(&self, image: usize) -> Tensor<1> {
        self.motions.val().narrow(0, image, 1).flatten(0, 1)
    }
}

/// Updates of each block of a field's tables.
#[derive(Module, Debug)]
pub struct FieldSteps {
    /// `[blocks]` per level.
    pub levels: Vec<Param<Tensor<1, Int>>>,
    /// `[1]`
    pub net: Param<Tensor<1, Int>>,
}

/// Updates of each block: Adam's bias is corrected by a block's own count. At the paths of [`BrickParameters`].
#[derive(Module, Debug)]
pub struct BlockSteps {
    /// See [`BrickParameters::head`].
    pub head: FieldSteps,
    /// See [`BrickParameters::background`].
    pub background: Option<FieldSteps>,
    /// See [`BrickParameters::residuals`].
    pub residuals: Vec<Param<Tensor<1, Int>>>,
    /// See [`BrickParameters::masks`].
    pub masks: Param<Tensor<1, Int>>,
    /// See [`BrickParameters::latent_bases`].
    pub latent_bases: Vec<Param<Tensor<1, Int>>>,
    /// See [`BrickParameters::codes`].
    pub codes: Param<Tensor<1, Int>>,
    /// See [`BrickParameters::alphas`].
    pub alphas: Param<Tensor<1, Int>>,
    /// See [`BrickParameters::log_betas`].
    pub log_betas: Param<Tensor<1, Int>>,
    /// See [`BrickParameters::motions`].
    pub motions: Param<Tensor<1, Int>>,
}

/// The optimiser's state. The record of this module is a checkpoint's `optimizer.bpk`.
#[derive(Module, Debug)]
pub struct BrickMoments {
    /// Adam's first moments.
    pub first: BrickParameters,
    /// Adam's second moments.
    pub second: BrickParameters,
    /// Updates so far.
    pub steps: BlockSteps,
}

fn steps(table: &Table, device: &Device) -> Param<Tensor<1, Int>> {
    let data = TensorData::new(table.steps.clone(), [table.steps.len()]);
    Param::initialized(burn::module::ParamId::new(), Tensor::from_data(data, device))
}

fn field_steps(field: &Field, device: &Device) -> FieldSteps {
    FieldSteps { levels: field.features.iter().map(|t| steps(t, device)).collect(), net: steps(&field.net, device) }
}

impl BrickMoments {
    /// The state of a model in a fit.
    pub fn of(model: &Brick, device: &Device) -> Self {
        let all = |tables: &[Table]| tables.iter().map(|t| steps(t, device)).collect();
        Self {
            first: BrickParameters::picked(model, |table| &table.first, device),
            second: BrickParameters::picked(model, |table| &table.second, device),
            steps: BlockSteps {
                head: field_steps(&model.head.field, device),
                background: model.background.as_ref().map(|part| field_steps(&part.field, device)),
                residuals: all(&model.expression.residuals),
                masks: steps(&model.expression.masks, device),
                latent_bases: all(&model.latent_bases),
                codes: steps(&model.codes, device),
                alphas: steps(&model.alphas, device),
                log_betas: steps(&model.log_betas, device),
                motions: steps(&model.motions, device),
            },
        }
    }
}
