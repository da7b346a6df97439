//! Which cells stay looked into, and which bricks get room, as a fit goes on.
//!
//! A cell is kept while its density, lately and over the expressions of random training images, is above a threshold,
//! or beside such a cell; later also only while it has shown in some pixel. Thresholds follow the mean density, or
//! culling before anything has grown would empty the grid.

use rand::Rng;
use rayon::prelude::*;

use crate::evaluate::Samples;
use crate::fit::{Views, rng_for};
use crate::lattice::EDGE;
use crate::math;
use crate::model::{Brick, Part, deformation};
use crate::occupancy::{CELLS, COUNT, PARTS, WHOLE, cell_position};

/// The threshold: this many times the mean density …
const MEAN_SHARE: f32 = 1.5;
/// … but at most this density …
const AT_MOST: f32 = 8.0;
/// … and at most this share of the largest one: even fog must not vanish because no cell stands out of it.
const MOST_OF_LARGEST: f32 = 0.5;
/// A cell that never had more than this weight in a pixel is hidden or empty.
pub(crate) const SEEN: f32 = 0.01;
/// The stage from which single parts of cells are culled: surfaces are thin by then.
const THIN: usize = 3;
/// Steps from one look to the next, once a fit is under way.
pub(crate) const EVERY: u64 = 16;
/// Every so many looks the neighbours of what was seen stay as well.
const WIDE_EVERY: u64 = 4;
/// The first step that culls.
const FIRST: u64 = 160;
/// Until this step every cell is looked at each time.
const THOROUGH: u64 = 400;

/// Looks at cells of both parts and decides anew what is occupied.
pub(crate) fn update(
    model: &mut Brick,
    views: &impl Views,
    seed: u64,
    step: u64,
    stage: usize,
    weights: &[Vec<f32>; 2],
) {
    let gates = model.expression.gates();
    for part_index in 0..2 {
        if part_index == 1 && model.background.is_none() {
            continue;
        }
        let seen: Vec<(usize, f32)> = (0..8u64)
            .into_par_iter()
            .flat_map_iter(|share| look(model, views, &gates, part_index, seed, step, share as usize))
            .collect();
        let in_region: Vec<bool> = if part_index == 0 { region_cells(model) } else { vec![false; COUNT] };
        let part = if part_index == 0 { Some(&mut model.head) } else { model.background.as_mut() };
        let Some(part) = part else { continue };
        let o = &mut part.occupancy;
        for (cell, v) in o.density.iter_mut().enumerate() {
            *v *= if in_region[cell] { 0.99 } else { 0.96 };
        }
        for (cell, v) in seen {
            o.density[cell] = o.density[cell].max(v);
        }
        let rows = o.weight.par_chunks_exact_mut(8).zip(weights[part_index].par_chunks_exact(8));
        rows.zip(&in_region).for_each(|((old, new), &in_region)| {
            let decay = if in_region { 0.93 } else { 0.8 };
            old.iter_mut().zip(new).for_each(|(old, &new)| *old = (*old * decay).max(new));
        });
        if step < FIRST {
            continue;
        }
        let mean = o.density.iter().map(|&v| f64::from(v)).sum::<f64>() / COUNT as f64;
        let largest = o.density.iter().copied().fold(0.0, f32::max);
        let threshold = (MEAN_SHARE * mean as f32).min(AT_MOST).min(MOST_OF_LARGEST * largest);
        for cell in 0..COUNT {
            o.bits[cell] = if o.density[cell] > threshold { WHOLE } else { 0 };
        }
        o.dilate();
        let dense = o.bits.clone();
        if stage >= THIN {
            // Now and then the parts around are looked into as well: a surface may have moved on.
            o.keep_seen_parts(SEEN, (step / EVERY).is_multiple_of(WIDE_EVERY));
        } else if stage >= 1 {
            for (bits, weight) in o.bits.iter_mut().zip(o.weight.as_chunks::<8>().0) {
                if weight.iter().all(|&w| w < SEEN) {
                    *bits = 0;
                }
            }
        }
        if o.bits.iter().all(|&b| b == 0) {
            // Nothing was seen: a pixel may yet ask for what is here, and an empty grid could never answer.
            o.bits = dense;
        }
        if part_index == 1 {
            // The two farthest layers stay: something is behind everything.
            o.bits[..2 * CELLS * CELLS].fill(WHOLE);
        }
        o.refresh();
    }
}

