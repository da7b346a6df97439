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

/// Samples whose gradients sum to less than this say nothing.
const NOTHING: f32 = 1e-12;

/// Which samples go the way back. Those whose gradients sum to `below` or more do; of the others each goes with the chance
/// sum / `below`, and then counts for as many as stayed behind: the mean over draws is what all of them would give.
#[derive(Clone, Copy, Debug, Default)]
pub struct Lot {
    /// From here on a sample goes for certain; 0 sends all.
    pub below: f32,
    /// 0–1, drawn anew for every call.
    pub ticket: f32,
}

impl Lot {
    /// What the next sample's gradient is multiplied by, if it goes. Chances are added up, and a sample goes whenever the
    /// sum passes a whole number: as fair as a draw for each, with less luck in it.
    #[inline(always)]
    fn draw(&mut self, sum: f32) -> Option<f32> {
        if sum < NOTHING || sum.is_nan() {
            return None;
        }
        if sum >= self.below {
            return Some(1.0);
        }
        self.ticket += sum / self.below;
        (self.ticket >= 1.0).then(|| {
            self.ticket -= 1.0;
            self.below / sum
        })
    }
}

pub(super) struct Backward<'a, 'g> {
    pub(super) samples: &'a mut Samples,
    pub(super) field: &'a Field,
    pub(super) transposed: &'a Transposed,
    pub(super) deformation: Option<&'a Deformation<'a>>,
    pub(super) lot: Lot,
    pub(super) grad: &'a mut FieldGrad,
    pub(super) deformation_grad: Option<&'a mut DeformationGrad<'g>>,
}

impl Task for Backward<'_, '_> {
    type Output = usize;

    #[inline(always)]
    fn run<S: Simd>(self) -> usize {
        let Self {
            samples: b,
            field,
            transposed: Transposed(turned),
            deformation,
            mut lot,
            grad,
            mut deformation_grad,
        } = self;
        // Samples without weight are most of them: the rest moves together.
        b.kept.clear();
        for s in 0..b.len() {
            let d = b.d_color[s];
            let sum = b.d_density[s].abs() + d[0].abs() + d[1].abs() + d[2].abs();
            if let Some(weight) = lot.draw(sum) {
                b.d_density[s] *= weight;
                b.d_color[s] = d.map(|d| weight * d);
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

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// What a lot lets through is worth what went in: nearly so in each draw, exactly in the mean over all tickets.
    #[test]
    fn a_lot_is_fair() {
        const TICKETS: usize = 4000;
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        let sums: Vec<f32> = (0..500).map(|_| 10f32.powf(rng.random::<f32>() * 6.0 - 7.0)).collect();
        let all: f64 = sums.iter().map(|&s| f64::from(s)).sum();
        let below = 1e-3;
        let mut mean = vec![0.0; sums.len()];
        let mut went = 0;
        for ticket in 0..TICKETS {
            let mut lot = Lot { below, ticket: (ticket as f32 + 0.5) / TICKETS as f32 };
            let worth: Vec<f64> = sums.iter().map(|&s| lot.draw(s).map_or(0.0, |w| f64::from(w * s))).collect();
            went += worth.iter().filter(|w| **w > 0.0).count();
            assert!((worth.iter().sum::<f64>() - all).abs() < 1.01 * f64::from(below), "ticket {ticket}");
            mean.iter_mut().zip(worth).for_each(|(m, w)| *m += w / TICKETS as f64);
        }
        for (mean, &sum) in mean.iter().zip(&sums) {
            assert!((mean - f64::from(sum)).abs() < 1e-6 + 0.02 * f64::from(sum), "{mean} of {sum}");
        }
        assert!(went < TICKETS * sums.len() / 2, "most of these stay behind");
    }

    #[test]
    fn nothing_is_drawn_from_nothing_and_everything_goes_without_a_lot() {
        let mut lot = Lot { below: 1e-3, ticket: 0.999_999 };
        for sum in [0.0, f32::MIN_POSITIVE, 1e-13, f32::NAN] {
            assert_eq!(lot.draw(sum), None, "{sum}");
        }
        assert!(lot.draw(1e-6).is_some_and(|w| (w - 1e3).abs() < 1.0));
        let mut lot = Lot::default();
        assert!([1e-12, 1e-6, 1.0, f32::MAX].iter().all(|&sum| lot.draw(sum) == Some(1.0)));
    }
}
