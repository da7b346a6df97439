//! Fields baked for fast pictures: density and colour at the vertices of one lattice, instead of grids and networks.
//!
//! Between vertices the raw density is interpolated, so that surfaces stay sharp and in place. What gets lost is detail
//! finer than the lattice, and how colours change with the direction: they are those of the view the vertices were baked
//! for. Callers measure both and say so.

use rayon::prelude::*;

use crate::evaluate::{Deformation, Samples};
use crate::field::{Field, monomials};
use crate::lattice::{self, BRICK, EDGE, Lattice};
use crate::march::{Found, March, SixteenMarches};
use crate::math;
use crate::model::Part;
use crate::occupancy::{CELLS, PARTS, cell_position};
use crate::simd::{self, Simd, Task};
use crate::sixteen::{Each, POINTS, Sixteen};

/// Raw density, then red, green and blue, 0–1.
const CHANNELS: usize = 4;
/// Vertices that are evaluated together.
const CHUNK: usize = 512;

/// A part of the scene, baked.
#[derive(Clone, Debug)]
pub(crate) struct Baked {
    lattice: Lattice,
    values: Vec<f32>,
    /// Every vertex that a sample in an occupied part can touch: where it is in memory, and in the box.
    vertices: Vec<(u32, [f32; 3])>,
}

/// Bricks that a ray can name.
const NAMED: usize = 12;

/// The baked bricks that a ray took samples from; more than it can name counts as all.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Crossed {
    slots: [u16; NAMED],
    count: u8,
}

impl Crossed {
    pub(crate) const NONE: Self = Self { slots: [0; NAMED], count: 0 };

    #[inline(always)]
    fn add(&mut self, slot: u32) {
        let known = &self.slots[..usize::from(self.count).min(NAMED)];
        if usize::from(self.count) <= NAMED && !known.contains(&(slot as u16)) {
            if let Some(place) = self.slots.get_mut(usize::from(self.count)) {
                *place = slot as u16;
            }
            self.count += 1;
        }
    }

    /// Whether a brick of `stale` (a flag per slot) is among them.
    #[inline]
    pub(crate) fn any(&self, stale: &[bool]) -> bool {
        let count = usize::from(self.count);
        count > NAMED || self.slots[..count].iter().any(|&s| stale[usize::from(s)])
    }
}

/// What a baked ray shows: colour, transmittance left, Σ weight · t, Σ weight.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Through {
    pub(crate) color: [f32; 3],
    pub(crate) left: f32,
    pub(crate) depth: [f32; 2],
    pub(crate) crossed: Crossed,
}

impl Baked {
    /// Bakes the occupied parts of `part` on `size` vertices (multiples of 8); `direction_at` gives the unit direction in
    /// which a point of the box is seen, world axes.
    pub(crate) fn new(
        part: &Part,
        deformation: Option<&Deformation<'_>>,
        size: [usize; 3],
        direction_at: impl Fn([f32; 3]) -> [f32; 3] + Sync,
    ) -> Self {
        let mut lattice = Lattice::sparse(size);
        let wanted = wanted_vertices(part, size);
        let [nx, ny, _] = lattice.bricks();
        let mut vertices = Vec::new();
        for (brick, wanted) in wanted.iter().enumerate().filter(|(_, w)| w.iter().any(|&v| v != 0)) {
            lattice.allocate(brick);
            let first = [brick % nx, brick / nx % ny, brick / nx / ny].map(|b| b * EDGE);
            let slot = lattice.slot[brick] as usize;
            for i in (0..BRICK).filter(|i| wanted[i / 64] >> (i % 64) & 1 == 1) {
                let vertex = [first[0] + i % EDGE, first[1] + i / EDGE % EDGE, first[2] + i / EDGE / EDGE];
                vertices.push(((slot * BRICK + i) as u32, lattice.position(vertex)));
            }
        }
        let values = vec![0.0; lattice.slots * BRICK * CHANNELS];
        let mut baked = Self { lattice, values, vertices };
        baked.bake(&part.field, deformation, direction_at, |_| true);
        baked
    }

    /// Evaluates anew the vertices for which `stale` holds; gives a flag per brick that holds one.
    pub(crate) fn bake(
        &mut self,
        field: &Field,
        deformation: Option<&Deformation<'_>>,
        direction_at: impl Fn([f32; 3]) -> [f32; 3] + Sync,
        stale: impl Fn([f32; 3]) -> bool + Sync,
    ) -> Vec<bool> {
        let chunks: Vec<Vec<(u32, [f32; CHANNELS])>> = self
            .vertices
            .par_chunks(CHUNK)
            .map_init(Samples::default, |samples, chunk| {
                samples.clear();
                let rows: Vec<u32> = chunk
                    .iter()
                    .filter(|(_, p)| stale(*p))
                    .map(|&(row, p)| {
                        samples.ray.push(samples.point.len() as u32);
                        samples.point.push(p);
                        samples.directions.push(monomials(direction_at(p)));
                        row
                    })
                    .collect();
                samples.forward(field, deformation, 0);
                samples.color_all(field, 0);
                let value = |i: usize| {
                    let [r, g, b] = samples.color(i).map(math::sigmoid);
                    [samples.density(i), r, g, b]
                };
                rows.into_iter().enumerate().map(|(i, row)| (row, value(i))).collect()
            })
            .collect();
        let mut changed = vec![false; self.lattice.slots];
        for (row, value) in chunks.iter().flatten() {
            self.values[*row as usize * CHANNELS..][..CHANNELS].copy_from_slice(value);
            changed[*row as usize / BRICK] = true;
        }
        changed
    }