/// Densities at random points of a share of the cells, under the expression of a random image.
fn look(
    model: &Brick,
    views: &impl Views,
    gates: &[f32],
    part_index: usize,
    seed: u64,
    step: u64,
    share: usize,
) -> Vec<(usize, f32)> {
    let mut rng = rng_for(seed, step, 512 + 16 * part_index as u64 + share as u64);
    let part = if part_index == 0 { Some(&model.head) } else { model.background.as_ref() };
    let Some(part) = part else { return Vec::new() };
    let mut blend = Vec::new();
    if part_index == 0 {
        let view = rng.random_range(0..views.count());
        let attributes = crate::fit::activations(model, views, view, true);
        model.expression.blend(gates, &attributes, &mut blend);
    }
    let deformation = (part_index == 0).then(|| deformation(model, &blend, gates, None));
    let mut samples = Samples::default();
    let mut cells = Vec::new();
    let mut out = Vec::new();
    let edge = 2.0 / CELLS as f32;
    for cell in (share..COUNT).step_by(8) {
        if step >= THOROUGH && part.occupancy.bits[cell] == 0 && rng.random_range(0..8) != 0 {
            continue;
        }
        let position = cell_position(cell);
        samples.point.push(std::array::from_fn(|a| (position[a] as f32 + rng.random::<f32>()) * edge - 1.0));
        samples.ray.push(0);
        cells.push(cell);
        if cells.len() == 512 || cell + 8 >= COUNT {
            flush(part, deformation.as_ref(), &mut samples, &mut cells, &mut out);
        }
    }
    flush(part, deformation.as_ref(), &mut samples, &mut cells, &mut out);
    out
}

fn flush(
    part: &Part,
    deformation: Option<&crate::evaluate::Deformation<'_>>,
    samples: &mut Samples,
    cells: &mut Vec<usize>,
    out: &mut Vec<(usize, f32)>,
) {
    samples.forward(&part.field, deformation, 0);
    out.extend(cells.iter().enumerate().map(|(i, &cell)| (cell, math::density(samples.density(i)))));
    samples.clear();
    cells.clear();
}

/// Cells inside the expression's bricks: what is there comes and goes with the AUs.
fn region_cells(model: &Brick) -> Vec<bool> {
    let lattice = &model.expression.lattice;
    let bricks = lattice.bricks();
    (0..COUNT)
        .map(|cell| {
            let p = cell_position(cell);
            let b: [usize; 3] = std::array::from_fn(|a| (p[a] * bricks[a] / CELLS).min(bricks[a] - 1));
            lattice.slot[(b[2] * bricks[1] + b[1]) * bricks[0] + b[0]] != 0
        })
        .collect()
}

/// Gives the sparse live levels bricks wherever a cell is looked into.
pub(crate) fn allocate(part: &mut Part, rng: &mut impl Rng) {
    let edge = 2.0 / PARTS as f32;
    for l in 0..part.field.live {
        if !part.field.levels[l].sparse {
            continue;
        }
        let (vertices, bricks) = (part.field.levels[l].vertices, part.field.levels[l].bricks());
        // The bricks that hold the vertices around a part of the box.
        let range = |position: usize, a: usize| {
            let steps = (vertices[a] - 1) as f32 * 0.5;
            let low = (position as f32 * edge * steps) as usize;
            let high = ((position + 1) as f32 * edge * steps) as usize + 1;
            low / EDGE..=high.min(vertices[a] - 1) / EDGE
        };
        for cell in 0..COUNT {
            let bits = part.occupancy.bits[cell];
            let first = cell_position(cell).map(|v| 2 * v);
            for bit in (0..8).filter(|bit| bits >> bit & 1 == 1) {
                let p = [first[0] + (bit & 1), first[1] + (bit >> 1 & 1), first[2] + (bit >> 2)];
                for z in range(p[2], 2) {
                    for y in range(p[1], 1) {
                        for x in range(p[0], 0) {
                            part.field.levels[l].allocate((z * bricks[1] + y) * bricks[0] + x);
                        }
                    }
                }
            }
        }
        part.field.grow(l, rng);
    }
}
