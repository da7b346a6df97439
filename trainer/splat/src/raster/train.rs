//! A row of tiles in a training step: compositing, loss, and the backward pass down to nine sums per entry.
//!
//! The loss is Charbonnier's, Σ √(d² + 0.1²) over pixels and channels. The backward pass runs front to back with
//! A = g · (C_final − C so far): `w = Tα; A −= w (g·c); ∂α = T (g·c) − A/(1 − α); q = α ∂α`. The sums of an entry are
//! Σq, Σq dx, Σq dy, Σq dx², Σq dx dy, Σq dy², Σw g: all 2D gradients follow from them (see [`crate::update`]).

use super::{CENTERS, LOG2_LEAST, TILE_BLOCKS, Tile, exponent};
use crate::TILE;
use crate::bin::{Bins, Line};
use crate::project::record;
use crate::simd::{F, Simd, Task, exp2_fast, greater, sums8};

/// ε of the loss, in colours of 0–1.
pub(crate) const CHARBONNIER: f32 = 0.1;
/// What is behind everything where nothing else is known.
pub(crate) const BACKDROP: f32 = 0.5;

/// What a picture is compared with.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Target<'a> {
    /// RGB bytes at full size, row by row.
    pub rgb: &'a [u8],
    /// Non-zero where a pixel counts.
    pub valid: Option<&'a [u8]>,
    /// RGB bytes behind everything.
    pub backdrop: Option<&'a [u8]>,
    /// Pixels along a row at full size.
    pub width: usize,
    /// How many times the picture is smaller than `rgb`: its pixels are compared with means of `reduce`².
    pub reduce: usize,
    /// What the scene's colours are multiplied by before they are compared: the light and the exposure of this image.
    pub gain: [f32; 3],
}

impl Target<'_> {
    /// Any block of 4×4 pixels at (x, y) of a picture of `width` × `height`; pixels beyond it do not count.
    #[inline(always)]
    fn block<S: Simd>(&self, x: usize, y: usize, width: usize, height: usize) -> Pixels<S> {
        let (mut rgb, mut backdrop, mut counts) = ([[0.0f32; 16]; 3], [[0.0f32; 16]; 3], [0.0f32; 16]);
        for i in 0..16 {
            let (x, y) = (x + i % 4, y + i / 4);
            if x < width && y < height {
                let (color, weight, behind) = self.pixel(x, y);
                for c in 0..3 {
                    rgb[c][i] = color[c];
                    backdrop[c][i] = behind[c];
                }
                counts[i] = weight;
            }
        }
        let [red, green, blue] = &rgb;
        let [behind_red, behind_green, behind_blue] = &backdrop;
        Pixels {
            rgb: [F::load(red), F::load(green), F::load(blue)],
            backdrop: [F::load(behind_red), F::load(behind_green), F::load(behind_blue)],
            counts: F::load(&counts),
        }
    }

    /// The colours of the pixel (x, y) of the reduced picture, 0–1.
    pub(crate) fn color(&self, x: usize, y: usize) -> [f32; 3] {
        self.pixel(x, y).0
    }

    /// Colours (0–1) and whether they count, backdrop: of the pixel (x, y) of the reduced picture.
    #[inline(always)]
    fn pixel(&self, x: usize, y: usize) -> ([f32; 3], f32, [f32; 3]) {
        let s = self.reduce;
        if s == 1 && self.valid.is_none() && self.backdrop.is_none() {
            let at = (y * self.width + x) * 3;
            let p = &self.rgb[at..at + 3];
            return (std::array::from_fn(|c| f32::from(p[c]) * (1.0 / 255.0)), 1.0, [BACKDROP; 3]);
        }
        let (mut sum, mut behind, mut counts) = ([0u32; 3], [0u32; 3], true);
        for dy in 0..s {
            for dx in 0..s {
                let at = (y * s + dy) * self.width + x * s + dx;
                let p = &self.rgb[at * 3..at * 3 + 3];
                for c in 0..3 {
                    sum[c] += u32::from(p[c]);
                }
                if let Some(backdrop) = self.backdrop {
                    for c in 0..3 {
                        behind[c] += u32::from(backdrop[at * 3 + c]);
                    }
                }
                counts &= self.valid.is_none_or(|v| v[at] != 0);
            }
        }
        let scale = 1.0 / (255.0 * (s * s) as f32);
        let behind = if self.backdrop.is_some() { behind.map(|v| v as f32 * scale) } else { [BACKDROP; 3] };
        (sum.map(|v| v as f32 * scale), f32::from(u8::from(counts)), behind)
    }
}

