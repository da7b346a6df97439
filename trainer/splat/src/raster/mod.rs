//! Compositing of a tile, 16 pixels at a time.
//!
//! ```text
//! α = o′ 2^(quadratic form),  skipped below 1/255;   C += T α c;   T ← T (1 − α);   stop when all T < 1/500
//! ```
//!
//! A vector is a block of 4×4 pixels. A block takes its Gaussians one after the other with its state in registers; which
//! ones it meets is read off the entries' block masks, 32 at a time.

mod extras;
mod train;

pub(crate) use extras::{EXTRAS, Extra, ExtraRow, WeightRow, column};
pub(crate) use train::{BACKDROP, CHARBONNIER, RowNumbers, Target, TrainRow, train_block};

use crate::TILE;
use crate::bin::{AHEAD, Bins, Line, depth_key};
use crate::project::record;
use crate::simd::{F, M, Row, Simd, exp2_fast, prefetch, test32};

/// Blocks of a tile, column by column.
pub(crate) const TILE_BLOCKS: usize = 16;
/// log2 of 1/255.
const LOG2_LEAST: f32 = -7.994_353_4;
/// What is behind a block that lets no more than this through is hidden.
pub(crate) const OPAQUE: f32 = 2e-3;

/// The first pixel of a block, from the tile's corner.
pub(crate) const fn corner(block: usize) -> (usize, usize) {
    (block / 4 * 4, block % 4 * 4)
}

/// Pixel centres of each block from the tile's corner: x, then y.
pub(crate) static CENTERS: [[Line; 2]; TILE_BLOCKS] = {
    let mut out = [[Line::ZERO; 2]; TILE_BLOCKS];
    let mut block = 0;
    while block < TILE_BLOCKS {
        let (x, y) = corner(block);
        let mut i = 0;
        while i < 16 {
            out[block][0].0[i] = (x + i % 4) as f32 + 0.5;
            out[block][1].0[i] = (y + i / 4) as f32 + 0.5;
            i += 1;
        }
        block += 1;
    }
    out
};

/// Which of a block's pixels lie inside a picture, for the tile at (`left`, `top`).
fn inside(block: usize, left: usize, top: usize, width: usize, height: usize) -> u16 {
    let (x, y) = corner(block);
    let columns = width.saturating_sub(left + x).min(4);
    let rows = height.saturating_sub(top + y).min(4);
    let row = (1u16 << columns) - 1;
    (0..rows).fold(0, |bits, y| bits | row << (4 * y))
}

/// A tile's Gaussians, copied together, and the state of its pixels.
#[derive(Debug)]
pub(crate) struct Tile {
    /// Records of the entries with positions from the tile's corner.
    pub lines: Vec<Line>,
    /// Their block masks, padded to a multiple of 32.
    pub masks: Vec<u16>,
    /// Colours of each block's pixels.
    pub color: [[Line; 3]; TILE_BLOCKS],
    /// What they let through.
    pub transmittance: [Line; TILE_BLOCKS],
    /// Entries that each block has looked at.
    pub stop: [u32; TILE_BLOCKS],
    /// A block is done when none of its pixels lets more than this through; 0 looks at everything.
    pub opaque: f32,
    pub left: usize,
    pub top: usize,
}

impl Default for Tile {
    fn default() -> Self {
        Self {
            lines: Vec::new(),
            masks: Vec::new(),
            color: [[Line::ZERO; 3]; TILE_BLOCKS],
            transmittance: [Line::ZERO; TILE_BLOCKS],
            stop: [0; TILE_BLOCKS],
            opaque: OPAQUE,
            left: 0,
            top: 0,
        }
    }
}

impl Tile {
    /// Copies the entries of tile `index` of two sets of Gaussians, in the order that they would have together.
    pub(crate) fn load_both(&mut self, still: &Bins, moving: &Bins, index: usize, columns: usize) {
        (self.left, self.top) = (index % columns * TILE, index / columns * TILE);
        self.lines.clear();
        self.masks.clear();
        let (mut a, mut b) = (still.entries(index), moving.entries(index));
        let key = |bins: &Bins, at: usize| {
            let slot = bins.slots[at];
            (depth_key(bins.records[slot as usize].0[record::DEPTH]), slot)
        };
        while !(a.is_empty() && b.is_empty()) {
            let still_first = b.is_empty() || (!a.is_empty() && key(still, a.start) < key(moving, b.start));
            let (bins, next) = if still_first { (still, a.next()) } else { (moving, b.next()) };
            let Some(at) = next else { break };
            let mut line = bins.records[bins.slots[at] as usize];
            line.0[record::U] -= self.left as f32;
            line.0[record::V] -= self.top as f32;
            self.lines.push(line);
            self.masks.push(bins.masks[at]);
        }
        self.masks.resize(self.masks.len().next_multiple_of(32), 0);
    }

