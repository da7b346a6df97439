//! The settings of a fit: sizes of every network, schedules, loss weights, sampling. Saved as `settings.toml`.
//!
//! What the presets hold and where they differ: `docs/confies.md`.

mod kind;
mod presets;

use risorius_formats::{ErrorKind, FormatError, Result};
use serde::{Deserialize, Serialize};

use crate::kernel::Products;
use crate::schedule::Schedule;

pub use kind::{MaskKind, ModelKind, SliceKind};
pub use presets::PRESETS;

/// Depth and width of a dense network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetSize {
    /// Hidden layers.
    pub depth: usize,
    /// Units per hidden layer.
    pub width: usize,
}

/// Hidden layer (from 0) before which a net's input is appended again; nets that are not deeper have no skip.
pub const SKIP_LAYER: usize = 4;

/// A net with a trunk and one more, narrower layer that sees the input again (paper, mask and uncertainty nets).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BranchedSize {
    /// The trunk; deeper than four layers it has the family's skip.
    pub trunk: NetSize,
    /// Width of the last hidden layer; 0 leaves it out.
    pub branch: usize,
    /// Whether that layer sees `[trunk output, net input]` (the paper's words) or the trunk's output only.
    #[serde(default = "yes")]
    pub branch_skip: bool,
}

fn yes() -> bool {
    true
}

/// How deep the samples of a ray lie.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Spacing {
    /// Evenly in depth, as the paper.
    Depth,
    /// Evenly in 1/depth: denser near the head, for scenes with a far background.
    Disparity,
}

/// Where the attributes that steer the ambient slices come from while fitting.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AttributeSource {
    /// α = A(ω), as the paper: the latent code has to learn 17 AUs first, which takes tens of thousands of steps.
    Learned,
    /// The annotated α where there is one, A(ω) elsewhere; A is trained beside it. For short schedules.
    Annotated,
}

/// m_0, the mask of what no attribute moves.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RestMask {
    /// `1 − clip(Σ m, 0, 1)`, as the released code: never negative.
    #[default]
    Clipped,
    /// `1 − Σ m`, as the paper writes it: negative where masks overlap.
    Plain,
}

/// What of a mask is rendered along the ray.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MaskRendering {
    /// Logits, with the sigmoid after: the released code.
    #[default]
    Logits,
    /// Probabilities: the paper's eq. 11.
    Probabilities,
}

/// In which order rays are drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RayOrder {
    /// Each ray by itself, from all frames and pixels.
    #[default]
    Independent,
    /// One random permutation of all rays, repeated epoch after epoch, as the released loader.
    Epochs,
}

/// Sizes and encodings of the networks (fact sheet §1).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelConfig {
    /// CoNFies or one of the models that it is compared with.
    #[serde(default)]
    pub kind: ModelKind,
    /// Length of the deformation code ω.
    pub latent_dims: usize,
    /// A: ω → α.
    pub attribute: NetSize,
    /// T: the SE(3) deformation field.
    pub warp: NetSize,
    /// Frequency bands of T's position encoding.
    pub warp_bands: usize,
    /// H_0 … H_K: the ambient slices.
    pub sheet: NetSize,
    /// Frequency bands of the slices' position encoding.
    pub sheet_bands: usize,
    /// Ambient coordinates per slice.
    pub hyper_dims: usize,
    /// Frequency bands of the ambient coordinates.
    pub hyper_bands: usize,
    /// M_n: the mask nets.
    pub mask: BranchedSize,
    /// M_n of the coarse level, where they differ.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mask_coarse: Option<BranchedSize>,
    /// m_0.
    #[serde(default)]
    pub rest_mask: RestMask,
    /// B_i: the uncertainty nets.
    pub uncertainty: BranchedSize,
    /// F: the template.
    pub template: NetSize,
    /// F of the coarse level, where it differs.
    pub template_coarse: NetSize,
    /// Frequency bands of the template's position encoding.
    pub template_bands: usize,
    /// Frequency bands of the view direction.
    pub view_bands: usize,
    /// Units of F's colour layer.
    pub color_width: usize,
    /// Radius of the head in the units the networks see; 0 keeps the dataset's scene units, as the paper.
    ///
    /// The finest of 8 bands has a wavelength of 2π/128 ≈ 0.05: in scene units that span the room it would be
    /// centimetres on the face.
    pub head_radius: f64,
    /// The numbers of the networks' matrix products; encodings, sums and rendering stay in f32.
    #[serde(default)]
    pub products: Products,
}

/// Weights of the loss terms (fact sheet §2.1); the terms themselves are reported unweighted.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossWeights {
    /// L_mask.
    pub mask: f64,
    /// L_lat.
    pub latent: f64,
}

