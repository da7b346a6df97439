//! What a field is to the rest of the trainer: it is fitted step by step, saved, opened, and takes pictures.
//!
//! ```text
//! dataset ─▶ FieldFit (step, checkpoint, avatar) ─▶ RUN/ ─▶ Field ─▶ FieldRenderer (picture after picture) ─▶ Render
//! ```
//!
//! There are two: [`crate::splat`], the Gaussians, and [`crate::confies`], the paper's networks.

use std::path::Path;

use image::RgbImage;
use risorius_formats::{Camera, Reporter};
use risorius_splat::Skips;
use serde::Serialize;

use crate::error::Result;
use crate::expression::Expression;
use crate::splat::SplatField;

/// What is painted where nothing was fitted.
const BACKDROP: [u8; 3] = [128, 128, 128];

/// What a render holds besides its colours.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Outputs {
    /// [`Render::depth`].
    pub depth: bool,
    /// [`Render::masks`].
    pub masks: bool,
    /// [`Render::head`].
    pub head: bool,
}

/// One rendered picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Render {
    /// The picture.
    pub rgb: RgbImage,
    /// Region mask probabilities, 0–1: N planes of `width · height`; empty unless asked for.
    pub masks: Vec<Vec<f32>>,
    /// Expected depth along the ray, world units; 0 where there is no head; empty unless asked for.
    pub depth: Vec<f32>,
    /// The head alone: colour times opacity, then opacity, 0–1; empty unless asked for. See [`crate::cutout`].
    pub head: Vec<[f32; 4]>,
}

impl Render {
    /// A picture of nothing.
    pub fn empty(camera: &Camera, regions: usize, outputs: Outputs) -> Self {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let count = width as usize * height as usize;
        Self {
            rgb: RgbImage::from_pixel(width, height, image::Rgb(BACKDROP)),
            masks: if outputs.masks { vec![vec![0.0; count]; regions] } else { Vec::new() },
            depth: if outputs.depth { vec![0.0; count] } else { Vec::new() },
            head: if outputs.head { vec![[0.0; 4]; count] } else { Vec::new() },
        }
    }
}

/// A place between two training frames.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Between {
    /// Index of the one.
    pub left: usize,
    /// Index of the other.
    pub right: usize,
    /// 0 at the left, 1 at the right.
    pub t: f32,
}

/// How pictures are taken.
#[derive(Clone, Copy, Debug, Default)]
pub struct Look {
    /// What the Gaussian field leaves out.
    pub skips: Skips,
    /// Whether views finer than the fitted images are rendered pixel by pixel by the paper's networks too, rather than
    /// enlarged.
    pub full: bool,
    /// What renders hold besides colours.
    pub outputs: Outputs,
}

/// A fitted field.
pub trait Field: Send + Sync {
    /// A renderer; it keeps what pictures in succession share.
    fn renderer(&self, skips: Skips) -> Box<dyn FieldRenderer + '_>;

    /// Whether a pixel is so dear that views finer than the fitted images are rendered at the images' size and enlarged.
    fn is_dear(&self) -> bool;

    /// Whether AUs steer it: of the models that CoNFies is compared with, some know codes only.
    fn is_steered(&self) -> bool {
        true
    }

    /// The Gaussians, where the field is made of them.
    fn gaussians(&self) -> Option<&SplatField> {
        None
    }

    /// The regions that an AU acts in, by its number in the table and its own region, which comes first.
    fn regions_of(&self, au: usize, own: usize) -> Vec<usize> {
        let _ = au;
        vec![own]
    }

    /// Renders with codes between those of two training frames and the attributes that the codes themselves give, as the
    /// paper's interpolation test does; `None` for a field whose attributes do not come from codes.
    fn render_between(
        &self,
        camera: &Camera,
        between: Between,
        outputs: Outputs,
        reporter: &dyn Reporter,
    ) -> Result<Option<Render>> {
        let _ = (camera, between, outputs, reporter);
        Ok(None)
    }
}

/// Takes picture after picture of one field. A still camera with another expression draws anew what differs.
pub trait FieldRenderer: Send {
    /// The picture of `camera`, every pixel.
    fn render(
        &mut self,
        camera: &Camera,
        expression: &Expression,
        outputs: Outputs,
        reporter: &dyn Reporter,
    ) -> Result<Render>;
}

/// What a step measured.
#[derive(Clone, Debug)]
pub struct StepReport<N> {
    /// Mean squared colour error.
    pub mse: f64,
    /// Pixels (or rays) that were compared.
    pub pixels: usize,
    /// Numbers that must be finite for the fit to go on.
    pub checked: Vec<(String, f64)>,
    /// The rest of a line of `metrics.jsonl`.
    pub numbers: N,
}

/// A field that is being fitted.
pub trait FieldFit {
    /// What a line of `metrics.jsonl` has besides step, time and PSNR.
    type Numbers: Serialize;

    /// Steps done.
    fn step(&self) -> u64;

    /// Numbers that are learned.
    fn parameters(&self) -> usize;

    /// One step; `done` (0–1) is the share of the fit that lies behind.
    fn advance(&mut self, done: f64) -> Result<StepReport<Self::Numbers>>;

    /// Writes into `folder` all that going on needs.
    fn write_checkpoint(&mut self, folder: &Path) -> Result<()>;

    /// Writes `model.safetensors` and `model.json`; `last` when the fit ends here.
    fn write_avatar(&mut self, run: &Path, last: bool) -> Result<()>;
}
