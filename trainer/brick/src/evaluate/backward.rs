//! The way back.
#![allow(unsafe_code, reason = "gathers and scatters: corners come from the lattices their tables were made for")]

use super::{Deformation, DeformationGrad, Samples, room, split};
use crate::expression::{CHANNELS, MASKS};
use crate::field::{
    COLOR_INPUT, EXPRESSION_AT, FEATURES, Field, FieldGrad, HIDDEN, INPUT, LAYER, LEVELS, MIDDLE, OUTPUT, Transposed,
};
use crate::lattice::{self, Corners};
use crate::matmul;
use crate::simd::{Simd, Task};
use crate::sixteen::{POINTS, Sixteen};

/// Samples whose gradients sum to less than this are left out of the way back.
const QUIET: f32 = 1e-5;

pub(super) struct Backward<'a, 'g> {
    pub(super) samples: &'a mut Samples,
    pub(super) field: &'a Field,
    pub(super) transposed: &'a Transposed,
    pub(super) deformation: Option<&'a Deformation<'a>>,
    pub(super) grad: &'a mut FieldGrad,
    pub(super) deformation_grad: Option<&'a mut DeformationGrad<'g>>,
}

impl Task for Backward<'_, '_> {
    type Output = usize;

    #[inline(always)]
    fn run<S: Simd>(self) -> usize {
        let Self { samples: b, field, transposed: Transposed(turned), deformation, grad, mut deformation_grad } = self;
        // Samples without weight are most of them: the rest moves together.
        b.kept.clear();
        for s in 0..b.len() {
            let d = b.d_color[s];
            let sum = b.d_density[s].abs() + d[0].abs() + d[1].abs() + d[2].abs();
            if sum >= QUIET {
                b.kept.push(s as u32);
            }
        }
        let n = b.kept.len();
        if n > 0 {
            let padded = n.next_multiple_of(16);
            for (v, width) in [
                (&mut b.d_out, OUTPUT),
                (&mut b.d_h3, HIDDEN),
                (&mut b.d_x3, 32),
                (&mut b.d_middle, MIDDLE),
                (&mut b.d_h1, HIDDEN),
                (&mut b.d_x1, 32),
                (&mut b.x1, INPUT),
                (&mut b.h1, HIDDEN),
                (&mut b.x3, COLOR_INPUT),
                (&mut b.h3, HIDDEN),
            ] {
                room(v, padded * width);
            }
            b.d_out[..padded * OUTPUT].fill(0.0);
            for (k, &s) in b.kept.iter().enumerate() {
                let s = s as usize;
                b.d_out[k * OUTPUT..k * OUTPUT + 3].copy_from_slice(&b.d_color[s]);
                if k != s {
                    b.x1.copy_within(s * INPUT..(s + 1) * INPUT, k * INPUT);
                    b.h1.copy_within(s * HIDDEN..(s + 1) * HIDDEN, k * HIDDEN);
                    b.x3.copy_within(s * COLOR_INPUT..(s + 1) * COLOR_INPUT, k * COLOR_INPUT);
                    b.h3.copy_within(s * HIDDEN..(s + 1) * HIDDEN, k * HIDDEN);
                }
            }
            for (v, width) in [(&mut b.x1, INPUT), (&mut b.h1, HIDDEN), (&mut b.x3, COLOR_INPUT), (&mut b.h3, HIDDEN)] {
                v[n * width..padded * width].fill(0.0);
            }
            let dw = &mut grad.net.values;
            grad.net.touched[0] = true;
            matmul::accumulate_weights::<S, HIDDEN, OUTPUT>(&b.h3, &b.d_out, &mut dw[LAYER[3]..], padded);
            matmul::product::<S, OUTPUT, HIDDEN>(&b.d_out, &turned[3], &mut b.d_h3, padded, false);
            matmul::gate::<S>(&b.h3, &mut b.d_h3, padded * HIDDEN);
            matmul::accumulate_weights::<S, COLOR_INPUT, HIDDEN>(&b.x3, &b.d_h3, &mut dw[LAYER[2]..], padded);
            matmul::product::<S, HIDDEN, 32>(&b.d_h3, &turned[2], &mut b.d_x3, padded, false);
            for (k, &s) in b.kept.iter().enumerate() {
                let d = &mut b.d_middle[k * MIDDLE..(k + 1) * MIDDLE];
                d.copy_from_slice(&b.d_x3[k * 32..k * 32 + MIDDLE]);
                d[0] = b.d_density[s as usize];
            }
            b.d_middle[n * MIDDLE..padded * MIDDLE].fill(0.0);
            matmul::accumulate_weights::<S, HIDDEN, MIDDLE>(&b.h1, &b.d_middle, &mut dw[LAYER[1]..], padded);
            matmul::product::<S, MIDDLE, HIDDEN>(&b.d_middle, &turned[1], &mut b.d_h1, padded, false);
            matmul::gate::<S>(&b.h1, &mut b.d_h1, padded * HIDDEN);
            matmul::accumulate_weights::<S, INPUT, HIDDEN>(&b.x1, &b.d_h1, &mut dw[LAYER[0]..], padded);
            matmul::product::<S, HIDDEN, 32>(&b.d_h1, &turned[0], &mut b.d_x1, padded, false);
        }
        let (mut corners, mut levels) = (Sixteen::default(), [Sixteen::default(); LEVELS]);
        let mut places = [[Corners::default(); POINTS]; LEVELS];
        for first in (0..n).step_by(POINTS) {
            let count = (n - first).min(POINTS);
            let kept: [usize; POINTS] = std::array::from_fn(|k| b.kept.get(first + k).map_or(0, |&s| s as usize));
            let warped = split(kept[..count].iter().map(|&s| b.warped[s]));
            let moves = deformation_grad.as_ref().is_some_and(|g| g.moves);
            let wants_motion: [bool; POINTS] = std::array::from_fn(|k| k < count && (b.in_region[kept[k]] || moves));
            let mut d_point = [[0.0f32; 4]; POINTS];
            // As on the way there: what is far away is sent for first.
            for l in 0..field.live {
                field.levels[l].sixteen::<S>(&warped, &mut levels[l]);
                let pages = &mut grad.features[l];
                for k in 0..count {
                    let c = levels[l].corners(k);
                    places[l][k] = pages.places(&c);
                    lattice::prefetch::<S>(pages.values(), FEATURES, &places[l][k].index);
                    if wants_motion[k] {
                        lattice::prefetch::<S>(&field.features[l].values, FEATURES, &c.index);
                    }
                }
            }
            for l in 0..field.live {
                let steps = field.levels[l].steps_per_unit();
                let values = grad.features[l].values();
                for k in 0..count {
                    let (c, w) = (levels[l].corners(k), levels[l].weights(k));
                    // SAFETY: pages hold the places that they give.
                    unsafe {
                        let dv = S::q_load(b.d_x1.as_ptr().add((first + k) * 32 + l * FEATURES));
                        lattice::scatter::<S>(values, FEATURES, 0, &places[l][k], &w, dv);
                        if wants_motion[k] {
                            let e = lattice::dots::<S>(&field.features[l].values, FEATURES, 0, &c, dv);
                            let slope = c.slope(&e);
                            for a in 0..3 {
                                d_point[k][a] += slope[a] * steps[a];
                            }
                        }
                    }
                }
            }
            let (Some(deformation), Some(g)) = (deformation, deformation_grad.as_deref_mut()) else { continue };
            let points = split(kept[..count].iter().map(|&s| b.point[s]));
            deformation.lattice.sixteen::<S>(&points, &mut corners);
            for k in (0..count).filter(|&k| b.in_region[kept[k]]) {
                let (c, w) = (corners.corners(k), corners.weights(k));
                let d = &b.d_x1[(first + k) * 32..(first + k + 1) * 32];
                let shift = [d_point[k][0], d_point[k][1], d_point[k][2], d[EXPRESSION_AT + 4]];
                g.blend.touch(&c.index);
                let blend = g.blend.values.as_mut_slice();
                // SAFETY: as above.
                unsafe {
                    let feature = S::q_load(d.as_ptr().add(EXPRESSION_AT));
                    lattice::scatter::<S>(blend, CHANNELS, 0, &c, &w, feature);
                    lattice::scatter::<S>(blend, CHANNELS, 4, &c, &w, S::q_load(shift.as_ptr()));
                }
            }
            if !g.moves {
                continue;
            }
            if let Some((lattice, _)) = deformation.latent {
                lattice.sixteen::<S>(&points, &mut corners);
                for k in 0..count {
                    let (c, w) = (corners.corners(k), corners.weights(k));
                    // SAFETY: as above.
                    unsafe {
                        lattice::scatter::<S>(g.latent, 4, 0, &c, &w, S::q_load(d_point[k].as_ptr()));
                    }
                }
            }
            for k in 0..count {
                let [x, y, z] = b.point[kept[k]];
                let [gx, gy, gz, _] = d_point[k];
                let turn = [y * gz - z * gy, z * gx - x * gz, x * gy - y * gx];
                for (sum, v) in g.motion.iter_mut().zip(turn.into_iter().chain([gx, gy, gz])) {
                    *sum += v;
                }
            }
        }
        if let (Some(deformation), Some(g)) = (deformation, deformation_grad) {
            for s in 0..b.len() {
                if b.in_region[s] && b.d_masks[s].iter().any(|&d| d != 0.0) {
                    let corners = deformation.lattice.corners(b.point[s]);
                    // SAFETY: as above.
                    unsafe {
                        let d = S::q_load(b.d_masks[s].as_ptr());
                        lattice::scatter::<S>(g.gates, MASKS, 0, &corners, &corners.weights(), d);
                    }
                }
            }
        }
        n
    }
}