    /// Number of baked vertices.
    pub(crate) fn len(&self) -> usize {
        self.vertices.len()
    }

    /// Follows up to sixteen rays until less than `opaque` is left of each; `left` is what they begin with.
    #[inline]
    pub(crate) fn send(&self, part: &Part, marches: &[March], left: &[f32], opaque: f32) -> [Through; POINTS] {
        simd::run(Send { baked: self, part, marches, left, opaque })
    }
}

/// A bit for each vertex of each brick that lies around an occupied part.
fn wanted_vertices(part: &Part, size: [usize; 3]) -> Vec<[u64; BRICK / 64]> {
    let bricks = size.map(|n| n / EDGE);
    let mut wanted = vec![[0u64; BRICK / 64]; bricks.iter().product()];
    let range = |position: usize, a: usize| {
        let per_part = (size[a] - 1) as f32 / PARTS as f32;
        let low = (position as f32 * per_part) as usize;
        let high = (((position + 1) as f32 * per_part).ceil() as usize).min(size[a] - 1);
        low..=high
    };
    for (cell, &bits) in part.occupancy.bits.iter().enumerate().filter(|(_, b)| **b != 0) {
        let first = cell_position(cell).map(|v| 2 * v);
        for bit in (0..8).filter(|bit| bits >> bit & 1 == 1) {
            let at = [first[0] + (bit & 1), first[1] + (bit >> 1 & 1), first[2] + (bit >> 2)];
            for z in range(at[2], 2) {
                for y in range(at[1], 1) {
                    for x in range(at[0], 0) {
                        let brick = (z / EDGE * bricks[1] + y / EDGE) * bricks[0] + x / EDGE;
                        let i = (z % EDGE * EDGE + y % EDGE) * EDGE + x % EDGE;
                        wanted[brick][i / 64] |= 1 << (i % 64);
                    }
                }
            }
        }
    }
    debug_assert!(part.occupancy.bits.len() == CELLS.pow(3), "one byte per cell");
    wanted
}

struct Send<'a> {
    baked: &'a Baked,
    part: &'a Part,
    marches: &'a [March],
    left: &'a [f32],
    opaque: f32,
}

impl Task for Send<'_> {
    type Output = [Through; POINTS];

    #[inline(always)]
    #[allow(unsafe_code, reason = "corners come from the lattice that the values were baked for")]
    fn run<S: Simd>(self) -> [Through; POINTS] {
        let Self { baked, part, marches, left, opaque } = self;
        assert!(marches.len() <= POINTS && marches.len() == left.len(), "sixteen rays at most");
        let nothing = Through { color: [0.0; 3], left: 0.0, depth: [0.0; 2], crossed: Crossed::NONE };
        let mut out = [nothing; POINTS];
        let (mut sixteen, mut found, mut corners) = (SixteenMarches::default(), Found::default(), Sixteen::default());
        let mut step: Each<f32> = [0.0; POINTS];
        let mut going = 0u16;
        for (i, (march, &left)) in marches.iter().zip(left).enumerate() {
            sixteen.put(i, march);
            step[i] = march.step;
            out[i].left = left;
            going |= u16::from(left >= opaque) << i;
        }
        while going != 0 {
            part.occupancy.next_of_sixteen::<S>(&mut sixteen, going, &mut found);
            going = found.rays;
            baked.lattice.sixteen::<S>(&found.points, &mut corners);
            for i in (0..marches.len()).filter(|i| found.rays >> i & 1 == 1) {
                let (c, through) = (corners.corners(i), &mut out[i]);
                let [first, .., last] = c.index.map(|i| i / BRICK as u32);
                through.crossed.add(first);
                if first != last {
                    c.index.iter().for_each(|i| through.crossed.add(i / BRICK as u32));
                }
                let mut value = [0.0; CHANNELS];
                // SAFETY: `values` has a row for every slot of the lattice.
                unsafe {
                    let v = lattice::gather::<S>(&baked.values, CHANNELS, 0, &c, &corners.weights(i));
                    S::q_store(value.as_mut_ptr(), v);
                }
                let alpha = 1.0 - math::exp(-math::density(value[0]) * step[i]);
                let w = through.left * alpha;
                for c in 0..3 {
                    through.color[c] += w * value[c + 1];
                }
                through.depth = [through.depth[0] + w * found.t[i], through.depth[1] + w];
                through.left *= 1.0 - alpha;
                if through.left < opaque {
                    going &= !(1 << i);
                }
            }
        }
        out
    }
}
