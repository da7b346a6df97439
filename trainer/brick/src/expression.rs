//! What action units change: residual features and warps on one lattice, gated by region masks.
//!
//! For every AU k a residual grid G_k holds 8 numbers per vertex: 5 features and a 3-vector of displacement. An image
//! with activations a sees the sum
//!
//! ```text
//! B(v) = Σ_n r(m_n(v)) Σ_{k in region n} a_k G_k(v),   r(m) = max(0, (m − REACH) / (1 − REACH))
//! ```
//!
//! which is made once per image (the numbers of the latent code ω act like AUs of a region that is the whole lattice:
//! gaze, a crooked mouth, whatever no AU tells), so that each sample pays one look-up whatever the number of AUs. m_n is exactly 0
//! outside the region's bricks and hull and where it falls under [`HARD`]: what an AU cannot reach is untouched to the bit.

mod learn;
mod smooth;

pub(crate) use self::learn::backward;
pub use self::learn::{BlendGrad, Seen};
use crate::lattice::{BRICK, Lattice};
use crate::simd::{self, Simd, Task};
use crate::table::Table;

/// Numbers per vertex of a residual grid: features 0–3, displacement x y z, feature 4.
pub const CHANNELS: usize = 8;
/// Numbers per vertex of the mask grid.
pub const MASKS: usize = 4;
/// The pseudo-region of what no AU explains: everywhere in the bricks.
pub const REST: usize = MASKS - 1;
/// Masks below this are 0.
pub const HARD: f32 = 0.02;
/// What part of its region an AU acts in: not where a mask is below this, so that pictures of masks that round to nothing
/// hide no more than a trace of it.
pub const REACH: f32 = 0.1;
/// Activations below this are taken as 0.
pub const QUIET: f32 = 1e-4;

/// How much of a residual acts where its region's mask is `mask`: from 0 at [`REACH`] to 1 at 1.
#[inline(always)]
pub fn reach(mask: f32) -> f32 {
    ((mask - REACH) / (1.0 - REACH)).max(0.0)
}

/// The slope of a mask in its logit, also where the mask is cut to 0: a mask may come back.
#[inline(always)]
pub(crate) fn gate_slope(logit: f32) -> f32 {
    let m = crate::math::sigmoid(logit);
    (m * (1.0 - m)).max(1e-3)
}

/// The residual grids of all AUs and the masks.
#[derive(Clone, Debug)]
pub struct Expression {
    /// The bricks of all regions together.
    pub lattice: Lattice,
    /// Region of each AU, then [`REST`] for each number of the latent code.
    pub region_of: Vec<usize>,
    /// Slots of each region and of the rest, ascending, in the order of its tables' blocks.
    pub slots_of: Vec<Vec<u32>>,
    /// Per vertex in memory: a bit per region whose hull holds it.
    pub allowed: Vec<u8>,
    /// Per region and block: its brick's vertices that the region's hull holds. All others stay 0 and are passed over.
    vertices_of: Vec<Vec<Vec<u16>>>,
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
        let vertices_of = Vec::new();
        let mut expression = Self { lattice, region_of, slots_of, allowed: bits, vertices_of, residuals, masks };
        expression.list_vertices();
        expression
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
        for (n, slots) in self.slots_of.iter().enumerate() {
            let Ok(block) = slots.binary_search(&(slot as u32)) else { continue };
            let acting: Vec<(f32, &[f32])> = activations
                .iter()
                .zip(&self.residuals)
                .zip(&self.region_of)
                .filter(|((a, table), region)| **region == n && a.abs() >= QUIET && table.steps[block] > 0)
                .map(|((&a, table), _)| (a, &table.values[block * BRICK * CHANNELS..(block + 1) * BRICK * CHANNELS]))
                .collect();
            if !acting.is_empty() {
                simd::run(BlendBrick { acting: &acting, region: n, vertices: &self.vertices_of[n][block], gates, out });
            }
        }
    }

    /// Which slots belong to any of `regions`, a bit each.
    pub fn slots_in(&self, regions: u8) -> Vec<bool> {
        let mut within = vec![false; self.lattice.slots];
        for (_, slots) in self.slots_of.iter().enumerate().filter(|(n, _)| regions >> n & 1 == 1) {
            for &slot in slots {
                within[slot as usize] = true;
            }
        }
        within
    }

    /// Lists again which vertices each region allows, after `allowed` or `slots_of` changed.
    pub fn list_vertices(&mut self) {
        let Self { allowed, slots_of, vertices_of, .. } = self;
        *vertices_of = slots_of
            .iter()
            .enumerate()
            .map(|(n, slots)| {
                let here = |slot: u32| {
                    let bits = &allowed[slot as usize * BRICK..(slot as usize + 1) * BRICK];
                    (0..BRICK as u16).filter(|&i| bits[usize::from(i)] >> n & 1 == 1).collect()
                };
                slots.iter().map(|&slot| here(slot)).collect()
            })
            .collect();
    }
}

/// One region's part of B in one brick.
struct BlendBrick<'a> {
    /// Activation and residual block of each AU that acts.
    acting: &'a [(f32, &'a [f32])],
    region: usize,
    vertices: &'a [u16],
    gates: &'a [f32],
    out: &'a mut [f32],
}

impl Task for BlendBrick<'_> {
    type Output = ();

    #[allow(unsafe_code, reason = "innermost loop; vertices of a brick are below its size by construction")]
    #[inline(always)]
    fn run<S: Simd>(self) {
        let Self { acting, region, vertices, gates, out } = self;
        assert!(gates.len() >= BRICK * MASKS && out.len() >= BRICK * CHANNELS, "a brick");
        assert!(acting.iter().all(|(_, g)| g.len() >= BRICK * CHANNELS), "a block");
        for &vertex in vertices {
            let at = usize::from(vertex) * CHANNELS;
            // SAFETY: vertices are below BRICK.
            unsafe {
                let gate = reach(*gates.get_unchecked(usize::from(vertex) * MASKS + region));
                if gate == 0.0 {
                    continue;
                }
                let mut sum = [S::q_splat(0.0); 2];
                for &(a, residual) in acting {
                    let (a, g) = (S::q_splat(a), residual.as_ptr().add(at));
                    sum = [S::q_fma(a, S::q_load(g), sum[0]), S::q_fma(a, S::q_load(g.add(4)), sum[1])];
                }
                let gate = S::q_splat(gate);
                let out = out.as_mut_ptr().add(at);
                S::q_store(out, S::q_fma(gate, sum[0], S::q_load(out)));
                S::q_store(out.add(4), S::q_fma(gate, sum[1], S::q_load(out.add(4))));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
            let expected = if e.allowed[vertex] & 1 == 1 { reach(0.5) } else { 0.0 };
            assert!(row.iter().all(|&v| v == expected), "vertex {vertex}: {row:?}");
        }
    }
}
