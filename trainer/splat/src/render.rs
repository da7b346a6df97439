//! Pictures of an avatar.

use rayon::prelude::*;
use risorius_formats::{Camera, Isometry};

use crate::bin::Bins;
use crate::model::{Gaussians, LANES, REGIONS};
use crate::project::{Active, active_bases, record};
use crate::raster::{BACKDROP, EXTRAS, Extra, ExtraRow, OPAQUE, TILE_BLOCKS, Tile, column, corner};
use crate::simd::{self, F, Simd, Task};
use crate::skips::Skips;
use crate::view::View;

/// What a picture holds besides its colours.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Outputs {
    /// Expected depth along the optical axis, metres: the head's where the head covers most of what is seen.
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

/// Draws picture after picture of a model, each anew only where it differs from the one before.
#[derive(Debug)]
pub struct Renderer<'a> {
    model: &'a Gaussians,
    skips: Skips,
    /// Per deformable group, a bit for each region whose AUs move it, and one for the latent code.
    moved_by: Vec<u8>,
    /// All groups, or, while the camera stands still and one region's AUs change, those that stay.
    bins: Bins,
    /// The groups that move with the regions of `last`.
    moving: Bins,
    last: Option<Last>,
    tiles: Vec<Tile>,
    extras: Vec<Extra>,
    picture: Picture,
}

/// What the picture before was of.
#[derive(Debug)]
struct Last {
    view: View,
    activations: Vec<f32>,
    backdrop: Option<Vec<u8>>,
    outputs: Outputs,
    /// Regions whose groups are in `moving`; 0 while all are in `bins`.
    regions: u8,
}

