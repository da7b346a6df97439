//! The presets: the paper's words, the released code, a small one for two cores, and one for tests.

use risorius_formats::{ErrorKind, FormatError, Result};

use super::{
    AttributeSource, BranchedSize, FitSettings, LossWeights, MaskRendering, ModelConfig, ModelKind, NetSize, RayOrder,
    RestMask, Spacing,
};
use crate::kernel::Products;
use crate::schedule::Schedule;

const fn net(depth: usize, width: usize) -> NetSize {
    NetSize { depth, width }
}

/// A net of one trunk.
const fn plain(depth: usize, width: usize) -> BranchedSize {
    BranchedSize { trunk: net(depth, width), branch: 0, branch_skip: false }
}

/// Names of the presets.
pub const PRESETS: [&str; 4] = ["cpu", "paper", "code", "tiny"];

impl FitSettings {
    /// The preset of this name.
    pub fn preset(name: &str) -> Result<Self> {
        match name {
            "paper" => Ok(Self::paper()),
            "code" => Ok(Self::code()),
            "cpu" => Ok(Self::cpu()),
            "tiny" => Ok(Self::tiny()),
            _ => Err(FormatError::new(ErrorKind::Unsupported, format!("there is no preset `{name}`"))
                .with_hint(format!("presets: {}", PRESETS.join(", ")))),
        }
    }

    /// The paper's words; where it is silent, the released code (fact sheet §0 and §1.14).
    pub fn paper() -> Self {
        let branched = BranchedSize { trunk: net(4, 128), branch: 64, branch_skip: true };
        Self {
            preset: "paper".to_owned(),
            seed: 0,
            steps: 250_000,
            rays: 512,
            region_share: 0.0,
            annotated_share: 0.0,
            ray_order: RayOrder::Epochs,
            micro_rays: 0,
            recompute: false,
            interval: 0,
            coarse_samples: 128,
            fine_samples: 128,
            spacing: Spacing::Depth,
            attributes: AttributeSource::Learned,
            mask_rendering: MaskRendering::Probabilities,
            image_scale: 0,
            learning_rate: Schedule::Exponential { from: 1e-4, to: 1e-5, steps: 250_000 },
            attribute_weight: Schedule::Exponential { from: 0.1, to: 0.0, steps: 250_000 },
            attribute_cut: 1e-6,
            hyper_window: Schedule::Ramp { delay: 1_000, from: 0.0, to: 1.0, steps: 10_000 },
            warp_window: Schedule::Ramp { delay: 0, from: 0.0, to: 6.0, steps: 80_000 },
            loss: LossWeights { mask: 0.01, latent: 1e-4 },
            checkpoint_every: 1_000,
            model: ModelConfig {
                kind: ModelKind::Confies,
                latent_dims: 128,
                attribute: net(6, 32),
                warp: net(6, 128),
                warp_bands: 6,
                sheet: net(6, 64),
                sheet_bands: 6,
                hyper_dims: 8,
                hyper_bands: 1,
                mask: branched,
                mask_coarse: None,
                rest_mask: RestMask::Plain,
                uncertainty: branched,
                template: net(8, 256),
                template_coarse: net(8, 256),
                template_bands: 8,
                view_bands: 4,
                color_width: 128,
                head_radius: 0.0,
                products: Products::F32,
            },
        }
    }

    /// What the released code runs with its shipped configuration at K = 17, N = 3, slips included.
    pub fn code() -> Self {
        let paper = Self::paper();
        Self {
            preset: "code".to_owned(),
            annotated_share: 0.5,
            mask_rendering: MaskRendering::Logits,
            learning_rate: Schedule::Exponential { from: 1e-3, to: 1e-4, steps: 250_000 },
            model: ModelConfig {
                mask_coarse: Some(BranchedSize { trunk: net(8, 256), branch: 128, branch_skip: false }),
                mask: BranchedSize { trunk: net(1, 128), branch: 128, branch_skip: false },
                rest_mask: RestMask::Clipped,
                uncertainty: BranchedSize { trunk: net(2, 256), branch: 128, branch_skip: false },
                ..paper.model
            },
            ..paper
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
            ray_order: RayOrder::Independent,
            coarse_samples: 24,
            fine_samples: 24,
            spacing: Spacing::Disparity,
            attributes: AttributeSource::Annotated,
            mask_rendering: MaskRendering::Logits,
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
                mask: plain(2, 32),
                rest_mask: RestMask::Clipped,
                uncertainty: plain(1, 16),
                template: net(4, 64),
                template_coarse: net(2, 64),
                template_bands: 8,
                view_bands: 2,
                color_width: 32,
                head_radius: 0.5,
                products: Products::F32,
                ..Self::paper().model
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
                mask: plain(1, 16),
                uncertainty: plain(1, 8),
                template: net(2, 32),
                template_coarse: net(2, 32),
                template_bands: 5,
                color_width: 16,
                ..base.model
            },
            ..base
        }
    }

    /// The same settings for another model of the paper's Table 2 (fact sheet §2.7): what a model lacks has no size,
    /// and CoNeRF's attribute loss keeps its weight.
    #[must_use]
    pub fn with_model(mut self, kind: ModelKind) -> Self {
        self.model.kind = kind;
        match kind {
            ModelKind::Confies => {}
            ModelKind::Conerf | ModelKind::ConerfM => {
                self.attribute_weight = Schedule::Constant { value: 0.1 };
                self.annotated_share = self.annotated_share.min(0.1);
                self.mask_rendering = MaskRendering::Logits;
                self.model.rest_mask = RestMask::Clipped;
            }
            ModelKind::Hypernerf
            | ModelKind::HypernerfAp
            | ModelKind::Nerfies
            | ModelKind::NerfLatent
            | ModelKind::Nerf => {
                self.annotated_share = 0.0;
            }
        }
        self
    }
}