/// Everything that decides a fit, without options left open.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FitSettings {
    /// Name of the preset these settings started from.
    pub preset: String,
    /// Seed of every random draw.
    pub seed: u64,
    /// Steps until the schedules end.
    pub steps: u64,
    /// Rays per step.
    pub rays: usize,
    /// Share of the rays drawn from pixels inside region masks; 0 draws all evenly, as the paper.
    pub region_share: f64,
    /// Share of the rays drawn from frames with annotations, where there are frames of both sorts; 0 draws all alike.
    #[serde(default)]
    pub annotated_share: f64,
    /// The order of the rays.
    #[serde(default)]
    pub ray_order: RayOrder,
    /// Rays that go through the networks together, for the sake of memory; 0 for all. The gradient is that of all.
    #[serde(default)]
    pub micro_rays: usize,
    /// Whether a device without this project's kernels forgets cheap activations and computes them again on the way back.
    #[serde(default)]
    pub recompute: bool,
    /// Every so many frames is fitted and the one in the middle held out (even, the paper's tables: 2); 0 keeps the
    /// dataset's own lists.
    #[serde(default)]
    pub interval: usize,
    /// Coarse samples per ray.
    pub coarse_samples: usize,
    /// Importance samples per ray; the fine level sees both.
    pub fine_samples: usize,
    /// Spacing of the coarse samples.
    pub spacing: Spacing,
    /// Source of α while fitting.
    pub attributes: AttributeSource,
    /// What of the masks is rendered.
    #[serde(default)]
    pub mask_rendering: MaskRendering,
    /// The dataset's image scale; 0 takes the dataset's default.
    pub image_scale: u32,
    /// Learning rate by step.
    pub learning_rate: Schedule,
    /// Weight of L_attr by step.
    pub attribute_weight: Schedule,
    /// Below this weight the uncertainty nets are not evaluated: their effect is beneath float noise.
    pub attribute_cut: f64,
    /// Window of the ambient encoding by step.
    pub hyper_window: Schedule,
    /// Window of the deformation field's encoding by step.
    pub warp_window: Schedule,
    /// The other loss weights.
    pub loss: LossWeights,
    /// Steps between checkpoints.
    pub checkpoint_every: u64,
    /// Network sizes.
    pub model: ModelConfig,
}

impl FitSettings {
    /// The same preset with its schedules stretched or squeezed to `steps`.
    #[must_use]
    pub fn with_steps(mut self, steps: u64) -> Self {
        let steps = steps.max(2);
        let ratio = steps as f64 / self.steps as f64;
        for schedule in
            [&mut self.learning_rate, &mut self.attribute_weight, &mut self.hyper_window, &mut self.warp_window]
        {
            *schedule = schedule.stretched(ratio);
        }
        self.steps = steps;
        self
    }

    /// Fails on settings that cannot work, naming the setting.
    pub fn validate(&self) -> Result<()> {
        let fail = |message: &str| Err(FormatError::new(ErrorKind::Inconsistent, message.to_owned()));
        let m = &self.model;
        if self.rays == 0 || self.coarse_samples < 4 || self.fine_samples == 0 {
            return fail("`rays`, `coarse_samples` (at least 4) and `fine_samples` must not be 0");
        }
        if !(0.0..=1.0).contains(&self.region_share) {
            return fail("`region_share` must lie between 0 and 1");
        }
        if !(0.0..=1.0).contains(&self.annotated_share) {
            return fail("`annotated_share` must lie between 0 and 1");
        }
        if self.ray_order == RayOrder::Epochs && self.region_share > 0.0 {
            return fail("`ray_order = \"epochs\"` takes every ray once: it goes with `region_share = 0` only");
        }
        if self.checkpoint_every == 0 {
            return fail("`checkpoint_every` must not be 0");
        }
        if !self.interval.is_multiple_of(2) {
            return fail("`interval` must be even: the frame in the middle is held out");
        }
        if m.latent_dims == 0 || m.hyper_dims == 0 || m.hyper_bands == 0 || m.template_bands == 0 {
            return fail("`latent_dims`, `hyper_dims`, `hyper_bands` and `template_bands` must not be 0");
        }
        let coarse = m.mask_coarse.unwrap_or(m.mask).trunk;
        let nets =
            [m.attribute, m.warp, m.sheet, m.template, m.template_coarse, m.mask.trunk, coarse, m.uncertainty.trunk];
        if nets.iter().any(|n| n.depth == 0 || n.width == 0) {
            return fail("every network needs a depth and a width");
        }
        Ok(())
    }
}
