//! Pictures of an avatar.

use rayon::prelude::*;
use risorius_formats::{Camera, Isometry};

use crate::bin::Bins;
use crate::model::{Gaussians, LANES, REGIONS};
use crate::project::{Active, active_bases, record};
use crate::raster::{BACKDROP, EXTRAS, Extra, ExtraRow, TILE_BLOCKS, Tile, column};
use crate::simd::{self, F, Simd, Task};
use crate::skips::Skips;
use crate::view::View;

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

impl Outputs {
    fn any(self) -> bool {
        self.depth || self.masks || self.head
    }
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
    bins: Bins,
    tiles: Vec<Tile>,
    extras: Vec<Extra>,
    picture: Picture,
}

/// A row of tiles to be drawn into bytes.
struct DrawRow<'a> {
    bins: &'a Bins,
    row: usize,
    columns: usize,
    width: usize,
    height: usize,
    backdrop: Option<&'a [u8]>,
    rgb: &'a mut [u8],
    transmittance: &'a mut [f32],
    tile: &'a mut Tile,
}

impl Task for DrawRow<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self) {
        let Self { bins, row, columns, width, height, backdrop, rgb, transmittance, tile } = self;
        for column in 0..columns {
            let index = row * columns + column;
            tile.load(bins, index, columns);
            tile.composite::<S>(width, height);
            for block in 0..TILE_BLOCKS {
                let (x0, y0) = (tile.left + block % 4 * 4, block / 4 * 4);
                if x0 >= width || tile.top + y0 >= height {
                    continue;
                }
                let t = F::<S>::load(&tile.transmittance[block].0);
                let through = t.array();
                let mut color = [[0.0f32; 16]; 3];
                for c in 0..3 {
                    let own = F::load(&tile.color[block][c].0);
                    let own = if backdrop.is_some() { own } else { t.fma(F::splat(BACKDROP), own) };
                    (own.max(F::splat(0.0)).min(F::splat(1.0)) * 255.0 + F::splat(0.5)).store(&mut color[c]);
                }
                for i in 0..16 {
                    let (x, y) = (x0 + i % 4, y0 + i / 4);
                    if x >= width || tile.top + y >= height {
                        continue;
                    }
                    let at = y * width + x;
                    transmittance[at] = through[i];
                    for c in 0..3 {
                        let behind = backdrop
                            .map_or(0.0, |b| through[i] * f32::from(b[((row * crate::TILE + y) * width + x) * 3 + c]));
                        rgb[at * 3 + c] = (color[c][i] + behind) as u8;
                    }
                }
            }
        }
    }
}

impl Renderer {
    /// A renderer that holds nothing yet.
    pub fn new(skips: Skips) -> Self {
        Self { skips, ..Self::default() }
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
        let view = View::new(camera, room_from_head);
        let active = active_bases(&model.layout, activations);
        self.bins.fill(model, &view, &active);
        self.composite(&view, backdrop);
        self.picture.depth.clear();
        self.picture.masks.clear();
        self.picture.head.clear();
        if outputs.any() {
            self.composite_extras(model, &view, outputs);
        }
        &self.picture
    }

    fn composite(&mut self, view: &View, backdrop: Option<&[u8]>) {
        let (width, height) = (view.width, view.height);
        let columns = view.columns();
        let rows = height.div_ceil(crate::TILE);
        let picture = &mut self.picture;
        (picture.width, picture.height) = (width, height);
        picture.rgb.resize(width * height * 3, 0);
        picture.transmittance.resize(width * height, 0.0);
        self.tiles.resize_with(rows.max(self.tiles.len()), Tile::default);
        let bins = &self.bins;
        let band = crate::TILE * width;
        picture
            .rgb
            .par_chunks_mut((band * 3).max(1))
            .zip(picture.transmittance.par_chunks_mut(band.max(1)))
            .zip(&mut self.tiles)
            .enumerate()
            .for_each(|(row, ((rgb, transmittance), tile))| {
                simd::run(DrawRow { bins, row, columns, width, height, backdrop, rgb, transmittance, tile });
            });
    }

    fn composite_extras(&mut self, model: &Gaussians, view: &View, outputs: Outputs) {
        let (width, height) = (view.width, view.height);
        let columns = view.columns();
        self.extras.resize(width * height, [0.0; EXTRAS]);
        let bins = &self.bins;
        let extras = |slot: u32| {
            let slot = slot as usize;
            let (g, lane) = (slot / LANES, slot % LANES);
            let r = &bins.records[slot].0;
            let mut out = [0.0; EXTRAS];
            for n in 0..model.layout.regions.min(REGIONS) {
                out[column::MASKS + n] =
                    crate::fit::logistic(model.membership[(g * REGIONS + n) * LANES + lane]);
            }
            out[column::DEPTH] = r[record::DEPTH];
            let head = model.head_weight[slot];
            out[column::HEAD] = head;
            for c in 0..3 {
                out[column::HEAD + 1 + c] = head * r[record::RGB + c];
            }
            out
        };
        let band = (crate::TILE * width).max(1);
        self.extras.par_chunks_mut(band).zip(&mut self.tiles).enumerate().for_each(|(row, (out, tile))| {
            simd::run(ExtraRow { bins, row, columns, width, height, extras: &extras, out, tile });
        });
        let picture = &mut self.picture;
        if outputs.depth {
            let depth = |(e, t): (&Extra, &f32)| if *t < 0.99 { e[column::DEPTH] / (1.0 - t) } else { 0.0 };
            picture.depth.extend(self.extras.iter().zip(&picture.transmittance).map(depth));
        }
        if outputs.masks {
            let mask = |n: usize| self.extras.iter().map(|e| e[column::MASKS + n].clamp(0.0, 1.0)).collect();
            picture.masks.extend((0..model.layout.regions).map(mask));
        }
        if outputs.head {
            let head = |e: &Extra| [e[column::HEAD + 1], e[column::HEAD + 2], e[column::HEAD + 3], e[column::HEAD]];
            picture.head.extend(self.extras.iter().map(head));
        }
    }
}

/// What each pixel of a picture without expression lets through.
pub(crate) fn transmittance(model: &Gaussians, camera: &Camera, room_from_head: &Isometry) -> Vec<f32> {
    let mut renderer = Renderer::default();
    let none: &[Active] = &[];
    let view = View::new(camera, room_from_head);
    renderer.bins.fill(model, &view, none);
    renderer.composite(&view, None);
    std::mem::take(&mut renderer.picture.transmittance)
}
