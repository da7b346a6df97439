//! One step of a fit, and what it needs to know of those before it.

use risorius_formats::Isometry;
use serde::{Deserialize, Serialize};

use crate::model::Gaussians;
use crate::scene::Scene;
use crate::skips::Skips;

/// What decides a fit, besides the data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Seed of every random draw.
    pub seed: u64,
    /// Gaussians that the fit grows to.
    pub gaussians: usize,
    /// What is left out.
    pub skips: Skips,
}

impl Default for Settings {
    fn default() -> Self {
        Self { seed: 0, gaussians: 80_000, skips: Skips::default() }
    }
}

/// How far a fit is.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Steps done.
    pub step: u64,
    /// Densifications done.
    pub densified: u32,
}

/// What a step measured.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct StepNumbers {
    /// Pixels compared.
    pub pixels: usize,
    /// Mean squared colour error.
    pub color: f64,
    /// Mean squared mask error.
    pub mask: f64,
    /// Mean of eq. 17 over the annotated AUs.
    pub attribute: f64,
    /// Gaussians there are.
    pub gaussians: usize,
    /// Gaussians in the picture.
    pub visible: usize,
    /// Pairs of a Gaussian and a tile.
    pub pairs: usize,
}

/// Numbers of each training image: its AU offsets (α), uncertainties (log β), latent code, head and camera corrections.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PerImage {
    /// `[images][AUs]`, added to the annotated activations.
    pub alphas: Vec<f32>,
    /// `[images][AUs]`.
    pub log_betas: Vec<f32>,
    /// `[images][LATENT]`.
    pub codes: Vec<f32>,
    /// `[images][6]`: rotation vector (radians) and translation (metres) of the head against its first pose.
    pub head_motions: Vec<f32>,
    /// `[images][6]`: the same of the camera.
    pub camera_motions: Vec<f32>,
}

/// A fit in progress.
#[derive(Debug)]
pub struct Fitter {
    /// The avatar.
    pub model: Gaussians,
    /// What belongs to single images.
    pub images: PerImage,
    /// What decides the fit.
    pub settings: Settings,
    /// How far it is.
    pub progress: Progress,
    /// Head pose per frame before corrections.
    pub head_poses: Vec<Isometry>,
}

impl Fitter {
    /// Begins a fit; `say` is told what takes long. The scene is looked at by all threads of the pool.
    pub fn new(scene: &Scene<'_>, settings: Settings, say: &dyn Fn(&str)) -> Self {
        let _ = (scene, settings, say);
        unimplemented!("being written")
    }

    /// One step; `done` (0–1) is the share of the fit that lies behind, which sets rates, size and growth.
    pub fn step(&mut self, scene: &Scene<'_>, done: f32) -> StepNumbers {
        let _ = (scene, done);
        unimplemented!("being written")
    }

    /// Every array that a checkpoint holds, by name; [`Self::restore`] takes them back. Moments included.
    pub fn arrays(&self) -> Vec<(&'static str, &[f32])> {
        unimplemented!("being written")
    }

    /// A fit that goes on from the arrays of a checkpoint.
    pub fn restore(
        layout: crate::Layout,
        settings: Settings,
        progress: Progress,
        head_poses: Vec<Isometry>,
        arrays: &mut dyn FnMut(&str) -> Result<Vec<f32>, String>,
    ) -> Result<Self, String> {
        let _ = (layout, settings, progress, head_poses, arrays);
        unimplemented!("being written")
    }

    /// The avatar as it is to be saved: without what only the fit needs, with what is beyond the views filled in.
    pub fn avatar(&self) -> Gaussians {
        self.model.clone()
    }
}
