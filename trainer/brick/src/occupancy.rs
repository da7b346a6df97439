//! Which parts of a box hold anything, and the march of rays through them.
//!
//! The box has 64³ cells of 2³ parts. Early in a fit whole cells come and go; once surfaces are thin, single parts.

use serde::{Deserialize, Serialize};

/// Cells along each edge.
pub const CELLS: usize = 64;
/// Cells in all.
pub const COUNT: usize = CELLS * CELLS * CELLS;
/// Parts along each edge.
pub const PARTS: usize = 2 * CELLS;
/// Parts in all, eight in a row per cell.
pub const PART_COUNT: usize = 8 * COUNT;
/// A cell of which every part is looked into.
pub const WHOLE: u8 = 0xff;

/// An occupancy grid over [−1, 1]³.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Occupancy {
    /// Largest density seen lately, per cell.
    pub density: Vec<f32>,
    /// Largest weight in a pixel seen lately, per part.
    pub weight: Vec<f32>,
    /// Which parts of each cell are looked into, a bit each.
    pub bits: Vec<u8>,
    /// How many cells away the nearest cell is that is looked into, along the axis that is farthest (Chebyshev's distance):
    /// a ray passes what lies between in one stride.
    far: Vec<u8>,
}

impl Default for Occupancy {
    fn default() -> Self {
        Self { density: vec![0.0; COUNT], weight: vec![1.0; PART_COUNT], bits: vec![WHOLE; COUNT], far: vec![0; COUNT] }
    }
}

/// x, y, z of the part that holds `p`; points outside take the border's.
#[inline(always)]
fn part_position(p: [f32; 3]) -> [usize; 3] {
    p.map(|v| (((v + 1.0) * (PARTS as f32 * 0.5)).max(0.0) as usize).min(PARTS - 1))
}

/// The cell and the place in it of the part at `position`.
#[inline(always)]
fn cell_and_bit([x, y, z]: [usize; 3]) -> (usize, usize) {
    ((z / 2 * CELLS + y / 2) * CELLS + x / 2, (z % 2) * 4 + (y % 2) * 2 + x % 2)
}

/// The part that holds `p`: its cell's first part plus its place.
#[inline(always)]
pub fn part_at(p: [f32; 3]) -> usize {
    let (cell, bit) = cell_and_bit(part_position(p));
    cell * 8 + bit
}

/// x, y, z of a cell.
#[inline(always)]
pub fn cell_position(cell: usize) -> [usize; 3] {
    [cell % CELLS, cell / CELLS % CELLS, cell / CELLS / CELLS]
}

/// Where a ray enters and leaves [−1, 1]³; entry ≥ exit when it misses.
pub fn crossing(origin: [f32; 3], direction: [f32; 3]) -> (f32, f32) {
    let (mut enter, mut exit) = (0.0f32, f32::MAX);
    for a in 0..3 {
        if direction[a].abs() < 1e-12 {
            // Parallel to these planes: inside for good, or never (1/0 would give NaN on the border).
            if origin[a].abs() > 1.0 {
                return (1.0, 0.0);
            }
            continue;
        }
        let inverse = 1.0 / direction[a];
        let (t0, t1) = ((-1.0 - origin[a]) * inverse, (1.0 - origin[a]) * inverse);
        enter = enter.max(t0.min(t1));
        exit = exit.min(t0.max(t1));
    }
    (enter, exit)
}

/// A ray on its way.
#[derive(Clone, Copy, Debug)]
pub struct March {
    /// Origin, box units.
    pub origin: [f32; 3],
    /// Direction; its length is box units per `t`.
    pub direction: [f32; 3],
    /// 1 / direction; 0 along axes that the ray does not move along.
    inverse: [f32; 3],
    /// Where the first sample lies.
    first: f32,
    /// The next sample's number: places are the same however a march came to them.
    index: f32,
    /// Where it leaves the box.
    pub exit: f32,
    /// Distance of samples in `t`.
    pub step: f32,
    /// 1 / step
    per_step: f32,
}

impl March {
    /// A ray whose first sample lies at `t`.
    pub fn new(origin: [f32; 3], direction: [f32; 3], first: f32, exit: f32, step: f32) -> Self {
        let inverse = direction.map(|d| if d.abs() > 1e-12 { 1.0 / d } else { 0.0 });
        Self { origin, direction, inverse, first, index: 0.0, exit, step, per_step: 1.0 / step }
    }

    /// Where the next sample lies.
    #[inline(always)]
    pub fn t(&self) -> f32 {
        self.first + self.index * self.step
    }

    #[inline(always)]
    fn point(&self, t: f32) -> [f32; 3] {
        std::array::from_fn(|a| self.origin[a] + t * self.direction[a])
    }

    /// The next sample and its `t`, whatever is there.
    #[inline(always)]
    pub fn next_anywhere(&mut self) -> Option<([f32; 3], f32)> {
        let t = self.t();
        (t < self.exit).then(|| {
            self.index += 1.0;
            (self.point(t), t)
        })
    }
}