/// A row of tiles to be drawn into bytes.
struct DrawRow<'a> {
    bins: &'a Bins,
    /// The Gaussians that are kept apart, if some are.
    moving: Option<&'a Bins>,
    /// Which of the row's tiles to draw; all if this is not said.
    which: Option<&'a [bool]>,
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
        let Self { bins, moving, which, row, columns, width, height, backdrop, rgb, transmittance, tile } = self;
        for column in 0..columns {
            let index = row * columns + column;
            if which.is_some_and(|w| !w[index]) {
                continue;
            }
            match moving {
                Some(moving) => tile.load_both(bins, moving, index, columns),
                None => tile.load::<S>(bins, index, columns),
            }
            tile.composite::<S>(width, height);
            for block in 0..TILE_BLOCKS {
                let (x0, y0) = corner(block);
                let x0 = tile.left + x0;
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

/// The bit of the latent code beside those of the regions.
const CODE: u8 = 1 << REGIONS;

impl<'a> Renderer<'a> {
    /// A renderer of `model` that holds no picture yet.
    pub fn new(model: &'a Gaussians, skips: Skips) -> Self {
        let moved_by = (0..model.deformable)
            .map(|g| {
                let gates = &model.gates[g * REGIONS * LANES..(g + 1) * REGIONS * LANES];
                let moves = |n: usize| gates[n * LANES..(n + 1) * LANES].iter().any(|v| *v > 0.0);
                (0..REGIONS).filter(|&n| moves(n)).fold(CODE, |bits, n| bits | 1 << n)
            })
            .collect();
        Self {
            model,
            skips,
            moved_by,
            bins: Bins::default(),
            moving: Bins::default(),
            last: None,
            tiles: Vec::new(),
            extras: Vec::new(),
            picture: Picture::default(),
        }
    }

    /// The model.
    pub fn model(&self) -> &'a Gaussians {
        self.model
    }

    /// The picture that `camera` takes; `activations` are those of the AUs, then (if there are as many as
    /// [`crate::Layout::bases`]) of the latent code; `backdrop` (row-major RGB bytes of the picture's size) is behind everything.
    pub fn draw(
        &mut self,
        camera: &Camera,
        room_from_head: &Isometry,
        activations: &[f32],
        backdrop: Option<&[u8]>,
        outputs: Outputs,
    ) -> &Picture {
        let view = View::new(camera, room_from_head);
        let backdrop = backdrop.filter(|b| b.len() == view.width * view.height * 3);
        let active = active_bases(&self.model.layout, activations, !self.skips.untouched);
        let same = self.last.take().filter(|l| {
            self.skips.unchanged && l.view == view && l.backdrop.as_deref() == backdrop && l.outputs == outputs
        });
        let changed = same.as_ref().map(|l| self.changed_regions(&l.activations, activations));
        let mut regions = 0;
        match (same, changed) {
            (Some(last), Some(0)) => regions = last.regions,
            (Some(last), Some(now)) if now & CODE == 0 && !outputs.any() => {
                regions = self.edit(&view, &active, backdrop, last.regions, now);
            }
            _ => {
                self.bins.fill(self.model, &view, &active, None);
                self.composite(&view, backdrop, false, None);
                self.picture.depth.clear();
                self.picture.masks.clear();
                self.picture.head.clear();
                if outputs.any() {
                    self.composite_extras(&view, outputs);
                }
            }
        }
        let (activations, backdrop) = (activations.to_vec(), backdrop.map(<[u8]>::to_vec));
        self.last = Some(Last { view, activations, backdrop, outputs, regions });
        &self.picture
    }

    /// A bit for each region with an AU that acts otherwise than before, and for the code.
    fn changed_regions(&self, before: &[f32], now: &[f32]) -> u8 {
        let layout = &self.model.layout;
        let at = |list: &[f32], k: usize| list.get(k).copied().unwrap_or(0.0);
        let region = |k: usize| if k < layout.region_of.len() { layout.reach(k) } else { CODE };
        (0..layout.bases()).filter(|&k| at(before, k) != at(now, k)).fold(0, |bits, k| bits | region(k))
    }

    /// Draws what an edit of the `now` regions' AUs changes; groups that move with them are kept apart from then on.
    fn edit(&mut self, view: &View, active: &[Active], backdrop: Option<&[u8]>, before: u8, now: u8) -> u8 {
        let regions = if now & !before == 0 { before } else { now };
        let apart: Vec<bool> =
            (0..self.model.groups()).map(|g| self.moved_by.get(g).is_some_and(|bits| bits & regions != 0)).collect();
        if regions != before {
            let rest: Vec<bool> = apart.iter().map(|a| !a).collect();
            self.bins.fill(self.model, view, active, Some(&rest));
            self.moving.fill(self.model, view, active, Some(&apart));
            self.composite(view, backdrop, true, None);
            return regions;
        }
        let meets = |bins: &Bins, tile: usize| !bins.entries(tile).is_empty();
        let mut which: Vec<bool> = (0..view.tiles()).map(|t| meets(&self.moving, t)).collect();
        self.moving.fill(self.model, view, active, Some(&apart));
        which.iter_mut().enumerate().for_each(|(t, w)| *w |= meets(&self.moving, t));
        self.composite(view, backdrop, true, Some(&which));
        regions
    }

    fn composite(&mut self, view: &View, backdrop: Option<&[u8]>, apart: bool, which: Option<&[bool]>) {
        let (width, height) = (view.width, view.height);
        let columns = view.columns();
        let rows = height.div_ceil(crate::TILE);
        let picture = &mut self.picture;
        (picture.width, picture.height) = (width, height);
        picture.rgb.resize(width * height * 3, 0);
        picture.transmittance.resize(width * height, 0.0);
        self.tiles.resize_with(rows.max(self.tiles.len()), Tile::default);
        let opaque = if self.skips.hidden { OPAQUE } else { 0.0 };
        self.tiles.iter_mut().for_each(|t| t.opaque = opaque);
        let bins = &self.bins;
        let moving = apart.then_some(&self.moving);
        let band = crate::TILE * width;
        picture
            .rgb
            .par_chunks_mut((band * 3).max(1))
            .zip(picture.transmittance.par_chunks_mut(band.max(1)))
            .zip(&mut self.tiles)
            .enumerate()
            .for_each(|(row, ((rgb, transmittance), tile))| {
                simd::run(DrawRow {
                    bins,
                    moving,
                    which,
                    row,
                    columns,
                    width,
                    height,
                    backdrop,
                    rgb,
                    transmittance,
                    tile,
                });
            });
    }

    fn composite_extras(&mut self, view: &View, outputs: Outputs) {
        let model = self.model;
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
                out[column::MASKS + n] = crate::fit::logistic(model.membership[(g * REGIONS + n) * LANES + lane]);
            }
            out[column::DEPTH] = r[record::DEPTH];
            let head = model.head_weight[slot];
            out[column::HEAD] = head;
            for c in 0..3 {
                out[column::HEAD + 1 + c] = head * r[record::RGB + c];
            }
            out[column::HEAD_DEPTH] = head * r[record::DEPTH];
            out
        };
        let band = (crate::TILE * width).max(1);
        self.extras.par_chunks_mut(band).zip(&mut self.tiles).enumerate().for_each(|(row, (out, tile))| {
            simd::run(ExtraRow { bins, row, columns, width, height, extras: &extras, out, tile });
        });
        let picture = &mut self.picture;
        if outputs.depth {
            let depth = |(e, t): (&Extra, &f32)| {
                let head = e[column::HEAD];
                // Where the head covers half of what is seen, it alone is asked: what shines through from behind is far off.
                match 1.0 - t {
                    covered if head > 0.5 * covered && head > 0.01 => e[column::HEAD_DEPTH] / head,
                    covered if covered > 0.01 => e[column::DEPTH] / covered,
                    _ => 0.0,
                }
            };
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
    let mut renderer = Renderer::new(model, Skips::default());
    renderer.draw(camera, room_from_head, &[], None, Outputs::default());
    renderer.picture.transmittance
}
