//! A field at many samples, and the way back. One call works on one chunk of samples that fits the cache.
#![allow(unsafe_code, reason = "gathers and scatters: corners come from the lattices their tables were made for")]

use crate::expression::{CHANNELS, MASKS};
use crate::field::{
    COLOR_INPUT, EXPRESSION_AT, FEATURES, Field, FieldGrad, HIDDEN, INPUT, LAYER, LEVELS, MIDDLE, ONE_AT, OUTPUT,
    Transposed,
};
use crate::lattice::{self, Lattice};
use crate::matmul;
use crate::simd::{Simd, Task};

/// What an image's expression does to the field.
#[derive(Clone, Copy, Debug)]
pub struct Deformation<'a> {
    /// The bricks of the regions.
    pub lattice: &'a Lattice,
    /// B, see [`crate::expression`].
    pub blend: &'a [f32],
    /// The masks at the vertices.
    pub gates: &'a [f32],
    /// The image's own displacement, 4 numbers per vertex (the last unused).
    pub latent: Option<(&'a Lattice, &'a [f32])>,
}

/// Gradients of a [`Deformation`] and of where the samples lie.
#[derive(Debug)]
pub struct DeformationGrad<'a> {
    /// Of B.
    pub blend: &'a mut [f32],
    /// Of the masks at the vertices.
    pub gates: &'a mut [f32],
    /// Of the image's own displacement.
    pub latent: &'a mut [f32],
    /// Of a small turn and shift of all points: Σ p × g, Σ g.
    pub motion: &'a mut [f32; 6],
    /// Whether latent displacement and motion are learned at all.
    pub moves: bool,
}

/// The samples of a chunk and everything that was computed for them.
#[derive(Clone, Debug, Default)]
pub struct Samples {
    /// Where, in the box.
    pub point: Vec<[f32; 3]>,
    /// The ray of each sample, an index into `directions`.
    pub ray: Vec<u32>,
    /// The direction's monomials of each ray.
    pub directions: Vec<[f32; 8]>,
    /// Where the features were looked up.
    warped: Vec<[f32; 3]>,
    /// Whether a region's brick holds the sample.
    in_region: Vec<bool>,
    x1: Vec<f32>,
    h1: Vec<f32>,
    middle: Vec<f32>,
    x3: Vec<f32>,
    h3: Vec<f32>,
    out: Vec<f32>,
    /// The masks at the samples.
    pub masks: Vec<[f32; MASKS]>,
    /// Gradient of the raw density.
    pub d_density: Vec<f32>,
    /// Gradient of the raw colour.
    pub d_color: Vec<[f32; 3]>,
    /// Gradient of the masks.
    pub d_masks: Vec<[f32; MASKS]>,
    kept: Vec<u32>,
    d_out: Vec<f32>,
    d_h3: Vec<f32>,
    d_x3: Vec<f32>,
    d_middle: Vec<f32>,
    d_h1: Vec<f32>,
    d_x1: Vec<f32>,
}

/// Samples whose gradients sum to less than this are left out of the way back.
const QUIET: f32 = 1e-5;

fn room(v: &mut Vec<f32>, n: usize) {
    if v.len() < n {
        v.resize(n, 0.0);
    }
}

impl Samples {
    /// Forgets all samples, keeps the memory.
    pub fn clear(&mut self) {
        self.point.clear();
        self.ray.clear();
        self.directions.clear();
    }

    /// Number of samples.
    pub fn len(&self) -> usize {
        self.point.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.point.is_empty()
    }

    /// Raw density of sample `i`.
    #[inline(always)]
    pub fn density(&self, i: usize) -> f32 {
        self.middle[i * MIDDLE]
    }

    /// Makes sample `i` show nothing.
    pub fn silence(&mut self, i: usize) {
        self.middle[i * MIDDLE] = -1e9;
    }

    /// Raw colour of sample `i`.
    #[inline(always)]
    pub fn color(&self, i: usize) -> [f32; 3] {
        [self.out[i * OUTPUT], self.out[i * OUTPUT + 1], self.out[i * OUTPUT + 2]]
    }

    /// Evaluates `field` at the samples from `from` on.
    pub fn forward(&mut self, field: &Field, deformation: Option<&Deformation<'_>>, from: usize) {
        if from < self.len() {
            crate::simd::run(Forward { samples: self, field, deformation, from, colors: true });
        }
    }

