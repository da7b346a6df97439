//! What decides a fit, besides the data.

use serde::{Deserialize, Serialize};

use crate::rays::Prior;
use crate::skips::Skips;

/// What decides a fit, besides the data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
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
    /// Samples with a smaller gradient go the way back by lot, see [`crate::evaluate::Lot`].
    pub faint: f32,
    /// Weight of the masks.
    pub mask_weight: f32,
    /// Weight of eq. 17, first and last.
    pub attribute_weight: [f32; 2],
    /// Weight of ‖ω‖².
    pub latent_weight: f32,
    /// Whether each image has a code of its own.
    pub latent: bool,
    /// Share of a step's images whose codes act. The others are explained by their AUs alone, or the codes would take over,
    /// slowly, what AUs do.
    pub code_share: f32,
    /// Whether each camera may move a little.
    pub refine_cameras: bool,
    /// Finest divisions of the head box and planes of the background.
    pub finest: [usize; 2],
    /// Planes of the background in the last stage. While it is fog, surfaces form where planes are; once it is thin, fewer
    /// planes show the same, and what they save goes to more rays, and to pictures.
    pub settled_planes: usize,
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
            faint: 5e-4,
            mask_weight: 0.01,
            attribute_weight: [0.1, 0.01],
            latent_weight: 1e-2,
            latent: true,
            code_share: 0.5,
            refine_cameras: false,
            finest: [160, 160],
            settled_planes: 64,
            skips: Skips::default(),
        }
    }
}

impl Settings {
    /// Whether the code of a step's image of this number acts.
    pub(super) fn is_coded(&self, number: u64) -> bool {
        (number as f32) < self.code_share * self.images as f32
    }

    pub(super) fn prior(&self, stage: usize) -> [Prior; 2] {
        let haze = self.haze[usize::from(stage >= 3)];
        let spread = if stage >= 1 { self.spread } else { [0.0; 2] };
        [Prior { haze, spread: spread[0] }, Prior { haze: haze * 0.2, spread: spread[1] }]
    }
}
