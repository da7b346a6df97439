//! The settings of a fit: sizes of every network, schedules, loss weights, sampling. Saved as `settings.toml`.
//!
//! `--preset paper` holds the sizes of fact sheet §1 and the schedules of §2.5; `--preset cpu` the same networks,
//! smaller, with a schedule that ends after minutes on two cores.

use risorius_formats::{ErrorKind, FormatError, Result};
use serde::{Deserialize, Serialize};

use crate::schedule::Schedule;

/// Depth and width of a dense network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetSize {
    /// Hidden layers.
    pub depth: usize,
    /// Units per hidden layer.
    pub width: usize,
}

const fn net(depth: usize, width: usize) -> NetSize {
    NetSize { depth, width }
}

/// Hidden layer (from 0) before which a net's input is appended again; nets that are not deeper have no skip.
pub const SKIP_LAYER: usize = 4;

/// A net with a trunk and one more, narrower layer that sees the input again (paper, mask and uncertainty nets).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BranchedSize {
    /// The trunk.
    pub trunk: NetSize,
    /// Width of the last hidden layer, whose input is [trunk output, net input]; 0 leaves it out.
    pub branch: usize,
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

/// Sizes and encodings of the networks (fact sheet §1).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelConfig {
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
    /// Coarse samples per ray.
    pub coarse_samples: usize,
    /// Importance samples per ray; the fine level sees both.
    pub fine_samples: usize,
    /// Spacing of the coarse samples.
    pub spacing: Spacing,
    /// Source of α while fitting.
    pub attributes: AttributeSource,
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

/// Names of the presets.
pub const PRESETS: [&str; 3] = ["cpu", "paper", "tiny"];

impl FitSettings {
    /// The preset of this name.
    pub fn preset(name: &str) -> Result<Self> {
        match name {
            "paper" => Ok(Self::paper()),
            "cpu" => Ok(Self::cpu()),
            "tiny" => Ok(Self::tiny()),
            _ => Err(FormatError::new(ErrorKind::Unsupported, format!("there is no preset `{name}`"))
                .with_hint(format!("presets: {}", PRESETS.join(", ")))),
        }
    }

    /// The paper's sizes with the released code's learning rate (fact sheet §10).
    pub fn paper() -> Self {
        let branched = BranchedSize { trunk: net(4, 128), branch: 64 };
        Self {
            preset: "paper".to_owned(),
            seed: 0,
            steps: 250_000,
            rays: 512,
            region_share: 0.0,
            coarse_samples: 128,
            fine_samples: 128,
            spacing: Spacing::Depth,
            attributes: AttributeSource::Learned,
            image_scale: 0,
            learning_rate: Schedule::Exponential { from: 1e-3, to: 1e-4, steps: 250_000 },
            attribute_weight: Schedule::Exponential { from: 0.1, to: 0.0, steps: 250_000 },
            attribute_cut: 1e-6,
            hyper_window: Schedule::Ramp { delay: 1_000, from: 0.0, to: 1.0, steps: 10_000 },
            warp_window: Schedule::Ramp { delay: 0, from: 0.0, to: 6.0, steps: 80_000 },
            loss: LossWeights { mask: 0.01, latent: 1e-4 },
            checkpoint_every: 1_000,
            model: ModelConfig {
                latent_dims: 128,
                attribute: net(6, 32),
                warp: net(6, 128),
                warp_bands: 6,
                sheet: net(6, 64),
                sheet_bands: 6,
                hyper_dims: 8,
                hyper_bands: 1,
                mask: branched,
                uncertainty: branched,
                template: net(8, 256),
                template_coarse: net(8, 256),
                template_bands: 8,
                view_bands: 4,
                color_width: 128,
                head_radius: 0.0,
            },
        }
    }

    /// Small networks and a schedule of minutes on two cores.
    pub fn cpu() -> Self {
        let steps = 3_000;
        Self {
            preset: "cpu".to_owned(),
            steps,
            rays: 512,
            region_share: 0.3,
            coarse_samples: 24,
            fine_samples: 24,
            spacing: Spacing::Disparity,
            attributes: AttributeSource::Annotated,
            learning_rate: Schedule::Exponential { from: 5e-3, to: 5e-4, steps },
            attribute_weight: Schedule::Exponential { from: 0.1, to: 0.0, steps },
            attribute_cut: 1e-3,
            hyper_window: Schedule::Ramp { delay: 0, from: 0.0, to: 1.0, steps: steps / 20 },
            warp_window: Schedule::Ramp { delay: 0, from: 0.0, to: 4.0, steps: steps / 2 },
            checkpoint_every: 500,
            model: ModelConfig {
                latent_dims: 8,
                attribute: net(3, 32),
                warp: net(3, 32),
                warp_bands: 4,
                sheet: net(2, 16),
                sheet_bands: 5,
                hyper_dims: 2,
                hyper_bands: 1,
                mask: BranchedSize { trunk: net(2, 32), branch: 0 },
                uncertainty: BranchedSize { trunk: net(1, 16), branch: 0 },
                template: net(4, 64),
                template_coarse: net(2, 64),
                template_bands: 8,
                view_bands: 2,
                color_width: 32,
                head_radius: 0.5,
            },
            ..Self::paper()
        }
    }

    /// Networks for tests: seconds, no quality.
    pub fn tiny() -> Self {
        let steps = 60;
        let base = Self::cpu();
        Self {
            preset: "tiny".to_owned(),
            steps,
            rays: 64,
            coarse_samples: 8,
            fine_samples: 8,
            learning_rate: Schedule::Exponential { from: 5e-3, to: 1e-3, steps },
            attribute_weight: Schedule::Exponential { from: 0.1, to: 0.0, steps },
            hyper_window: Schedule::Ramp { delay: 0, from: 0.0, to: 1.0, steps: 10 },
            warp_window: Schedule::Ramp { delay: 0, from: 0.0, to: 4.0, steps: 30 },
            checkpoint_every: 20,
            model: ModelConfig {
                warp: net(2, 16),
                sheet: net(2, 8),
                mask: BranchedSize { trunk: net(1, 16), branch: 0 },
                uncertainty: BranchedSize { trunk: net(1, 8), branch: 0 },
                template: net(2, 32),
                template_coarse: net(2, 32),
                template_bands: 5,
                color_width: 16,
                ..base.model
            },
            ..base
        }
    }

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
        if m.latent_dims == 0 || m.hyper_dims == 0 || m.hyper_bands == 0 || m.template_bands == 0 {
            return fail("`latent_dims`, `hyper_dims`, `hyper_bands` and `template_bands` must not be 0");
        }
        let nets = [m.attribute, m.warp, m.sheet, m.template, m.template_coarse, m.mask.trunk, m.uncertainty.trunk];
        if nets.iter().any(|n| n.depth == 0 || n.width == 0) {
            return fail("every network needs a depth and a width");
        }
        Ok(())
    }
}
