//! What a picture tells besides colours: values of Gaussians composited with the colours' weights (depth, region
//! memberships, the head's share), and the gradient of such values.

use super::{LOG2_LEAST, TILE_BLOCKS, Tile, exponent};
use crate::bin::{Bins, Line};
use crate::project::record;
use crate::raster::{CENTERS, corner};
use crate::simd::{F, Simd, Task, exp2_fast};

/// Values per Gaussian that go together.
pub(crate) const EXTRAS: usize = 9;
/// Where they stand.
pub(crate) mod column {
    /// Region memberships, 0–1.
    pub(crate) const MASKS: usize = 0;
    /// Depth, metres.
    pub(crate) const DEPTH: usize = 3;
    /// The head's share, its share times red, green, blue, and its share times depth.
    pub(crate) const HEAD: usize = 4;
    pub(crate) const HEAD_DEPTH: usize = 8;
}

/// The values of a Gaussian, by slot.
pub(crate) type Extra = [f32; EXTRAS];

/// A row of tiles to be composited with extras, into row-major pixels.
pub(crate) struct ExtraRow<'a> {
    pub bins: &'a Bins,
    pub row: usize,
    pub columns: usize,
    pub width: usize,
    pub height: usize,
    /// The values of a slot.
    pub extras: &'a (dyn Fn(u32) -> Extra + Sync),
    /// The row's pixels.
    pub out: &'a mut [Extra],
    pub tile: &'a mut Tile,
}

impl Task for ExtraRow<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self) {
        let Self { bins, row, columns, width, height, extras, out, tile } = self;
        let mut values: Vec<Extra> = Vec::new();
        for column in 0..columns {
            let index = row * columns + column;
            tile.load::<S>(bins, index, columns);
            values.clear();
            values.extend(bins.slots[bins.entries(index)].iter().map(|&s| extras(s)));
            for block in 0..TILE_BLOCKS {
                let sums = block_extras::<S>(tile, block, &values);
                let (x0, y0) = corner(block);
                let x0 = tile.left + x0;
                for i in 0..16 {
                    let (x, y) = (x0 + i % 4, y0 + i / 4);
                    if x < width && tile.top + y < height {
                        out[y * width + x] = std::array::from_fn(|n| sums[n].0[i]);
                    }
                }
            }
        }
    }
}

/// Σ w · value of each block's pixels.
#[inline(always)]
fn block_extras<S: Simd>(tile: &Tile, block: usize, values: &[Extra]) -> [Line; EXTRAS] {
    let mut sums = [F::<S>::splat(0.0); EXTRAS];
    weights::<S>(tile, block, |entry, w| {
        for (sum, value) in sums.iter_mut().zip(values[entry]) {
            *sum = w.fma(F::splat(value), *sum);
        }
    });
    let mut out = [Line::ZERO; EXTRAS];
    for (line, sum) in out.iter_mut().zip(sums) {
        sum.store(&mut line.0);
    }
    out
}

/// Hands out the weight T α of each entry that a block meets, front to back.
#[inline(always)]
fn weights<S: Simd>(tile: &Tile, block: usize, mut each: impl FnMut(usize, F<S>)) {
    let (x, y) = (F::<S>::load(&CENTERS[block][0].0), F::<S>::load(&CENTERS[block][1].0));
    let mut t = F::splat(1.0);
    for (entry, line) in tile.lines.iter().enumerate() {
        if tile.masks[entry] >> block & 1 == 0 {
            continue;
        }
        let r = &line.0;
        let e = exponent(r, x - F::splat(r[record::U]), y - F::splat(r[record::V]));
        let alpha = exp2_fast(e);
        let w = F::splat(LOG2_LEAST).lt(e).select(t * alpha, F::splat(0.0));
        each(entry, w);
        t = t - w;
        if F::splat(tile.opaque).lt(t).bits() == 0 {
            break;
        }
    }
}

/// A row of tiles of a step that fits memberships to labels: squared error of the composited memberships, and its
/// gradient per entry. Geometry takes no part.
pub(crate) struct WeightRow<'a> {
    pub bins: &'a Bins,
    pub row: usize,
    pub columns: usize,
    pub width: usize,
    pub height: usize,
    /// Membership of a slot in each region.
    pub memberships: &'a (dyn Fn(u32) -> [f32; 3] + Sync),
    /// Region + 1 of a pixel, 0 for none; 255 where it does not count.
    pub label: &'a (dyn Fn(usize, usize) -> u8 + Sync),
    /// Per entry of the row, the gradient of its memberships.
    pub gradients: &'a mut [[f32; 3]],
    pub tile: &'a mut Tile,
}

impl Task for WeightRow<'_> {
    type Output = (f64, usize);
    #[inline(always)]
    fn run<S: Simd>(self) -> (f64, usize) {
        let Self { bins, row, columns, width, height, memberships, label, gradients, tile } = self;
        let (mut squared, mut pixels) = (0.0f64, 0);
        let first = bins.entries(row * columns).start;
        let mut values: Vec<[f32; 3]> = Vec::new();
        for column in 0..columns {
            let index = row * columns + column;
            tile.load::<S>(bins, index, columns);
            let entries = bins.entries(index);
            values.clear();
            values.extend(bins.slots[entries.clone()].iter().map(|&s| memberships(s)));
            let gradients = &mut gradients[entries.start - first..entries.end - first];
            gradients.fill([0.0; 3]);
            for block in 0..TILE_BLOCKS {
                let mut sums = [F::<S>::splat(0.0); 3];
                weights::<S>(tile, block, |entry, w| {
                    for n in 0..3 {
                        sums[n] = w.fma(F::splat(values[entry][n]), sums[n]);
                    }
                });
                let (mut wanted, mut counts) = ([[0.0f32; 16]; 3], [0.0f32; 16]);
                let (x0, y0) = tile.corner(block);
                for i in 0..16 {
                    let (x, y) = (x0 + i % 4, y0 + i / 4);
                    if x < width && y < height {
                        let label = label(x, y);
                        counts[i] = f32::from(u8::from(label != u8::MAX));
                        if (1..=3).contains(&label) {
                            wanted[usize::from(label) - 1][i] = 1.0;
                        }
                    }
                }
                let counts = F::<S>::load(&counts);
                let mut d = [counts; 3];
                for n in 0..3 {
                    d[n] = (sums[n] - F::load(&wanted[n])) * counts;
                    squared += f64::from((d[n] * d[n]).sum());
                }
                pixels += counts.sum() as usize;
                weights::<S>(tile, block, |entry, w| {
                    for n in 0..3 {
                        gradients[entry][n] += 2.0 * (w * d[n]).sum();
                    }
                });
            }
        }
        (squared, pixels)
    }
}
