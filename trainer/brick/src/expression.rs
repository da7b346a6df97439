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

use crate::lattice::{BRICK, Lattice};
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

/// Moves each number of a residual brick by `share` towards the mean of its neighbours inside the brick; displacements
/// by `warp_share`. What few pixels have taught then follows what many have.
fn smooth_brick(values: &mut [f32], before: &mut Vec<f32>, share: f32, warp_share: f32) {
    const EDGE: usize = crate::lattice::EDGE;
    before.clear();
    before.extend_from_slice(values);
    let at = |x: usize, y: usize, z: usize| ((z * EDGE + y) * EDGE + x) * CHANNELS;
    let shares = [share, share, share, share, warp_share, warp_share, warp_share, share];
    for z in 0..EDGE {
        for y in 0..EDGE {
            for x in 0..EDGE {
                let mut sum = [0.0f32; CHANNELS];
                let mut count = 0.0;
                let mut add = |i: usize| {
                    count += 1.0;
                    for (s, v) in sum.iter_mut().zip(&before[i..i + CHANNELS]) {
                        *s += v;
                    }
                };
                for (low, high, i, stride) in [
                    (x > 0, x + 1 < EDGE, at(x, y, z), CHANNELS),
                    (y > 0, y + 1 < EDGE, at(x, y, z), EDGE * CHANNELS),
                    (z > 0, z + 1 < EDGE, at(x, y, z), EDGE * EDGE * CHANNELS),
                ] {
                    if low {
                        add(i - stride);
                    }
                    if high {
                        add(i + stride);
                    }
                }
                let i = at(x, y, z);
                for c in 0..CHANNELS {
                    values[i + c] += shares[c] * (sum[c] / count - before[i + c]);
                }
            }
        }
    }
}

impl Expression {
    /// Smooths all residuals that were ever touched.
    pub fn smooth(&mut self, share: f32, warp_share: f32) {
        self.residuals.par_iter_mut().for_each(|table| {
            let mut before = Vec::new();
            let Table { values, steps, block, .. } = table;
            for (brick, &steps) in values.chunks_exact_mut(*block).zip(steps.iter()) {
                if steps > 0 {
                    smooth_brick(brick, &mut before, share, warp_share);
                }
            }
        });
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
