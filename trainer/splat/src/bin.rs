//! Which Gaussian meets which block of which tile, in depth order.
//!
//! Gaussians are projected in fixed chunks of groups, sorted by depth (ties by slot), and walked in that order: each emits
//! a pair (tile, mask of 4×4 blocks) for every tile that its ellipse at the level 1/255 meets. Chunks of the sorted list
//! are binned side by side and scattered to tile-major order by counted offsets. The result does not depend on threads.
#![allow(unsafe_code, reason = "chunks scatter their pairs to disjoint places of shared arrays")]

use rayon::prelude::*;

use crate::TILE;
use crate::model::{Gaussians, LANES};
use crate::project::{Active, project_group, record};
use crate::simd::{self, F, Row, Simd, Task, prefetch};
use crate::view::{NEAR_M, View};

/// Blocks of 4×4 pixels along a tile's edge.
pub(crate) const BLOCKS: usize = 4;
/// Groups are projected in this many chunks.
const PROJECT_CHUNKS: usize = 32;
/// The sorted list is binned in this many chunks.
const BIN_CHUNKS: usize = 8;
/// Bits of a depth key, half of which a pass of the sort takes.
const KEY_BITS: u32 = 22;

/// Sixteen numbers on a cache line of their own.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(C, align(64))]
pub(crate) struct Line(pub Row);

impl Line {
    pub(crate) const ZERO: Self = Self([0.0; 16]);
}

/// A Gaussian's part in a tile, before it is sorted by tile.
#[derive(Clone, Copy, Debug)]
struct Pair {
    tile: u32,
    slot: u32,
    mask: u16,
}

#[derive(Clone, Debug, Default)]
struct Chunk {
    pairs: Vec<Pair>,
    /// Pairs per tile; then where the chunk's next pair of the tile goes.
    counts: Vec<u32>,
}

/// A picture's Gaussians, sorted into its tiles.
#[derive(Clone, Debug, Default)]
pub(crate) struct Bins {
    /// Per slot, see [`record`]. Those that are not visible hold whatever was there before.
    pub records: Vec<Line>,
    /// Depth key and slot of the visible ones, nearest first.
    pub visible: Vec<(u32, u32)>,
    /// Where each tile's entries begin, and where the last one's end.
    pub starts: Vec<u32>,
    /// Tile-major: slot of each entry.
    pub slots: Vec<u32>,
    /// Tile-major: blocks that the entry meets, column by column.
    pub masks: Vec<u16>,
    /// Splat-major: where each pair stands among the entries. Pairs of one slot are neighbours.
    pub position: Vec<u32>,
    /// Per slot: first pair.
    pub first: Vec<u32>,
    /// Per slot: number of pairs, 0 for what is not in the picture.
    pub count: Vec<u32>,
    scratch: Vec<(u32, u32)>,
    lists: Vec<Vec<(u32, u32)>>,
    chunks: Vec<Chunk>,
}

struct ProjectChunk<'a> {
    which: Option<&'a [bool]>,
    model: &'a Gaussians,
    view: &'a View,
    active: &'a [Active],
    first_group: usize,
    records: &'a mut [Line],
    list: &'a mut Vec<(u32, u32)>,
}

impl Task for ProjectChunk<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self) {
        self.list.clear();
        let mut rows = [[0.0f32; 16]; LANES];
        for (i, lines) in self.records.chunks_exact_mut(LANES).enumerate() {
            let g = self.first_group + i;
            if self.which.is_some_and(|w| !w[g]) {
                continue;
            }
            let mut bits = project_group::<S>(self.model, self.view, self.active, g, &mut rows);
            while bits != 0 {
                let lane = bits.trailing_zeros() as usize;
                bits &= bits - 1;
                lines[lane].0 = rows[lane];
                self.list.push((depth_key(rows[lane][record::DEPTH]), (g * LANES + lane) as u32));
            }
        }
    }
}

/// A key that rises with depth: the leading bits of the float's pattern.
pub(crate) fn depth_key(depth: f32) -> u32 {
    const SHIFT: u32 = 6;
    ((depth.max(NEAR_M).to_bits() - NEAR_M.to_bits()) >> SHIFT).min((1 << KEY_BITS) - 1)
}

impl Bins {
    /// Projects and bins `model` for a view: all its groups, or those that `which` names.
    pub(crate) fn fill(&mut self, model: &Gaussians, view: &View, active: &[Active], which: Option<&[bool]>) {
        let groups = model.groups();
        self.records.resize(groups * LANES, Line::ZERO);
        self.lists.resize_with(PROJECT_CHUNKS, Vec::new);
        let per_chunk = groups.div_ceil(PROJECT_CHUNKS).max(1);
        self.records.par_chunks_mut(per_chunk * LANES).zip(self.lists.par_iter_mut()).enumerate().for_each(
            |(i, (records, list))| {
                simd::run(ProjectChunk { which, model, view, active, first_group: i * per_chunk, records, list });
            },
        );
        self.visible.clear();
        // Fewer chunks than lists where there are few groups: the rest keep what an earlier picture left.
        for list in self.lists.iter().take(groups.div_ceil(per_chunk)) {
            self.visible.extend_from_slice(list);
        }
        sort_by_key(&mut self.visible, &mut self.scratch);
        self.bin(view, groups * LANES);
    }

