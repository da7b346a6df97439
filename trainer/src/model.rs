//! The CoNFies field: which network sees what (eq. 7–12; fact sheet §1.12).

use std::ops::Range;

use burn::module::{Module, Param};
use burn::tensor::activation::sigmoid;
use burn::tensor::{Device, Int, Tensor};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use risorius_formats::AttributeTable;

use crate::config::{MaskKind, ModelConfig, RestMask, SliceKind};
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

/// Of which rays the uncertainty is wanted.
#[derive(Clone, Debug)]
pub enum Uncertain {
    /// Of none.
    None,
    /// Of all.
    All,
    /// Of these, by index: the others have no annotation that it could weigh.
    Rays(Box<Tensor<1, Int>>),
}

/// What the field says of every sample of every ray.
#[derive(Clone, Debug)]
pub struct FieldOutputs {
    /// σ: `[r, s]`.
    pub density: Tensor<2>,
    /// RGB: `[r, s, 3]`.
    pub color: Tensor<3>,
    /// Mask logits, where the model has masks: `[r, s, masks]`.
    pub mask_logits: Option<Tensor<3>>,
    /// β of the rays asked for: `[rays asked for, s, K]`.
    pub uncertainty: Option<Tensor<3>>,
}

#[derive(Module, Debug)]
struct LevelNets {
    template: Template,
    masks: MaskNets,
    uncertainty: Option<UncertaintyNets>,
}