/// A block of 4×4 pixels of a target.
struct Pixels<S: Simd> {
    /// Colours, 0–1.
    rgb: [F<S>; 3],
    /// What is behind them.
    backdrop: [F<S>; 3],
    /// 1 where a pixel counts, else 0.
    counts: F<S>,
}

/// What a row of tiles measured.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct RowNumbers {
    /// Pixels that count.
    pub pixels: usize,
    /// Sum of squared errors over channels.
    pub squared: f64,
    /// Slope of the loss along the logarithm of each gain, and its curvature with the loss' weights held.
    pub light: [[f64; 2]; 3],
}

impl RowNumbers {
    /// The numbers of both.
    pub(crate) fn and(mut self, other: &Self) -> Self {
        self.pixels += other.pixels;
        self.squared += other.squared;
        let own = self.light.as_flattened_mut();
        own.iter_mut().zip(other.light.as_flattened()).for_each(|(a, b)| *a += b);
        self
    }
}

/// A row of tiles.
pub(crate) struct TrainRow<'a> {
    pub bins: &'a Bins,
    pub target: &'a Target<'a>,
    pub row: usize,
    pub columns: usize,
    pub width: usize,
    pub height: usize,
    /// One line per entry of the row.
    pub sums: &'a mut [Line],
    pub tile: &'a mut Tile,
}

impl Task for TrainRow<'_> {
    type Output = RowNumbers;
    #[inline(always)]
    fn run<S: Simd>(self) -> RowNumbers {
        let Self { bins, target, row, columns, width, height, sums, tile } = self;
        let mut numbers = RowNumbers::default();
        let first = bins.entries(row * columns).start;
        for column in 0..columns {
            let index = row * columns + column;
            tile.load::<S>(bins, index, columns);
            tile.composite::<S>(width, height);
            let mut states = loss::<S>(tile, target, width, height, &mut numbers);
            let entries = bins.entries(index);
            backward::<S>(tile, &mut states, &mut sums[entries.start - first..entries.end - first]);
        }
        numbers
    }
}

/// What the backward pass knows of a block's pixels, side by side: arrays of their own would lie at distances where stores
/// and loads of different blocks look alike to the processor (4 KiB aliasing).
#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct BlockState {
    /// What is let through so far.
    t: Line,
    /// A: g · (C − C so far).
    a: Line,
    /// ∂L/∂C.
    g: [Line; 3],
}

impl BlockState {
    const ZERO: Self = Self { t: Line::ZERO, a: Line::ZERO, g: [Line::ZERO; 3] };
}

#[inline(always)]
fn loss<S: Simd>(
    tile: &mut Tile,
    target: &Target<'_>,
    width: usize,
    height: usize,
    numbers: &mut RowNumbers,
) -> [BlockState; TILE_BLOCKS] {
    let mut out = [BlockState::ZERO; TILE_BLOCKS];
    for block in 0..TILE_BLOCKS {
        let (x0, y0) = tile.corner(block);
        let Pixels { rgb, backdrop, counts } = target.block::<S>(x0, y0, width, height);
        let t = F::load(&tile.transmittance[block].0);
        let (mut a, mut squared) = (F::splat(0.0), F::splat(0.0));
        for c in 0..3 {
            let gain = F::splat(target.gain[c]);
            let lit = t.fma(backdrop[c], F::load(&tile.color[block][c].0)) * gain;
            let d = (lit - rgb[c]) * counts;
            let weight = counts.over(d.fma(d, F::splat(CHARBONNIER * CHARBONNIER)).sqrt());
            let g = d * weight;
            squared = d.fma(d, squared);
            let slope = g * lit;
            a += slope;
            numbers.light[c][0] += f64::from(slope.sum());
            numbers.light[c][1] += f64::from((weight * lit * lit).sum());
            (g * gain).store(&mut out[block].g[c].0);
        }
        a.store(&mut out[block].a.0);
        numbers.squared += f64::from(squared.sum());
        numbers.pixels += counts.sum() as usize;
    }
    out
}

