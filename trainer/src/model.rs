//! The CoNFies field: which network sees what (eq. 7–12; fact sheet §1.12).

use std::ops::Range;

use burn::module::{Module, Param};
use burn::tensor::activation::sigmoid;
use burn::tensor::{Device, Int, Tensor};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use risorius_formats::AttributeTable;

use crate::config::ModelConfig;
use crate::encoding;
use crate::fields::{AmbientSlices, AttributeNet, DeformationField, MaskNets, Template, UncertaintyNets};
use crate::mlp::parameter;

/// Coarse or fine: they share everything but template, masks and uncertainties (fact sheet §1.11).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Level {
    /// Samples spread over the whole ray.
    Coarse,
    /// Coarse and importance samples together.
    Fine,
}

/// How far the coarse-to-fine windows are open.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Windows {
    /// For the ambient encoding.
    pub hyper: f64,
    /// For the deformation field's encoding.
    pub warp: f64,
}

impl Windows {
    /// All bands open, as at the end of every schedule.
    pub fn open(config: &ModelConfig) -> Self {
        Self { hyper: config.hyper_bands as f64, warp: config.warp_bands as f64 }
    }
}

/// What is constant along a ray.
#[derive(Clone, Debug)]
pub struct RayCodes {
    /// ω: `[r, latent]`.
    pub omega: Tensor<2>,
    /// α: `[r, K]`.
    pub alpha: Tensor<2>,
    /// Unit viewing directions: `[r, 3]`.
    pub directions: Tensor<2>,
}

/// What the field says of every sample of every ray.
#[derive(Clone, Debug)]
pub struct FieldOutputs {
    /// σ: `[r, s]`.
    pub density: Tensor<2>,
    /// RGB: `[r, s, 3]`.
    pub color: Tensor<3>,
    /// Mask logits: `[r, s, N]`.
    pub mask_logits: Tensor<3>,
    /// β, where asked for: `[r, s, K]`.
    pub uncertainty: Option<Tensor<3>>,
}

#[derive(Module, Debug)]
struct LevelNets {
    template: Template,
    masks: MaskNets,
    uncertainty: UncertaintyNets,
}

/// The whole model: latent codes, A, T, H and, per level, F, M and B.
#[derive(Module, Debug)]
pub struct ConfiesModel {
    /// ω of each training frame: `[frames, latent]`.
    latent: Param<Tensor<2>>,
    attribute: AttributeNet,
    deformation: DeformationField,
    ambient: AmbientSlices,
    coarse: LevelNets,
    fine: LevelNets,
    #[module(skip)]
    config: ModelConfig,
    #[module(skip)]
    groups: Vec<Range<usize>>,
    #[module(skip)]
    attributes: usize,
}

/// The attributes of each region as ranges; the table keeps them region after region.
pub fn region_groups(table: &AttributeTable) -> Vec<Range<usize>> {
    let mut start = 0;
    let group = |g: Vec<usize>| {
        let range = start..start + g.len();
        start = range.end;
        range
    };
    table.groups().into_iter().map(group).collect()
}

impl ConfiesModel {
    /// A fresh model for `frames` training frames and these regions; the same seed gives the same weights.
    pub fn new(config: &ModelConfig, groups: &[Range<usize>], frames: usize, seed: u64, device: &Device) -> Self {
        let rng = &mut ChaCha8Rng::seed_from_u64(seed);
        let attributes = groups.last().map_or(0, |g| g.end);
        let latent = (0..frames * config.latent_dims).map(|_| rng.random::<f32>() * 0.05).collect();
        let level = |size, rng: &mut ChaCha8Rng| LevelNets {
            template: Template::new(config, size, attributes + 1, rng, device),
            masks: MaskNets::new(config, groups, rng, device),
            uncertainty: UncertaintyNets::new(config, attributes, rng, device),
        };
        Self {
            latent: parameter(latent, [frames, config.latent_dims], device),
            attribute: AttributeNet::new(config, attributes, rng, device),
            deformation: DeformationField::new(config, rng, device),
            ambient: AmbientSlices::new(config, attributes, rng, device),
            coarse: level(config.template_coarse, rng),
            fine: level(config.template, rng),
            config: *config,
            groups: groups.to_vec(),
            attributes,
        }
    }