    fn bin(&mut self, view: &View, slots: usize) {
        let tiles = view.tiles();
        let per_chunk = self.visible.len().div_ceil(BIN_CHUNKS).max(1);
        self.chunks.resize_with(BIN_CHUNKS, Chunk::default);
        let used = self.visible.len().div_ceil(per_chunk);
        let (records, visible) = (&self.records, &self.visible);
        self.chunks.par_iter_mut().zip(visible.par_chunks(per_chunk)).for_each(|(chunk, list)| {
            chunk.counts.clear();
            chunk.counts.resize(tiles, 0);
            simd::run(EmitChunk { view, records, list, chunk });
        });
        // Where each tile's entries begin, and each chunk's share of them.
        self.starts.clear();
        self.starts.reserve(tiles + 1);
        let mut next = 0u32;
        for tile in 0..tiles {
            self.starts.push(next);
            for chunk in &mut self.chunks[..used] {
                let count = chunk.counts[tile];
                chunk.counts[tile] = next;
                next += count;
            }
        }
        self.starts.push(next);
        let total = next as usize;
        self.slots.resize(total, 0);
        // A tile's masks are read 32 at a time.
        self.masks.resize(total + 32, 0);
        self.position.resize(total, 0);
        self.first.resize(slots, 0);
        self.count.clear();
        self.count.resize(slots, 0);
        let shared = Shared {
            slots: self.slots.as_mut_ptr(),
            masks: self.masks.as_mut_ptr(),
            first: self.first.as_mut_ptr(),
            count: self.count.as_mut_ptr(),
        };
        let mut places: Vec<&mut [u32]> = Vec::with_capacity(used);
        let mut rest = self.position.as_mut_slice();
        let mut offset = 0u32;
        let mut offsets = Vec::with_capacity(used);
        for chunk in &self.chunks[..used] {
            let (own, more) = rest.split_at_mut(chunk.pairs.len());
            places.push(own);
            offsets.push(offset);
            offset += chunk.pairs.len() as u32;
            rest = more;
        }
        self.chunks[..used].par_iter_mut().zip(places).zip(offsets).for_each(|((chunk, place), offset)| {
            chunk.scatter(place, offset, &shared);
        });
    }

    /// The entries of a tile.
    pub(crate) fn entries(&self, tile: usize) -> std::ops::Range<usize> {
        self.starts[tile] as usize..self.starts[tile + 1] as usize
    }
}

/// Arrays that chunks fill side by side.
struct Shared {
    slots: *mut u32,
    masks: *mut u16,
    first: *mut u32,
    count: *mut u32,
}

// SAFETY: every entry and every slot belongs to one chunk, see `scatter`.
unsafe impl Sync for Shared {}

impl Chunk {
    /// Puts each pair where its tile's entries are.
    fn scatter(&mut self, place: &mut [u32], offset: u32, shared: &Shared) {
        let mut last = u32::MAX;
        for (i, (pair, place)) in self.pairs.iter().zip(place).enumerate() {
            let at = self.counts[pair.tile as usize];
            self.counts[pair.tile as usize] = at + 1;
            *place = at;
            // SAFETY: the offsets of chunks and tiles were counted from these pairs, so `at` is below the total and no
            // other pair has it; a slot stands once in the sorted list, hence in one chunk only, and below `slots`.
            unsafe {
                *shared.slots.add(at as usize) = pair.slot;
                *shared.masks.add(at as usize) = pair.mask;
                if pair.slot != last {
                    last = pair.slot;
                    *shared.first.add(pair.slot as usize) = offset + i as u32;
                    *shared.count.add(pair.slot as usize) = 0;
                }
                *shared.count.add(pair.slot as usize) += 1;
            }
        }
    }
}

/// Sorts by the first, stable: two passes of half the bits each.
fn sort_by_key(list: &mut Vec<(u32, u32)>, scratch: &mut Vec<(u32, u32)>) {
    const HALF: u32 = KEY_BITS / 2;
    const SIZE: usize = 1 << HALF;
    scratch.resize(list.len(), (0, 0));
    for pass in 0..2 {
        let digit = |key: u32| (key >> (pass * HALF)) as usize & (SIZE - 1);
        let mut counts = [0u32; SIZE];
        for (key, _) in list.iter() {
            counts[digit(*key)] += 1;
        }
        let mut next = 0;
        for count in &mut counts {
            next += std::mem::replace(count, next);
        }
        for &item in list.iter() {
            let at = &mut counts[digit(item.0)];
            scratch[*at as usize] = item;
            *at += 1;
        }
        std::mem::swap(list, scratch);
    }
}

