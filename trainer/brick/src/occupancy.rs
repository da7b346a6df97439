//! Which parts of a box hold anything.
//!
//! The box has 64³ cells of 2³ parts. Early in a fit whole cells come and go; once surfaces are thin, single parts.

/// Cells along each edge.
pub const CELLS: usize = 64;
/// Cells in all.
pub const COUNT: usize = CELLS * CELLS * CELLS;
/// Parts along each edge.
pub const PARTS: usize = 2 * CELLS;
/// Parts in all, eight in a row per cell.
pub const PART_COUNT: usize = 8 * COUNT;
/// Nothing is ahead.
const FAR: u16 = 255 << 8;
/// A cell of which every part is looked into.
pub const WHOLE: u8 = 0xff;

/// An occupancy grid over [−1, 1]³.
#[derive(Clone, Debug)]
pub struct Occupancy {
    /// Largest density seen lately, per cell.
    pub density: Vec<f32>,
    /// Largest weight in a pixel seen lately, per part.
    pub weight: Vec<f32>,
    /// Which parts of each cell are looked into, a bit each.
    pub bits: Vec<u8>,
    /// Per cell what a march asks for: `bits`, and above them how many cells away the nearest cell is that is looked
    /// into, along the axis that is farthest (Chebyshev's distance): a ray passes what lies between in one stride. One
    /// more at the end, for pairs are read.
    pub(crate) ahead: Vec<u16>,
}

impl Default for Occupancy {
    fn default() -> Self {
        Self {
            density: vec![0.0; COUNT],
            weight: vec![1.0; PART_COUNT],
            bits: vec![WHOLE; COUNT],
            ahead: vec![u16::from(WHOLE); COUNT + 1],
        }
    }
}

/// x, y, z of the part that holds `p`; points outside take the border's.
#[inline(always)]
pub(crate) fn part_position(p: [f32; 3]) -> [usize; 3] {
    p.map(|v| (((v + 1.0) * (PARTS as f32 * 0.5)).max(0.0) as usize).min(PARTS - 1))
}

/// The cell and the place in it of the part at `position`.
#[inline(always)]
pub(crate) fn cell_and_bit([x, y, z]: [usize; 3]) -> (usize, usize) {
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
        self.ahead.clear();
        self.ahead.extend(self.bits.iter().map(|&bits| if bits == 0 { FAR } else { u16::from(bits) }));
        self.ahead.push(0);
        for distance in 1..CELLS as u16 {
            let grown = grow(&rows);
            let mut any = false;
            for (row, (&before, &after)) in rows.iter().zip(&grown).enumerate() {
                let mut fresh = after & !before;
                any |= fresh != 0;
                while fresh != 0 {
                    self.ahead[row * CELLS + fresh.trailing_zeros() as usize] = distance << 8;
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
