//! What action units change: residual features and warps on one lattice, gated by region masks.
//!
//! For every AU k a residual grid G_k holds 8 numbers per vertex: 5 features and a 3-vector of displacement. An image
//! with activations a sees the sum
//!
//! ```text
//! B(v) = Σ_n m_n(v) Σ_{k in region n} a_k G_k(v)
//! ```
//!
//! which is made once per image (the numbers of the latent code ω act like AUs of a region that is the whole lattice:
//! gaze, a crooked mouth, whatever no AU tells), so that each sample pays one look-up whatever the number of AUs. m_n is exactly 0
//! outside the region's bricks and hull and where it falls under [`HARD`]: what an AU cannot reach is untouched to the bit.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::lattice::{BRICK, EDGE, Lattice};
use crate::simd::{self, Simd, Task};
use crate::table::{Table, TableGrad};

/// Numbers per vertex of a residual grid: features 0–3, displacement x y z, feature 4.
pub const CHANNELS: usize = 8;
/// Numbers per vertex of the mask grid.
pub const MASKS: usize = 4;
/// The pseudo-region of what no AU explains: everywhere in the bricks.
pub const REST: usize = MASKS - 1;
/// Masks below this are 0.
pub const HARD: f32 = 0.02;
/// Activations below this are taken as 0.
pub const QUIET: f32 = 1e-4;

/// The residual grids of all AUs and the masks.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Expression {
    /// The bricks of all regions together.
    pub lattice: Lattice,
    /// Region of each AU, then [`REST`] for each number of the latent code.
    pub region_of: Vec<usize>,
    /// Slots of each region and of the rest, ascending, in the order of its tables' blocks.
    pub slots_of: Vec<Vec<u32>>,
    /// Per vertex in memory: a bit per region whose hull holds it.
    pub allowed: Vec<u8>,
    /// G_k.
    pub residuals: Vec<Table>,
    /// Mask logits.
    pub masks: Table,
}

impl Expression {
    /// Zero residuals for AUs and `codes` latent numbers; `hull(vertex position)` gives the bits of the regions that hold a point.
    ///
    /// # Panics
    /// With more regions than [`REST`]; callers check what they were given.
    pub fn new(
        vertices: [usize; 3],
        mut region_of: Vec<usize>,
        regions: usize,
        codes: usize,
        hull: impl Fn([f32; 3]) -> u8,
    ) -> Self {
        assert!(regions <= REST, "at most {REST} regions");
        region_of.extend(std::iter::repeat_n(REST, codes));
        let mut lattice = Lattice::sparse(vertices);
        let [nx, ny, nz] = lattice.bricks();
        let mut bits = vec![0u8; BRICK];
        let mut slots_of = vec![Vec::new(); MASKS];
        for brick in 0..nx * ny * nz {
            let first = [brick % nx, brick / nx % ny, brick / nx / ny].map(|b| b * 8);
            let here: Vec<u8> = (0..BRICK)
                .map(|i| hull(lattice.position([first[0] + i % 8, first[1] + i / 8 % 8, first[2] + i / 64])))
                .collect();
            let any = here.iter().fold(0, |a, b| a | b);
            if any == 0 {
                continue;
            }
            lattice.allocate(brick);
            let any = any | 1 << REST;
            bits.extend(here.iter().map(|&b| if b == 0 { 0 } else { b | 1 << REST }));
            for (n, slots) in slots_of.iter_mut().enumerate() {
                if any >> n & 1 == 1 {
                    slots.push(lattice.slots as u32 - 1);
                }
            }
        }
        let residuals = region_of.iter().map(|&n| Table::new(slots_of[n].len(), BRICK * CHANNELS, || 0.0)).collect();
        let masks = Table::new(lattice.slots, BRICK * MASKS, || 0.0);
        Self { lattice, region_of, slots_of, allowed: bits, residuals, masks }
    }

    /// The masks at the vertices, `MASKS` numbers each.
    pub fn gates(&self) -> Vec<f32> {
        let logits = &self.masks.values;
        let mut gates = vec![0.0; logits.len()];
        for (vertex, &allowed) in self.allowed.iter().enumerate() {
            for n in 0..MASKS {
                if n == REST {
                    gates[vertex * MASKS + n] = f32::from(allowed >> n & 1);
                } else if allowed >> n & 1 == 1 {
                    let m = 1.0 / (1.0 + (-logits[vertex * MASKS + n]).exp());
                    gates[vertex * MASKS + n] = if m < HARD { 0.0 } else { m };
                }
            }
        }
        gates
    }

    /// B for one image, `CHANNELS` numbers per vertex in memory.
    pub fn blend(&self, gates: &[f32], activations: &[f32], out: &mut Vec<f32>) {
        out.resize(self.lattice.slots * BRICK * CHANNELS, 0.0);
        for (slot, brick) in out.chunks_exact_mut(BRICK * CHANNELS).enumerate() {
            self.blend_slot(gates, activations, slot, brick);
        }
    }