    /// As [`Self::forward`] from the first sample on, with the instructions of `level`.
    #[cfg(test)]
    pub(crate) fn forward_at(
        &mut self,
        level: crate::simd::Level,
        field: &Field,
        deformation: Option<&Deformation<'_>>,
    ) {
        crate::simd::run_at(level, Forward { samples: self, field, deformation, from: 0, colors: true });
    }

    /// Evaluates only the density, at all samples; they need no ray.
    pub fn forward_density(&mut self, field: &Field, deformation: Option<&Deformation<'_>>) {
        if !self.is_empty() {
            crate::simd::run(Forward { samples: self, field, deformation, from: 0, colors: false });
        }
    }

    /// Adds the gradients that `d_density`, `d_color` and `d_masks` cause. Returns how many samples mattered.
    pub fn backward(
        &mut self,
        field: &Field,
        transposed: &Transposed,
        deformation: Option<&Deformation<'_>>,
        grad: &mut FieldGrad,
        deformation_grad: Option<&mut DeformationGrad<'_>>,
    ) -> usize {
        crate::simd::run(Backward { samples: self, field, transposed, deformation, grad, deformation_grad })
    }
}

struct Forward<'a> {
    samples: &'a mut Samples,
    field: &'a Field,
    deformation: Option<&'a Deformation<'a>>,
    from: usize,
    colors: bool,
}

impl Task for Forward<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        let Self { samples: b, field, deformation, from, colors } = self;
        let n = b.len();
        // Rows from `from` on, in whole blocks; rows beyond `n` are scratch.
        let rows = (n - from).next_multiple_of(16);
        let padded = from + rows;
        for (v, width) in [
            (&mut b.x1, INPUT),
            (&mut b.h1, HIDDEN),
            (&mut b.middle, MIDDLE),
            (&mut b.x3, COLOR_INPUT),
            (&mut b.h3, HIDDEN),
            (&mut b.out, OUTPUT),
        ] {
            room(v, padded * width);
        }
        b.warped.resize(n, [0.0; 3]);
        b.in_region.resize(n, false);
        b.masks.resize(n, [0.0; MASKS]);
        for s in from..n {
            let x = &mut b.x1[s * INPUT..(s + 1) * INPUT];
            x[EXPRESSION_AT..].fill(0.0);
            x[ONE_AT] = 1.0;
            let mut p = b.point[s];
            b.in_region[s] = false;
            b.masks[s] = [0.0; MASKS];
            if let Some(d) = deformation {
                let corners = d.lattice.corners(p);
                let mut shift = [0.0; 4];
                // SAFETY: the blend and the gates have a row for every slot of the lattice.
                unsafe {
                    if corners.index.iter().any(|&i| i >= lattice::BRICK as u32) {
                        b.in_region[s] = true;
                        let w = corners.weights();
                        S::q_store(
                            x.as_mut_ptr().add(EXPRESSION_AT),
                            lattice::gather::<S>(d.blend, CHANNELS, 0, &corners, &w),
                        );
                        S::q_store(shift.as_mut_ptr(), lattice::gather::<S>(d.blend, CHANNELS, 4, &corners, &w));
                        S::q_store(b.masks[s].as_mut_ptr(), lattice::gather::<S>(d.gates, MASKS, 0, &corners, &w));
                        x[EXPRESSION_AT + 4] = shift[3];
                    }
                    if let Some((lattice, values)) = d.latent {
                        let corners = lattice.corners(p);
                        let mut own = [0.0; 4];
                        S::q_store(own.as_mut_ptr(), lattice::gather::<S>(values, 4, 0, &corners, &corners.weights()));
                        for a in 0..3 {
                            shift[a] += own[a];
                        }
                    }
                }
                for a in 0..3 {
                    p[a] += shift[a];
                }
            }
            b.warped[s] = p;
            for l in 0..LEVELS {
                if l >= field.live {
                    x[l * FEATURES..(l + 1) * FEATURES].fill(0.0);
                    continue;
                }
                let corners = field.levels[l].corners(p);
                // SAFETY: the table has a row for every slot of its lattice.
                unsafe {
                    let v = lattice::gather::<S>(&field.features[l].values, FEATURES, 0, &corners, &corners.weights());
                    S::q_store(x.as_mut_ptr().add(l * FEATURES), v);
                }
            }
        }
        b.x1[n * INPUT..padded * INPUT].fill(0.0);
        let w = &field.net.values;
        let (x1, h1) = (&b.x1[from * INPUT..], &mut b.h1[from * HIDDEN..]);
        matmul::product::<S, INPUT, HIDDEN>(x1, &w[LAYER[0]..], h1, rows, true);
        matmul::product::<S, HIDDEN, MIDDLE>(h1, &w[LAYER[1]..], &mut b.middle[from * MIDDLE..], rows, false);
        if !colors {
            return;
        }
        for s in from..n {
            let x = &mut b.x3[s * COLOR_INPUT..(s + 1) * COLOR_INPUT];
            x[..MIDDLE].copy_from_slice(&b.middle[s * MIDDLE..(s + 1) * MIDDLE]);
            x[0] = 1.0;
            x[MIDDLE..].copy_from_slice(&b.directions[b.ray[s] as usize]);
        }
        b.x3[n * COLOR_INPUT..padded * COLOR_INPUT].fill(0.0);
        let (x3, h3) = (&b.x3[from * COLOR_INPUT..], &mut b.h3[from * HIDDEN..]);
        matmul::product::<S, COLOR_INPUT, HIDDEN>(x3, &w[LAYER[2]..], h3, rows, true);
        matmul::product::<S, HIDDEN, OUTPUT>(h3, &w[LAYER[3]..], &mut b.out[from * OUTPUT..], rows, false);
    }
}