    /// The sizes it was built with.
    pub fn config(&self) -> &ModelConfig {
        &self.config
    }

    /// K.
    pub fn attribute_count(&self) -> usize {
        self.attributes
    }

    /// N.
    pub fn region_count(&self) -> usize {
        self.groups.len()
    }

    /// Training frames it has codes for.
    pub fn frame_count(&self) -> usize {
        self.latent.val().dims()[0]
    }

    /// Where its parameters live.
    pub fn device(&self) -> Device {
        self.latent.val().device()
    }

    /// ω of these training frames: `[r, latent]`.
    pub fn latent_codes(&self, frames: Tensor<1, Int>) -> Tensor<2> {
        self.latent.val().select(0, frames)
    }

    /// α = A(ω): `[r, K]`.
    pub fn attributes_of(&self, omega: Tensor<2>) -> Tensor<2> {
        self.attribute.forward(omega)
    }

    /// The field at `points` (`[r · s, 3]`, ray after ray).
    pub fn evaluate(
        &self,
        level: Level,
        points: Tensor<2>,
        rays: &RayCodes,
        windows: Windows,
        with_uncertainty: bool,
    ) -> FieldOutputs {
        let c = &self.config;
        let [r, _] = rays.omega.dims();
        let [n, _] = points.dims();
        let s = n / r;
        let per_sample = |t: &Tensor<2>| {
            let [_, d] = t.dims();
            t.clone().unsqueeze_dim::<3>(1).expand([r, s, d]).reshape([n, d])
        };
        let omega = per_sample(&rays.omega);
        let warped =
            self.deformation.forward(points.clone(), omega.clone(), &encoding::window(c.warp_bands, windows.warp));
        let (ambient, rest) = self.ambient.forward(points, per_sample(&rays.alpha), omega);
        let position = encoding::encode(warped, &encoding::open_window(c.template_bands), true);

        let (k, d) = (self.attributes, c.hyper_dims);
        let window = encoding::window(c.hyper_bands, windows.hyper);
        let component = encoding::width(d, c.hyper_bands, false);
        let encode = |w: Tensor<2>, count: usize| {
            encoding::encode(w.reshape([n * count, d]), &window, false).reshape([n, count * component])
        };
        let nets = match level {
            Level::Coarse => &self.coarse,
            Level::Fine => &self.fine,
        };
        let (ambient_code, rest_code) = (encode(ambient.clone(), k), encode(rest.clone(), 1));
        let mask_logits = nets.masks.forward(&position, &ambient_code, &rest_code);
        let uncertainty = with_uncertainty
            .then(|| nets.uncertainty.forward(position.clone(), ambient_code, rest_code).reshape([r, s, k]));

        // Eq. 10. The masks multiply the raw coordinates: where a mask is 0 the code is (sin 0, cos 0) = (0, 1).
        let masks = sigmoid(mask_logits.clone());
        let mut masked: Vec<Tensor<2>> = self
            .groups
            .iter()
            .enumerate()
            .filter(|(_, g)| !g.is_empty())
            .map(|(i, g)| ambient.clone().narrow(1, g.start * d, g.len() * d) * masks.clone().narrow(1, i, 1))
            .collect();
        let rest_mask = masks.sum_dim(1).clamp(0.0, 1.0).neg() + 1.0;
        masked.push(rest * rest_mask);
        let hyper = encode(Tensor::cat(masked, 1), k + 1);

        let view = encoding::encode(rays.directions.clone(), &encoding::open_window(c.view_bands), true);
        let out = nets.template.forward(Tensor::cat(vec![position, hyper], 1), per_sample(&view));
        FieldOutputs {
            density: out.density.reshape([r, s]),
            color: out.color.reshape([r, s, 3]),
            mask_logits: mask_logits.reshape([r, s, self.groups.len()]),
            uncertainty,
        }
    }
}