    /// B in one brick.
    pub fn blend_slot(&self, gates: &[f32], activations: &[f32], slot: usize, out: &mut [f32]) {
        out.fill(0.0);
        let gates = &gates[slot * BRICK * MASKS..(slot + 1) * BRICK * MASKS];
        let block_of: [Option<usize>; MASKS] =
            std::array::from_fn(|n| self.slots_of[n].binary_search(&(slot as u32)).ok());
        for (k, (&a, table)) in activations.iter().zip(&self.residuals).enumerate() {
            let region = self.region_of[k];
            let Some(block) = block_of[region].filter(|&b| a.abs() >= QUIET && table.steps[b] > 0) else { continue };
            let residual = &table.values[block * BRICK * CHANNELS..(block + 1) * BRICK * CHANNELS];
            simd::run(BlendBrick { a, region, out, residual, gates });
        }
    }

    /// Adds the gradient of B to the residuals' and gives that of the activations.
    ///
    /// Masks get no gradient from here: they follow the 2D masks only.
    pub fn backward(
        &self,
        gates: &[f32],
        activations: &[f32],
        d_blend: &[f32],
        grads: &mut [TableGrad],
        d_activations: &mut [f32],
    ) {
        for (k, (&a, table)) in activations.iter().zip(&self.residuals).enumerate() {
            let n = self.region_of[k];
            if a.abs() < QUIET {
                continue;
            }
            let grad = &mut grads[k];
            let mut d_a = 0.0;
            for (block, &slot) in self.slots_of[n].iter().enumerate() {
                let from = slot as usize * BRICK;
                let range = block * BRICK * CHANNELS..(block + 1) * BRICK * CHANNELS;
                let d_blend = &d_blend[from * CHANNELS..(from + BRICK) * CHANNELS];
                if d_blend.iter().all(|&d| d == 0.0) {
                    continue;
                }
                d_a += simd::run(UnblendBrick {
                    a,
                    region: n,
                    d_blend,
                    residual: &table.values[range.clone()],
                    gates: &gates[from * MASKS..(from + BRICK) * MASKS],
                    grad: &mut grad.values[range],
                });
                grad.touched[block] = true;
            }
            d_activations[k] += d_a;
        }
    }
}

impl Expression {
    /// Moves each number of every residual that was ever touched by `share` towards the mean of its neighbours,
    /// displacements by `warp_share`: what few pixels have taught then follows what many have. Neighbours reach across
    /// bricks, or their borders would show as seams.
    pub fn smooth(&mut self, share: f32, warp_share: f32) {
        let shares = [share, share, share, share, warp_share, warp_share, warp_share, share];
        let bricks = self.lattice.bricks();
        let mut brick_of = vec![usize::MAX; self.lattice.slots];
        for (brick, &slot) in self.lattice.slot.iter().enumerate().filter(|(_, s)| **s != 0) {
            brick_of[slot as usize] = brick;
        }
        let around: Vec<Vec<[Option<usize>; 6]>> =
            self.slots_of.iter().map(|slots| blocks_around(slots, &brick_of, bricks)).collect();
        let Self { residuals, region_of, .. } = self;
        residuals.par_iter_mut().zip(region_of).for_each(|(table, &mut region)| {
            let before = table.values.clone();
            for (block, around) in around[region].iter().enumerate() {
                if table.steps[block] > 0 {
                    let values = &mut table.values[block * BRICK * CHANNELS..(block + 1) * BRICK * CHANNELS];
                    smooth_brick(values, &before, block, around, &shares);
                }
            }
        });
    }
}

/// For each block of a region the blocks beside it: −x, +x, −y, +y, −z, +z.
fn blocks_around(slots: &[u32], brick_of: &[usize], bricks: [usize; 3]) -> Vec<[Option<usize>; 6]> {
    let strides = [1, bricks[0], bricks[0] * bricks[1]];
    let block_at = |brick: usize| slots.iter().position(|&s| brick_of[s as usize] == brick);
    slots
        .iter()
        .map(|&slot| {
            let brick = brick_of[slot as usize];
            std::array::from_fn(|side| {
                let axis = side / 2;
                let at = brick / strides[axis] % bricks[axis];
                if side % 2 == 0 {
                    (at > 0).then(|| block_at(brick - strides[axis])).flatten()
                } else {
                    (at + 1 < bricks[axis]).then(|| block_at(brick + strides[axis])).flatten()
                }
            })
        })
        .collect()
}

