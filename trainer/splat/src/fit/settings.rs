//! What decides a fit, besides the data.

use serde::{Deserialize, Serialize};

use crate::skips::Skips;

/// What decides a fit, besides the data. Shares are of the fit's length.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Seed of every random draw.
    pub seed: u64,
    /// Gaussians that the fit grows to.
    pub gaussians: usize,
    /// Share of them that a fit begins with (at least 0.05 is taken); the others grow where pictures ask for them.
    pub seed_share: f32,
    /// Edge of the voxels that depth maps are fused in: head, background, millimetres.
    pub voxel_mm: [f32; 2],
    /// Share of the fit at reduced size.
    pub coarse_share: f32,
    /// Learning rate of means, pixels a step at the Gaussian's distance.
    pub mean_px: f32,
    /// Share of it that is left at the end.
    pub mean_final: f32,
    /// How much faster the depth axis moves: times distance over the cameras' spread.
    pub depth_factor: f32,
    /// Learning rate of the deltas of means against that of means.
    pub delta_factor: f32,
    /// Learning rate of log scales.
    pub log_scale_rate: f32,
    /// Learning rate of quaternions.
    pub quaternion_rate: f32,
    /// Learning rate of opacities (before the logistic function).
    pub opacity_rate: f32,
    /// Learning rate of colours and their deltas.
    pub color_rate: f32,
    /// Learning rate of spherical harmonics of degree 1.
    pub sh_rate: f32,
    /// Share of these rates that is left at the end.
    pub final_rate: f32,
    /// Times that Gaussians are split and pruned, and between which shares of the fit.
    pub densifications: u32,
    /// When the first and the last of them come.
    pub densify_between: [f32; 2],
    /// Gaussians less opaque than this are removed.
    pub prune_opacity: f32,
    /// Whether each image has a latent code for what no AU tells.
    pub latent: bool,
    /// Share of the steps in which codes act. In the others the AUs alone explain the picture.
    pub code_share: f32,
    /// Weight of ‖ω‖².
    pub latent_weight: f32,
    /// Learning rate of the codes.
    pub code_rate: f32,
    /// Weight of eq. 17, first and last.
    pub attribute_weight: [f32; 2],
    /// Learning rate of α and log β.
    pub image_rate: f32,
    /// Whether the poses of a head that sways against its room are corrected by the pictures.
    pub refine_poses: bool,
    /// Whether each image has a gain per channel, for light and exposure that change.
    pub refine_light: bool,
    /// Every so many steps fits the memberships to the region masks; 0 never.
    pub mask_every: u64,
    /// Learning rate of memberships.
    pub mask_rate: f32,
    /// What is left out.
    pub skips: Skips,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            seed: 0,
            gaussians: 80_000,
            seed_share: 0.5,
            voxel_mm: [2.4, 6.0],
            coarse_share: 0.15,
            mean_px: 0.3,
            mean_final: 0.02,
            depth_factor: 0.75,
            delta_factor: 0.25,
            log_scale_rate: 8e-3,
            quaternion_rate: 4e-3,
            opacity_rate: 2e-2,
            color_rate: 8e-3,
            sh_rate: 1e-3,
            final_rate: 0.1,
            densifications: 8,
            densify_between: [0.06, 0.5],
            prune_opacity: 0.02,
            latent: true,
            code_share: 0.5,
            latent_weight: 1e-2,
            code_rate: 1e-2,
            attribute_weight: [0.1, 0.01],
            image_rate: 1e-3,
            refine_poses: true,
            refine_light: true,
            mask_every: 32,
            mask_rate: 0.05,
            skips: Skips::default(),
        }
    }
}