struct Backward<'a, 'g> {
    samples: &'a mut Samples,
    field: &'a Field,
    transposed: &'a Transposed,
    deformation: Option<&'a Deformation<'a>>,
    grad: &'a mut FieldGrad,
    deformation_grad: Option<&'a mut DeformationGrad<'g>>,
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
        for k in 0..n {
            let s = b.kept[k] as usize;
            let d = &b.d_x1[k * 32..(k + 1) * 32];
            let in_region = b.in_region[s];
            let wants_motion = in_region || deformation_grad.as_ref().is_some_and(|g| g.moves);
            let p = b.warped[s];
            let mut d_point = [0.0f32; 4];
            for l in 0..field.live {
                let level = &field.levels[l];
                let corners = level.corners(p);
                let weights = corners.weights();
                // SAFETY: the gradients have the shape of their table.
                unsafe {
                    let dv = S::q_load(d.as_ptr().add(l * FEATURES));
                    lattice::scatter::<S>(&mut grad.features[l].values, FEATURES, 0, &corners, &weights, dv);
                    let touched = &mut grad.features[l].touched;
                    for &i in &corners.index {
                        *touched.get_unchecked_mut(i as usize / lattice::BRICK) = true;
                    }
                    if wants_motion {
                        let e = lattice::dots::<S>(&field.features[l].values, FEATURES, 0, &corners, dv);
                        let (slope, steps) = (corners.slope(&e), level.steps_per_unit());
                        for a in 0..3 {
                            d_point[a] += slope[a] * steps[a];
                        }
                    }
                }
            }
            let (Some(deformation), Some(g)) = (deformation, deformation_grad.as_deref_mut()) else { continue };
            let at = b.point[s];
            if in_region {
                let corners = deformation.lattice.corners(at);
                let w = corners.weights();
                // SAFETY: as above.
                unsafe {
                    let feature = S::q_load(d.as_ptr().add(EXPRESSION_AT));
                    lattice::scatter::<S>(g.blend, CHANNELS, 0, &corners, &w, feature);
                    let shift = [d_point[0], d_point[1], d_point[2], d[EXPRESSION_AT + 4]];
                    lattice::scatter::<S>(g.blend, CHANNELS, 4, &corners, &w, S::q_load(shift.as_ptr()));
                }
            }
            if g.moves {
                if let Some((lattice, _)) = deformation.latent {
                    let corners = lattice.corners(at);
                    // SAFETY: as above.
                    unsafe {
                        lattice::scatter::<S>(
                            g.latent,
                            4,
                            0,
                            &corners,
                            &corners.weights(),
                            S::q_load(d_point.as_ptr()),
                        );
                    }
                }
                let [x, y, z] = at;
                let [gx, gy, gz, _] = d_point;
                for (sum, v) in g.motion.iter_mut().zip([y * gz - z * gy, z * gx - x * gz, x * gy - y * gx, gx, gy, gz])
                {
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
