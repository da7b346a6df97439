//! Mends the holes that culling leaves in surfaces which few rays met, once a fit is over.
//!
//! While a fit goes on, a part of the box is looked into while some pixel sees it. A part that a surface only grazes may
//! go unseen long enough to be closed, and shows as a pinhole. Here parts beside open ones are opened where the field
//! itself is dense. What lies behind a surface is opened with it, and costs nothing: no ray gets there.

use rayon::prelude::*;

use crate::evaluate::{Deformation, Samples};
use crate::lattice::BRICK;
use crate::math;
use crate::model::{Brick, Part, deformation};
use crate::occupancy::{COUNT, Occupancy, PARTS, cell_and_bit};

/// A part that a ray loses this much in, over one sample, is opened.
const OPAQUE_ENOUGH: f32 = 0.1;
/// Points that are evaluated together.
const CHUNK: usize = 504;
/// Points looked at in a part: its middle and towards its corners.
const POINTS: usize = 9;

/// Opens what is dense beside what is open, in any of the `expressions` (activations, codes included); gives the bits as
/// they were.
pub fn heal(model: &mut Brick, expressions: &[Vec<f32>]) -> [Vec<u8>; 2] {
    let gates = model.expression.gates();
    let beside = beside_open(&model.head.occupancy);
    let lattice = &model.expression.lattice;
    // Only regions differ from one expression to the next.
    let in_regions: Vec<[usize; 3]> = beside
        .iter()
        .copied()
        .filter(|&p| lattice.corners(center(p)).index.iter().any(|&corner| corner >= BRICK as u32))
        .collect();
    let mut opened: Vec<[usize; 3]> = Vec::new();
    let mut blend = Vec::new();
    for (i, activations) in expressions.iter().enumerate() {
        model.expression.blend(&gates, activations, &mut blend);
        let deformation = deformation(model, &blend, &gates, None);
        let parts = if i == 0 { &beside } else { &in_regions };
        opened.extend(dense(&model.head, Some(&deformation), parts, 2.0 / model.divisions as f32));
    }
    let before = [
        model.head.occupancy.bits.clone(),
        model.background.as_ref().map(|p| p.occupancy.bits.clone()).unwrap_or_default(),
    ];
    open(&mut model.head.occupancy, &opened);
    if let Some(part) = &mut model.background {
        let opened = dense(part, None, &beside_open(&part.occupancy), 2.0 / model.planes as f32);
        open(&mut part.occupancy, &opened);
    }
    before
}

/// Closes again what [`heal`] opened.
pub fn unheal(model: &mut Brick, before: [Vec<u8>; 2]) {
    let [head, background] = before;
    model.head.occupancy.bits = head;
    model.head.occupancy.refresh();
    if let Some(part) = &mut model.background {
        part.occupancy.bits = background;
        part.occupancy.refresh();
    }
}

fn center(part: [usize; 3]) -> [f32; 3] {
    part.map(|v| (v as f32 + 0.5) * (2.0 / PARTS as f32) - 1.0)
}

fn open(occupancy: &mut Occupancy, parts: &[[usize; 3]]) {
    for &part in parts {
        let (cell, bit) = cell_and_bit(part);
        occupancy.bits[cell] |= 1 << bit;
    }
    occupancy.refresh();
}

/// Closed parts with an open one beside them, across edges and corners too.
fn beside_open(occupancy: &Occupancy) -> Vec<[usize; 3]> {
    let is_open = |part: [usize; 3]| {
        let (cell, bit) = cell_and_bit(part);
        occupancy.bits[cell] >> bit & 1 == 1
    };
    let at = |i: usize| [i % PARTS, i / PARTS % PARTS, i / PARTS / PARTS];
    let mut near: Vec<bool> = (0..8 * COUNT).map(|i| is_open(at(i))).collect();
    // Along one axis after the other.
    for stride in [1, PARTS, PARTS * PARTS] {
        near = (0..near.len())
            .map(|i| {
                let along = i / stride % PARTS;
                near[i] || (along > 0 && near[i - stride]) || (along + 1 < PARTS && near[i + stride])
            })
            .collect();
    }
    (0..8 * COUNT).filter(|&i| near[i]).map(at).filter(|&part| !is_open(part)).collect()
}

/// Those of `parts` that hold something.
fn dense(part: &Part, deformation: Option<&Deformation<'_>>, parts: &[[usize; 3]], step: f32) -> Vec<[usize; 3]> {
    parts
        .par_chunks(CHUNK / POINTS)
        .map_init(Samples::default, |samples, parts| {
            samples.clear();
            for &at in parts {
                let middle = center(at);
                samples.point.push(middle);
                for corner in 0..8 {
                    let towards = |a: usize| (if corner >> a & 1 == 1 { 0.7 } else { -0.7 }) / PARTS as f32;
                    samples.point.push(std::array::from_fn(|a| middle[a] + towards(a)));
                }
            }
            samples.ray.resize(samples.point.len(), 0);
            samples.forward(&part.field, deformation, 0);
            let largest = |i: usize| {
                (i * POINTS..(i + 1) * POINTS).map(|p| math::density(samples.density(p))).fold(0.0, f32::max)
            };
            let is_dense = |i: &usize| 1.0 - (-largest(*i) * step).exp() > OPAQUE_ENOUGH;
            (0..parts.len()).filter(is_dense).map(|i| parts[i]).collect::<Vec<_>>()
        })
        .flatten_iter()
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::{HIDDEN, LAYER, MIDDLE, ONE_AT};
    use crate::model::{HeadBox, LATENT, Layout};

    /// A head whose raw density is `raw` everywhere, open in a sheet of parts with one missing.
    fn sheet(raw: f32) -> Brick {
        let layout = Layout {
            head_box: HeadBox { center: [0.0; 3], half: 0.5 },
            background: None,
            region_of: vec![0],
            regions: 1,
            images: 1,
            expression_vertices: 16,
            finest: 128,
        };
        let mut model = Brick::new(layout, 0, |_| 1);
        let net = &mut model.head.field.net.values;
        net.fill(0.0);
        net[LAYER[0] + ONE_AT * HIDDEN] = 1.0;
        net[LAYER[1]] = raw;
        assert!(net.len() > LAYER[1] + MIDDLE);
        let o = &mut model.head.occupancy;
        o.bits.fill(0);
        for x in 20..40 {
            for y in 20..40 {
                let (cell, bit) = cell_and_bit([x, y, 64]);
                o.bits[cell] |= 1 << bit;
            }
        }
        let (cell, bit) = cell_and_bit(HOLE);
        o.bits[cell] &= !(1 << bit);
        o.refresh();
        model
    }

    const HOLE: [usize; 3] = [31, 27, 64];

    #[test]
    fn a_hole_in_something_is_mended_and_nothing_stays_nothing() {
        let expressions = [vec![0.0; 1 + LATENT]];
        let is_open = |model: &Brick, part| {
            let (cell, bit) = cell_and_bit(part);
            model.head.occupancy.bits[cell] >> bit & 1 == 1
        };
        let mut model = sheet(7.0);
        let bits = model.head.occupancy.bits.clone();
        let before = heal(&mut model, &expressions);
        assert!(is_open(&model, HOLE) && is_open(&model, [31, 27, 65]) && !is_open(&model, [31, 27, 66]));
        unheal(&mut model, before);
        assert_eq!(model.head.occupancy.bits, bits);
        let mut empty = sheet(-3.0);
        heal(&mut empty, &expressions);
        assert_eq!(empty.head.occupancy.bits, bits, "thin air is not opened");
    }
}