/// Every cell that is marked or beside a marked one, across corners too; a word per row along x.
fn grow(rows: &[u64]) -> Vec<u64> {
    let along_x: Vec<u64> = rows.iter().map(|r| r | r << 1 | r >> 1).collect();
    let beside = |from: &[u64], row: usize, stride: usize, position: usize| {
        let before = if position > 0 { from[row - stride] } else { 0 };
        let after = if position + 1 < CELLS { from[row + stride] } else { 0 };
        from[row] | before | after
    };
    let along_y: Vec<u64> = (0..rows.len()).map(|row| beside(&along_x, row, 1, row % CELLS)).collect();
    (0..rows.len()).map(|row| beside(&along_y, row, CELLS, row / CELLS)).collect()
}

impl Occupancy {
    /// Measures the distances anew after `bits` changed.
    pub fn refresh(&mut self) {
        // A row of 64 cells along x is a word; each round grows what is occupied by a cell on all sides.
        let mut rows: Vec<u64> = self
            .bits
            .as_chunks::<CELLS>()
            .0
            .iter()
            .map(|row| row.iter().enumerate().fold(0, |word, (x, &bits)| word | u64::from(bits != 0) << x))
            .collect();
        self.far.fill(u8::MAX);
        self.far.iter_mut().zip(&self.bits).filter(|(_, bits)| **bits != 0).for_each(|(far, _)| *far = 0);
        for distance in 1..CELLS as u8 {
            let grown = grow(&rows);
            let mut any = false;
            for (row, (&before, &after)) in rows.iter().zip(&grown).enumerate() {
                let mut fresh = after & !before;
                any |= fresh != 0;
                while fresh != 0 {
                    self.far[row * CELLS + fresh.trailing_zeros() as usize] = distance;
                    fresh &= fresh - 1;
                }
            }
            if !any {
                return;
            }
            rows = grown;
        }
    }

    /// Whether the part that holds `p` is looked into.
    #[inline(always)]
    pub fn holds(&self, p: [f32; 3]) -> bool {
        let part = part_at(p);
        self.bits[part / 8] >> (part % 8) & 1 == 1
    }

    /// The share of the box that is looked into, in cells.
    pub fn occupied(&self) -> usize {
        self.bits.iter().map(|b| b.count_ones() as usize).sum::<usize>() / 8
    }

    /// The next sample of `march` in an occupied part, and its `t`; `None` when the ray is through.
    #[inline(always)]
    pub fn next(&self, march: &mut March) -> Option<([f32; 3], f32)> {
        const EDGE: f32 = 2.0 / PARTS as f32;
        loop {
            let t = march.t();
            if t >= march.exit {
                return None;
            }
            let p = march.point(t);
            let position = part_position(p);
            let (cell, bit) = cell_and_bit(position);
            let bits = self.bits[cell];
            if bits >> bit & 1 == 1 {
                march.index += 1.0;
                return Some((p, t));
            }
            // The empty cube around the point, in parts: the part, or the cells on all sides short of the nearest occupied.
            let [low, high] = if bits != 0 {
                [position.map(|v| v as f32), position.map(|v| (v + 1) as f32)]
            } else {
                let reach = 2.0 * f32::from(self.far[cell]);
                let first = position.map(|v| (v & !1) as f32);
                [first.map(|v| v + 2.0 - reach), first.map(|v| v + reach)]
            };
            let mut leave = f32::MAX;
            for a in 0..3 {
                let wall = if march.inverse[a] > 0.0 { high[a] } else { low[a] };
                let at = ((wall * EDGE - 1.0) - march.origin[a]) * march.inverse[a];
                leave = leave.min(if march.inverse[a] == 0.0 { f32::MAX } else { at });
            }
            // Whole steps, so that samples stay where they would be without the skip; a hair less than to the wall, for
            // a sample on it may belong to what is behind.
            march.index += ((leave - t) * march.per_step - 1e-3).ceil().clamp(1.0, 1e6);
        }
    }

    /// Marks the neighbours of every marked cell; whole cells.
    pub fn dilate(&mut self) {
        let before = self.bits.clone();
        let strides = [1, CELLS, CELLS * CELLS];
        for cell in 0..COUNT {
            if before[cell] == 0 {
                let position = cell_position(cell);
                let beside = (0..3).any(|a| {
                    (position[a] > 0 && before[cell - strides[a]] != 0)
                        || (position[a] + 1 < CELLS && before[cell + strides[a]] != 0)
                });
                self.bits[cell] = if beside { WHOLE } else { 0 };
            }
        }
    }