/// The backward pass of a composited tile with a gradient of one half everywhere, for measurements.
#[inline(always)]
pub(crate) fn train_block<S: Simd>(tile: &mut Tile, sums: &mut [Line]) {
    let half = Line([0.5; 16]);
    let mut states = [BlockState { t: Line::ZERO, a: half, g: [half; 3] }; TILE_BLOCKS];
    backward::<S>(tile, &mut states, sums);
}

#[inline(always)]
fn backward<S: Simd>(tile: &mut Tile, states: &mut [BlockState; TILE_BLOCKS], sums: &mut [Line]) {
    let zero = F::<S>::splat(0.0);
    let one = F::<S>::splat(1.0);
    for (state, &stop) in states.iter_mut().zip(&tile.stop) {
        state.t = Line([if stop > 0 { 1.0 } else { 0.0 }; 16]);
    }
    for (entry, (line, sums)) in tile.lines.iter().zip(sums).enumerate() {
        // Blocks that stopped before this entry take no part.
        let alive = greater::<S>(&tile.stop, entry as u32);
        let mut bits = tile.masks[entry] & alive;
        if bits == 0 {
            *sums = Line::ZERO;
            continue;
        }
        let r = &line.0;
        let (u, v) = (F::<S>::splat(r[record::U]), F::<S>::splat(r[record::V]));
        let (red, green, blue) = (F::splat(r[record::RGB]), F::splat(r[record::RGB + 1]), F::splat(r[record::RGB + 2]));
        let mut s = [zero; 8];
        let mut last = zero;
        while bits != 0 {
            let block = bits.trailing_zeros() as usize & (TILE_BLOCKS - 1);
            bits &= bits - 1;
            let [x, y] = &CENTERS[block];
            let (dx, dy) = (F::load(&x.0) - u, F::load(&y.0) - v);
            let e = exponent(r, dx, dy);
            let alpha = exp2_fast(e);
            let drawn = F::splat(LOG2_LEAST).lt(e);
            let state = &mut states[block];
            let (g_red, g_green, g_blue) = (F::load(&state.g[0].0), F::load(&state.g[1].0), F::load(&state.g[2].0));
            let through = F::load(&state.t.0);
            let color = g_red.fma(red, g_green.fma(green, g_blue * blue));
            let w = drawn.select(through * alpha, zero);
            let behind = w.fnma(color, F::load(&state.a.0));
            behind.store(&mut state.a.0);
            (through - w).store(&mut state.t.0);
            let d_alpha = behind.fnma((one - alpha).reciprocal_rough(), through * color);
            let q = drawn.select(alpha * d_alpha, zero);
            let (qx, qy) = (q * dx, q * dy);
            s[0] += q;
            s[1] += qx;
            s[2] += qy;
            s[3] = qx.fma(dx, s[3]);
            s[4] = qx.fma(dy, s[4]);
            s[5] = qy.fma(dy, s[5]);
            s[6] = w.fma(g_red, s[6]);
            s[7] = w.fma(g_green, s[7]);
            last = w.fma(g_blue, last);
        }
        sums.0[..8].copy_from_slice(&sums8(&s));
        sums.0[8] = last.sum();
    }
}

const _: () = assert!(TILE == 16, "a block is a vector of 4×4 pixels, 16 of them a tile");