/// Smooths one brick; `before` are all values of its table before any was moved.
fn smooth_brick(
    values: &mut [f32],
    before: &[f32],
    block: usize,
    around: &[Option<usize>; 6],
    shares: &[f32; CHANNELS],
) {
    const STRIDES: [usize; 3] = [1, EDGE, EDGE * EDGE];
    for i in 0..BRICK {
        let mut sum = [0.0f32; CHANNELS];
        let mut count = 0.0;
        for side in 0..6 {
            let (axis, up) = (side / 2, side % 2 == 1);
            let at = i / STRIDES[axis] % EDGE;
            let inside = if up { at + 1 < EDGE } else { at > 0 };
            // The vertex beside this one, or the first one of the brick beside this one.
            let (neighbour, vertex) = match (inside, up) {
                (true, true) => (Some(block), i + STRIDES[axis]),
                (true, false) => (Some(block), i - STRIDES[axis]),
                (false, true) => (around[side], i - (EDGE - 1) * STRIDES[axis]),
                (false, false) => (around[side], i + (EDGE - 1) * STRIDES[axis]),
            };
            if let Some(neighbour) = neighbour {
                let from = (neighbour * BRICK + vertex) * CHANNELS;
                count += 1.0;
                for (s, v) in sum.iter_mut().zip(&before[from..from + CHANNELS]) {
                    *s += v;
                }
            }
        }
        let own = (block * BRICK + i) * CHANNELS;
        for c in 0..CHANNELS {
            values[i * CHANNELS + c] += shares[c] * (sum[c] / count - before[own + c]);
        }
    }
}

struct BlendBrick<'a> {
    a: f32,
    region: usize,
    out: &'a mut [f32],
    residual: &'a [f32],
    gates: &'a [f32],
}

impl Task for BlendBrick<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        let rows = self.out.as_chunks_mut::<CHANNELS>().0.iter_mut();
        let residual = self.residual.as_chunks::<CHANNELS>().0;
        for ((row, g), gate) in rows.zip(residual).zip(self.gates.as_chunks::<MASKS>().0) {
            let weight = self.a * gate[self.region];
            for c in 0..CHANNELS {
                row[c] += weight * g[c];
            }
        }
    }
}

struct UnblendBrick<'a> {
    a: f32,
    region: usize,
    d_blend: &'a [f32],
    residual: &'a [f32],
    gates: &'a [f32],
    grad: &'a mut [f32],
}

impl Task for UnblendBrick<'_> {
    /// The brick's part of the activation's gradient.
    type Output = f32;

    #[inline(always)]
    fn run<S: Simd>(self) -> f32 {
        let mut sum = [0.0f32; CHANNELS];
        let rows = self.grad.as_chunks_mut::<CHANNELS>().0.iter_mut();
        let d = self.d_blend.as_chunks::<CHANNELS>().0;
        let residual = self.residual.as_chunks::<CHANNELS>().0;
        for (((row, d), g), gate) in rows.zip(d).zip(residual).zip(self.gates.as_chunks::<MASKS>().0) {
            let gate = gate[self.region];
            let weight = self.a * gate;
            for c in 0..CHANNELS {
                row[c] += weight * d[c];
                sum[c] += gate * d[c] * g[c];
            }
        }
        sum.iter().sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two bricks side by side, one AU.
    fn pair() -> Expression {
        Expression::new([16, 8, 8], vec![0], 1, 0, |_| 1)
    }

    #[test]
    fn smoothing_reaches_across_bricks_and_keeps_what_is_even() {
        let mut e = pair();
        assert_eq!(e.slots_of[0].len(), 2);
        e.residuals[0].values.fill(0.25);
        e.residuals[0].steps.fill(1);
        e.smooth(0.5, 0.5);
        assert!(e.residuals[0].values.iter().all(|v| (v - 0.25).abs() < 1e-6));
        // A spike on the border: half of it stays, and every neighbour, the one beyond the border too, gets its share.
        let spike = (7 + EDGE + EDGE * EDGE) * CHANNELS;
        e.residuals[0].values.fill(0.0);
        e.residuals[0].values[spike] = 1.0;
        e.smooth(0.5, 0.5);
        let v = &e.residuals[0].values;
        let beyond = (BRICK + EDGE + EDGE * EDGE) * CHANNELS;
        assert!((v[spike] - 0.5).abs() < 1e-6);
        for neighbour in [spike - CHANNELS, spike + EDGE * CHANNELS, beyond] {
            assert!((v[neighbour] - 0.5 / 6.0).abs() < 1e-6, "{}", v[neighbour]);
        }
    }

    #[test]
    fn what_no_region_allows_stays_zero() {
        let e = Expression::new([16, 8, 8], vec![0], 1, 0, |p| u8::from(p[0] < 0.0));
        let gates = e.gates();
        let mut blend = Vec::new();
        let mut full = e.clone();
        full.residuals[0].values.fill(1.0);
        full.residuals[0].steps.fill(1);
        full.blend(&gates, &[1.0], &mut blend);
        for (vertex, row) in blend.as_chunks::<CHANNELS>().0.iter().enumerate() {
            let expected = if e.allowed[vertex] & 1 == 1 { 0.5 } else { 0.0 };
            assert!(row.iter().all(|&v| v == expected), "vertex {vertex}: {row:?}");
        }
    }
}