/// Records are fetched this many Gaussians ahead.
pub(crate) const AHEAD: usize = 12;

/// First and last block of a packed range, see [`record::COLUMNS`].
#[inline(always)]
fn unpack(range: f32) -> (u32, u32) {
    const PACK: u32 = record::PACK as u32;
    let both = range as u32;
    (both % PACK, both / PACK)
}

/// Of the blocks `from..=to` those of the tile that begins at block `at`, a bit for each at 0, 1, 2, 3 times `step`.
#[inline(always)]
fn bits_in_tile(from: u32, to: u32, at: u32, step: u32) -> u32 {
    let (first, end) = (from.max(at) - at, to.min(at + 3) + 1 - at);
    ((1 << (end * step)) - (1 << (first * step))) & if step == 4 { 0x1111 } else { 0xf }
}

struct EmitChunk<'a> {
    view: &'a View,
    records: &'a [Line],
    list: &'a [(u32, u32)],
    chunk: &'a mut Chunk,
}

impl Task for EmitChunk<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self) {
        const PER_TILE: u32 = (TILE / BLOCKS) as u32;
        let Chunk { pairs, counts } = self.chunk;
        pairs.clear();
        let columns = self.view.columns();
        let mut push = |row: u32, column: u32, slot: u32, mask: u32| {
            let tile = row as usize * columns + column as usize;
            counts[tile] += 1;
            pairs.push(Pair { tile: tile as u32, slot, mask: mask as u16 });
        };
        let mut lanes = [0.0f32; 16];
        for (i, lane) in lanes.iter_mut().enumerate() {
            *lane = i as f32;
        }
        let lanes = F::<S>::load(&lanes);
        let (zero, half, quarter, none) = (F::splat(0.0), F::splat(0.5), F::splat(0.25), F::splat(1e6));
        for (i, &(_, slot)) in self.list.iter().enumerate() {
            if let Some(&(_, later)) = self.list.get(i + AHEAD) {
                prefetch::<S, Line>(self.records, later as usize);
            }
            let r = &self.records[slot as usize].0;
            let ((x0, x1), (y0, y1)) = (unpack(r[record::COLUMNS]), unpack(r[record::ROWS]));
            let (tile_columns, tile_rows) = (x0 / PER_TILE..=x1 / PER_TILE, y0 / PER_TILE..=y1 / PER_TILE);
            if x1 - x0 <= 1 && y1 - y0 <= 1 {
                for row in tile_rows {
                    let rows = bits_in_tile(y0, y1, row * PER_TILE, 1);
                    for column in tile_columns.clone() {
                        push(row, column, slot, rows * bits_in_tile(x0, x1, column * PER_TILE, 4));
                    }
                }
                continue;
            }
            let (u, v) = (r[record::U], r[record::V]);
            let y_right = F::splat(r[record::Y_RIGHT]);
            let (e, f) = (F::<S>::splat(r[record::CHORD]), F::splat(r[record::CHORD + 1]));
            let slope = F::splat(r[record::SLOPE]);
            // Rows of blocks go 16 at a time, from a tile's first row on.
            for four in tile_rows.clone().step_by(4) {
                let row = lanes + F::splat((four * PER_TILE) as f32);
                let top = row.fma(F::splat(BLOCKS as f32), F::splat(0.5 - v));
                let bottom = top + F::splat(3.0);
                let chord = |y: F<S>| (y * y).fnma(f, e).max(zero).sqrt();
                let y_r = y_right.max(top).min(bottom);
                let y_l = (-y_right).max(top).min(bottom);
                let x_r = slope.fma(y_r, chord(y_r)) + F::splat(u - 0.5);
                let x_l = slope.fma(y_l, -chord(y_l)) + F::splat(u - 3.5);
                // The leftmost and rightmost blocks, half a block outwards: whole numbers between them are inside.
                let right = (x_r * quarter).floor().min(F::splat(x1 as f32)) + half;
                let left = (-(x_l * quarter)).floor().min(F::splat(-(x0 as f32))) + half;
                let there = F::splat(y0 as f32 - 0.5).lt(row).and(row.lt(F::splat(y1 as f32 + 0.5)));
                let left = there.select(-left, none);
                let last = (tile_rows.end() - four).min(3);
                for column in tile_columns.clone() {
                    // Per column of blocks, a bit for each of the 16 rows.
                    let mut all = 0u64;
                    for j in 0..PER_TILE {
                        let x = F::splat((column * PER_TILE + j) as f32);
                        all |= u64::from(left.lt(x).and(x.lt(right)).bits()) << (16 * j);
                    }
                    for row in 0..=last {
                        let four_columns = all >> (4 * row) & 0x000f_000f_000f_000f;
                        let mask =
                            (four_columns | four_columns >> 12 | four_columns >> 24 | four_columns >> 36) & 0xffff;
                        if mask != 0 {
                            push(four + row, column, slot, mask as u32);
                        }
                    }
                }
            }
        }
    }
}