    /// Leaves only parts whose weight reaches `least`, and their neighbours if asked for.
    pub fn keep_seen_parts(&mut self, least: f32, neighbours: bool) {
        let seen = |[x, y, z]: [usize; 3]| {
            let (cell, bit) = cell_and_bit([x, y, z]);
            self.weight[cell * 8 + bit] >= least
        };
        let kept: Vec<u8> = self
            .bits
            .iter()
            .enumerate()
            .map(|(cell, &bits)| {
                if bits == 0 {
                    return 0;
                }
                let first = cell_position(cell).map(|v| 2 * v);
                (0..8)
                    .filter(|&bit| {
                        let at = [first[0] + (bit & 1), first[1] + (bit >> 1 & 1), first[2] + (bit >> 2)];
                        seen(at)
                            || neighbours
                                && (0..3).any(|a| {
                                    let beside = |v: usize| {
                                        let mut other = at;
                                        other[a] = v;
                                        seen(other)
                                    };
                                    (at[a] > 0 && beside(at[a] - 1)) || (at[a] + 1 < PARTS && beside(at[a] + 1))
                                })
                    })
                    .fold(0, |kept, bit| kept | 1 << bit)
            })
            .collect();
        for (bits, kept) in self.bits.iter_mut().zip(kept) {
            *bits &= kept;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(fill: impl Fn([usize; 3]) -> bool) -> Occupancy {
        let mut o = Occupancy::default();
        for cell in 0..COUNT {
            let [x, y, z] = cell_position(cell).map(|v| 2 * v);
            o.bits[cell] = (0..8)
                .filter(|&bit| fill([x + (bit & 1), y + (bit >> 1 & 1), z + (bit >> 2)]))
                .fold(0, |bits, bit| bits | 1 << bit);
        }
        o.refresh();
        o
    }

    /// The march with skips meets the very samples that the march without them finds in occupied parts.
    #[test]
    fn skipping_loses_no_sample_and_invents_none() {
        let o = grid(|[x, y, z]| (x / 9 + y / 5 + z / 7) % 6 == 0);
        let diagonal = 1.0 / 3f32.sqrt();
        for (origin, direction) in [
            ([0.013, -0.021, -1.5], [0.0, 0.0, 1.0]),
            ([-1.5, 0.037, 0.011], [1.0, 0.0, 0.0]),
            ([0.3, 1.4, -0.2], [0.0, -1.0, 0.0]),
            ([-1.2, -1.1, -1.3], [diagonal; 3]),
            ([0.1, 0.2, 0.3], [-0.48, 0.6, 0.64]),
        ] {
            let (enter, exit) = crossing(origin, direction);
            let step = 2.0 / 160.0;
            let start = March::new(origin, direction, enter + 0.37 * step, exit, step);
            let (mut slow, mut fast) = (start, start);
            let mut expected = Vec::new();
            while let Some((p, t)) = slow.next_anywhere() {
                if o.holds(p) {
                    expected.push(t);
                }
            }
            let mut found = Vec::new();
            while let Some((_, t)) = o.next(&mut fast) {
                found.push(t);
            }
            assert!(!expected.is_empty(), "the ray from {origin:?} meets nothing");
            // Rounding may put a sample on a border to either side: one in a hundred may differ.
            let apart = expected.iter().filter(|e| !found.iter().any(|f| (*f - **e).abs() < 1e-4)).count();
            assert!(apart * 100 <= expected.len(), "{apart} of {} samples are lost", expected.len());
            assert!(found.len().abs_diff(expected.len()) * 100 <= expected.len());
        }
    }

    #[test]
    fn rays_along_an_axis_or_past_the_box_end() {
        assert!(crossing([0.0, 2.0, -3.0], [0.0, 0.0, 1.0]).0 >= crossing([0.0, 2.0, -3.0], [0.0, 0.0, 1.0]).1);
        let o = Occupancy::default();
        let (enter, exit) = crossing([1.0, 1.0, -3.0], [0.0, 0.0, 1.0]);
        let mut march = March::new([1.0, 1.0, -3.0], [0.0, 0.0, 1.0], enter, exit, 0.1);
        let mut count = 0;
        while o.next(&mut march).is_some() {
            count += 1;
        }
        assert!((19..=21).contains(&count), "{count}");
    }

    #[test]
    fn what_was_seen_stays_and_may_keep_its_neighbours() {
        let mut o = Occupancy { weight: vec![0.0; PART_COUNT], ..Occupancy::default() };
        o.weight[part_at([0.01, 0.01, 0.01])] = 0.5;
        let mut wide = o.clone();
        o.keep_seen_parts(0.01, false);
        wide.keep_seen_parts(0.01, true);
        let parts = |o: &Occupancy| o.bits.iter().map(|b| b.count_ones()).sum::<u32>();
        assert_eq!((parts(&o), parts(&wide)), (1, 7));
        assert!(o.holds([0.01, 0.01, 0.01]) && !o.holds([0.02, 0.01, 0.01]) && wide.holds([0.02, 0.01, 0.01]));
    }
}