/// The whole model: latent codes, A, T, H and, per level, F, M and B, as far as its kind has them.
#[derive(Module, Debug)]
pub struct ConfiesModel {
    /// ω of each training frame: `[frames, latent]`.
    latent: Option<Param<Tensor<2>>>,
    attribute: Option<AttributeNet>,
    deformation: Option<DeformationField>,
    ambient: AmbientSlices,
    coarse: LevelNets,
    fine: LevelNets,
    #[module(skip)]
    config: ModelConfig,
    #[module(skip)]
    groups: Vec<Range<usize>>,
    #[module(skip)]
    attributes: usize,
    #[module(skip)]
    frames: usize,
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

/// Columns of the encoded ambient coordinates that the template sees.
pub(crate) fn hyper_width(config: &ModelConfig, attributes: usize) -> usize {
    let (components, dims) = match config.kind.slices() {
        SliceKind::PerAttribute => (attributes + 1, config.hyper_dims),
        SliceKind::Rest => (1, config.hyper_dims),
        SliceKind::Code => (1, config.latent_dims),
        SliceKind::None => (0, 0),
    };
    components * encoding::width(dims, config.hyper_bands, false)
}

impl ConfiesModel {
    /// A fresh model for `frames` training frames and these regions; the same seed gives the same weights.
    pub fn new(config: &ModelConfig, groups: &[Range<usize>], frames: usize, seed: u64, device: &Device) -> Self {
        let rng = &mut ChaCha8Rng::seed_from_u64(seed);
        let (kind, attributes) = (config.kind, groups.last().map_or(0, |g| g.end));
        let latent = kind.has_latent().then(|| {
            let values = (0..frames * config.latent_dims).map(|_| rng.random::<f32>() * 0.05).collect();
            parameter(values, [frames, config.latent_dims], device)
        });
        let hyper = hyper_width(config, attributes);
        let level = |size, masks, rng: &mut ChaCha8Rng| LevelNets {
            template: Template::new(config, size, hyper, rng, device),
            masks: MaskNets::new(config, masks, groups, rng, device),
            uncertainty: kind.has_uncertainty().then(|| UncertaintyNets::new(config, attributes, rng, device)),
        };
        Self {
            latent,
            attribute: kind.has_attributes().then(|| AttributeNet::new(config, attributes, rng, device)),
            deformation: kind.has_warp().then(|| DeformationField::new(config, rng, device)),
            ambient: AmbientSlices::new(config, attributes, rng, device),
            coarse: level(config.template_coarse, config.mask_coarse.unwrap_or(config.mask), rng),
            fine: level(config.template, config.mask, rng),
            config: *config,
            groups: groups.to_vec(),
            attributes,
            frames,
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

    /// The region that each mask is to cover: one mask per region, or with CoNeRF's joint net one per attribute.
    pub fn mask_regions(&self) -> Vec<usize> {
        match self.config.kind.masks() {
            MaskKind::PerRegion => (0..self.groups.len()).collect(),
            MaskKind::Joint => self.groups.iter().enumerate().flat_map(|(n, g)| g.clone().map(move |_| n)).collect(),
            MaskKind::None => Vec::new(),
        }
    }

    /// The attributes under each mask.
    fn mask_groups(&self) -> Vec<Range<usize>> {
        match self.config.kind.masks() {
            MaskKind::PerRegion => self.groups.clone(),
            MaskKind::Joint => (0..self.attributes).map(|k| k..k + 1).collect(),
            MaskKind::None => Vec::new(),
        }
    }

    /// Training frames it was built for.
    pub fn frame_count(&self) -> usize {
        self.frames
    }

    /// Where its parameters live.
    pub fn device(&self) -> Device {
        self.fine.template.device()
    }

    /// ω of these training frames, zeros where the model has no codes: `[r, latent]`.
    pub fn latent_codes(&self, frames: Tensor<1, Int>) -> Tensor<2> {
        match &self.latent {
            Some(latent) => latent.val().select(0, frames),
            None => Tensor::zeros([frames.dims()[0], self.config.latent_dims], &self.device()),
        }
    }

    /// α = A(ω), where attributes steer the model: `[r, K]`.
    pub fn attributes_of(&self, omega: Tensor<2>) -> Option<Tensor<2>> {
        self.attribute.as_ref().map(|net| net.forward(omega))
    }

    /// The field at `points` (`[r · s, 3]`, ray after ray).
    pub fn evaluate(
        &self,
        level: Level,
        points: Tensor<2>,
        rays: &RayCodes,
        windows: Windows,
        uncertain: &Uncertain,
    ) -> FieldOutputs {
        let c = &self.config;
        let [r, _] = rays.omega.dims();
        let [n, _] = points.dims();
        let s = n / r;
        let nets = match level {
            Level::Coarse => &self.coarse,
            Level::Fine => &self.fine,
        };
        let warped = match &self.deformation {
            Some(field) => field.forward(points.clone(), &rays.omega, &encoding::window(c.warp_bands, windows.warp)),
            None => points.clone(),
        };
        let slices = self.ambient.forward(points, &rays.alpha, &rays.omega);
        let position = encoding::encode(warped, &encoding::open_window(c.template_bands), true);
        let window = encoding::window(c.hyper_bands, windows.hyper);
        // Each component is encoded by itself, dims coordinates at a time.
        let encode = |w: Tensor<2>, dims: usize| {
            let count = w.dims()[1] / dims;
            let width = encoding::width(dims, c.hyper_bands, false);
            encoding::encode(w.reshape([n * count, dims]), &window, false).reshape([n, count * width])
        };
        let (mut mask_logits, mut uncertainty) = (None, None);
        let hyper = match (slices.attributes, slices.rest) {
            (Some(ambient), Some(rest)) => {
                let (ambient_code, rest_code) =
                    (encode(ambient.clone(), c.hyper_dims), encode(rest.clone(), c.hyper_dims));
                mask_logits = nets.masks.forward(&position, &ambient_code, &rest_code);
                uncertainty = nets.uncertainty.as_ref().and_then(|nets| {
                    evaluate_uncertainty(nets, &position, &ambient_code, &rest_code, [r, s], uncertain)
                });
                match &mask_logits {
                    Some(logits) => Some(encode(self.masked(&ambient, rest, logits), c.hyper_dims)),
                    None => Some(Tensor::cat(vec![ambient_code, rest_code], 1)),
                }
            }
            (_, Some(rest)) => {
                let dims = rest.dims()[1];
                Some(encode(rest, dims))
            }
            _ => None,
        };
        let view = encoding::encode(rays.directions.clone(), &encoding::open_window(c.view_bands), true);
        let input = match hyper {
            Some(hyper) => Tensor::cat(vec![position, hyper], 1),
            None => position,
        };
        let out = nets.template.forward(input, &view);
        FieldOutputs {
            density: out.density.reshape([r, s]),
            color: out.color.reshape([r, s, 3]),
            mask_logits: mask_logits.map(|logits| {
                let masks = logits.dims()[1];
                logits.reshape([r, s, masks])
            }),
            uncertainty,
        }
    }

    /// Eq. 10. The masks multiply the raw coordinates: where a mask is 0 the code is (sin 0, cos 0) = (0, 1).
    fn masked(&self, ambient: &Tensor<2>, rest: Tensor<2>, logits: &Tensor<2>) -> Tensor<2> {
        let d = self.config.hyper_dims;
        let masks = sigmoid(logits.clone());
        let mut masked: Vec<Tensor<2>> = self
            .mask_groups()
            .iter()
            .enumerate()
            .filter(|(_, g)| !g.is_empty())
            .map(|(i, g)| ambient.clone().narrow(1, g.start * d, g.len() * d) * masks.clone().narrow(1, i, 1))
            .collect();
        let covered = masks.sum_dim(1);
        let rest_mask = match self.config.rest_mask {
            RestMask::Clipped => covered.clamp(0.0, 1.0).neg() + 1.0,
            RestMask::Plain => covered.neg() + 1.0,
        };
        masked.push(rest * rest_mask);
        Tensor::cat(masked, 1)
    }
}

/// β of the rays that are asked for: `[rays asked for, s, K]`.
fn evaluate_uncertainty(
    nets: &UncertaintyNets,
    position: &Tensor<2>,
    ambient: &Tensor<2>,
    rest: &Tensor<2>,
    [r, s]: [usize; 2],
    uncertain: &Uncertain,
) -> Option<Tensor<3>> {
    let of_rays = |t: &Tensor<2>, rays: &Tensor<1, Int>| {
        let (width, count) = (t.dims()[1], rays.dims()[0]);
        t.clone().reshape([r, s * width]).select(0, rays.clone()).reshape([count * s, width])
    };
    let (rays, beta) = match uncertain {
        Uncertain::None => return None,
        Uncertain::All => (r, nets.forward(position.clone(), ambient.clone(), rest.clone())),
        Uncertain::Rays(rays) => {
            let [position, ambient, rest] = [position, ambient, rest].map(|t| of_rays(t, rays));
            (rays.dims()[0], nets.forward(position, ambient, rest))
        }
    };
    let attributes = beta.dims()[1];
    Some(beta.reshape([rays, s, attributes]))
}