    /// The first pixel of a block in the picture.
    fn corner(&self, block: usize) -> (usize, usize) {
        let (x, y) = corner(block);
        (self.left + x, self.top + y)
    }

    /// Copies the entries of tile `index`.
    #[inline(always)]
    pub(crate) fn load<S: Simd>(&mut self, bins: &Bins, index: usize, columns: usize) {
        (self.left, self.top) = (index % columns * TILE, index / columns * TILE);
        let entries = bins.entries(index);
        self.lines.clear();
        let slots = &bins.slots[entries.clone()];
        for (i, &slot) in slots.iter().enumerate() {
            if let Some(&later) = slots.get(i + AHEAD) {
                prefetch::<S, Line>(&bins.records, later as usize);
            }
            let mut line = bins.records[slot as usize];
            line.0[record::U] -= self.left as f32;
            line.0[record::V] -= self.top as f32;
            self.lines.push(line);
        }
        self.masks.clear();
        self.masks.extend_from_slice(&bins.masks[entries]);
        self.masks.resize(self.masks.len().next_multiple_of(32), 0);
    }

    /// Composites every block.
    #[inline(always)]
    pub(crate) fn composite<S: Simd>(&mut self, width: usize, height: usize) {
        for block in 0..TILE_BLOCKS {
            let bits = inside(block, self.left, self.top, width, height);
            // Pixels beyond the picture are opaque from the start: they keep nobody waiting.
            let t = M::<S>::from_bits(bits).select(F::splat(1.0), F::splat(0.0));
            if bits == 0 {
                self.stop[block] = 0;
                self.transmittance[block] = Line::ZERO;
                self.color[block] = [Line::ZERO; 3];
                continue;
            }
            self.composite_block::<S>(block, t);
        }
    }

    #[inline(always)]
    fn composite_block<S: Simd>(&mut self, block: usize, mut t: F<S>) {
        let (x, y) = (F::<S>::load(&CENTERS[block][0].0), F::<S>::load(&CENTERS[block][1].0));
        let zero = F::splat(0.0);
        let (mut red, mut green, mut blue) = (zero, zero, zero);
        let mut stop = 0;
        let masks = self.masks.as_chunks::<32>().0;
        for (chunk, lines) in self.lines.chunks(32).enumerate() {
            let mut bits = test32::<S>(&masks[chunk], 1 << block);
            stop += lines.len() as u32;
            while bits != 0 {
                let i = bits.trailing_zeros() as usize;
                bits &= bits - 1;
                let r = &lines[i & 31].0;
                let (dx, dy) = (x - F::splat(r[record::U]), y - F::splat(r[record::V]));
                let e = exponent(r, dx, dy);
                let alpha = exp2_fast(e);
                let w = F::splat(LOG2_LEAST).lt(e).select(t * alpha, zero);
                red = w.fma(F::splat(r[record::RGB]), red);
                green = w.fma(F::splat(r[record::RGB + 1]), green);
                blue = w.fma(F::splat(r[record::RGB + 2]), blue);
                t = t - w;
            }
            if F::splat(self.opaque).lt(t).bits() == 0 {
                break;
            }
        }
        self.stop[block] = stop;
        red.store(&mut self.color[block][0].0);
        green.store(&mut self.color[block][1].0);
        blue.store(&mut self.color[block][2].0);
        t.store(&mut self.transmittance[block].0);
    }
}

/// log2 of a record's opacity at offsets from its centre.
#[inline(always)]
fn exponent<S: Simd>(r: &Row, dx: F<S>, dy: F<S>) -> F<S> {
    let [a, b, c] = [r[record::CONIC], r[record::CONIC + 1], r[record::CONIC + 2]];
    let across = F::splat(a).fma(dx, F::splat(b) * dy);
    dx.fma(across, (F::splat(c) * dy).fma(dy, F::splat(r[record::LOG2_OPACITY])))
}
