//! Which cells of a box hold anything, and the march of rays through them.

use serde::{Deserialize, Serialize};

/// Cells along each edge.
pub const CELLS: usize = 64;
/// Cells in all.
pub const COUNT: usize = CELLS * CELLS * CELLS;
/// Cells along the edge of a block that is skipped in one stride.
const BLOCK: usize = 8;
const BLOCKS: usize = CELLS / BLOCK;

/// An occupancy grid over [−1, 1]³.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Occupancy {
    /// Largest density seen lately, per cell.
    pub density: Vec<f32>,
    /// Largest weight in a pixel seen lately, per cell.
    pub weight: Vec<f32>,
    /// Whether a cell is looked into.
    pub bits: Vec<bool>,
    /// Whether any cell of a block is.
    blocks: Vec<bool>,
}

impl Default for Occupancy {
    fn default() -> Self {
        Self {
            density: vec![0.0; COUNT],
            weight: vec![1.0; COUNT],
            bits: vec![true; COUNT],
            blocks: vec![true; BLOCKS.pow(3)],
        }
    }
}

/// The cell that holds `p`; points outside take the border's.
#[inline(always)]
pub fn cell_at(p: [f32; 3]) -> usize {
    let f = |v: f32| (((v + 1.0) * (CELLS as f32 * 0.5)).max(0.0) as usize).min(CELLS - 1);
    (f(p[2]) * CELLS + f(p[1])) * CELLS + f(p[0])
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
    /// Where the next sample lies.
    pub t: f32,
    /// Where it leaves the box.
    pub exit: f32,
    /// Distance of samples in `t`.
    pub step: f32,
}

impl Occupancy {
    /// Rebuilds the blocks after `bits` changed.
    pub fn refresh(&mut self) {
        self.blocks.fill(false);
        for (cell, &bit) in self.bits.iter().enumerate() {
            if bit {
                let [x, y, z] = cell_position(cell);
                self.blocks[(z / BLOCK * BLOCKS + y / BLOCK) * BLOCKS + x / BLOCK] = true;
            }
        }
    }

    /// Cells that are looked into.
    pub fn occupied(&self) -> usize {
        self.bits.iter().filter(|b| **b).count()
    }

    /// Hands up to `count` samples in occupied cells to `take` and moves `march` on; false when the ray is through.
    #[inline(always)]
    pub fn advance(&self, march: &mut March, count: usize, mut take: impl FnMut([f32; 3])) -> bool {
        let March { origin, direction, step, exit, .. } = *march;
        let mut found = 0;
        while march.t < exit {
            let p = [
                origin[0] + march.t * direction[0],
                origin[1] + march.t * direction[1],
                origin[2] + march.t * direction[2],
            ];
            let cell = cell_at(p);
            if self.bits[cell] {
                if found == count {
                    return true;
                }
                take(p);
                found += 1;
                march.t += step;
                continue;
            }
            let position = cell_position(cell);
            let block = position.map(|v| v / BLOCK);
            let empty_block = !self.blocks[(block[2] * BLOCKS + block[1]) * BLOCKS + block[0]];
            let edge = 2.0 / CELLS as f32;
            let (size, low): (f32, [f32; 3]) = if empty_block {
                (edge * BLOCK as f32, block.map(|v| (v * BLOCK) as f32 * edge - 1.0))
            } else {
                (edge, position.map(|v| v as f32 * edge - 1.0))
            };
            let mut leave = f32::MAX;
            for a in 0..3 {
                if direction[a].abs() > 1e-12 {
                    let wall = if direction[a] > 0.0 { low[a] + size } else { low[a] };
                    leave = leave.min((wall - origin[a]) / direction[a]);
                }
            }
            // Whole steps, so that samples stay where they would be without the skip.
            march.t += ((leave - march.t) / step).ceil().clamp(1.0, 1e6) * step;
        }
        false
    }

    /// Marks the neighbours of every marked cell.
    pub fn dilate(&mut self) {
        let before = self.bits.clone();
        let strides = [1, CELLS, CELLS * CELLS];
        for cell in 0..COUNT {
            if !before[cell] {
                let position = cell_position(cell);
                self.bits[cell] = (0..3).any(|a| {
                    (position[a] > 0 && before[cell - strides[a]])
                        || (position[a] + 1 < CELLS && before[cell + strides[a]])
                });
            }
        }
    }
}
