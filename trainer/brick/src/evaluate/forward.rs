//! The way there.
#![allow(unsafe_code, reason = "gathers: corners come from the lattices their tables were made for")]

use super::{Deformation, Samples, room, split};
use crate::expression::{CHANNELS, MASKS, reach};
use crate::field::{COLOR_INPUT, EXPRESSION_AT, FEATURES, Field, HIDDEN, INPUT, LAYER, LEVELS, MIDDLE, ONE_AT, OUTPUT};
use crate::lattice;
use crate::matmul;
use crate::simd::{Simd, Task};
use crate::sixteen::{Each, POINTS, Sixteen};

pub(super) struct Forward<'a> {
    pub(super) samples: &'a mut Samples,
    pub(super) field: &'a Field,
    pub(super) deformation: Option<&'a Deformation<'a>>,
    pub(super) from: usize,
}

impl Task for Forward<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        let Self { samples: b, field, deformation, from } = self;
        let n = b.len();
        // Rows from `from` on, in whole blocks; rows beyond `n` are scratch.
        let rows = (n - from).next_multiple_of(16);
        let padded = from + rows;
        for (v, width) in [(&mut b.x1, INPUT), (&mut b.h1, HIDDEN), (&mut b.middle, MIDDLE)] {
            room(v, padded * width);
        }
        b.warped.resize(n, [0.0; 3]);
        b.in_region.resize(n, false);
        b.acts.resize(n, 0);
        b.masks.resize(n, [0.0; MASKS]);
        let (mut corners, mut levels) = (Sixteen::default(), [Sixteen::default(); LEVELS]);
        for first in (from..n).step_by(POINTS) {
            let count = (n - first).min(POINTS);
            let mut points = split(b.point[first..first + count].iter().copied());
            for s in first..first + count {
                let x = &mut b.x1[s * INPUT..(s + 1) * INPUT];
                x[EXPRESSION_AT..].fill(0.0);
                x[ONE_AT] = 1.0;
                b.in_region[s] = false;
                b.acts[s] = 0;
                b.masks[s] = [0.0; MASKS];
            }
            if let Some(d) = deformation {
                deform::<S>(b, d, first, count, &mut points, &mut corners);
            }
            for s in 0..count {
                b.warped[first + s] = [points[0][s], points[1][s], points[2][s]];
            }
            // All levels' corners first, so that what is far away is on its way when it is asked for.
            for l in 0..field.live {
                field.levels[l].sixteen::<S>(&points, &mut levels[l]);
                for s in 0..count {
                    lattice::prefetch::<S>(&field.features[l].values, FEATURES, &levels[l].corners(s).index);
                }
            }
            for l in 0..LEVELS {
                for s in 0..count {
                    let x = &mut b.x1[(first + s) * INPUT + l * FEATURES..][..FEATURES];
                    if l >= field.live {
                        x.fill(0.0);
                        continue;
                    }
                    // SAFETY: the table has a row for every slot of its lattice.
                    unsafe {
                        let (values, c) = (&field.features[l].values, levels[l].corners(s));
                        let v = lattice::gather::<S>(values, FEATURES, 0, &c, &levels[l].weights(s));
                        S::q_store(x.as_mut_ptr(), v);
                    }
                }
            }
        }
        b.x1[n * INPUT..padded * INPUT].fill(0.0);
        let w = &field.net.values;
        let (x1, h1) = (&b.x1[from * INPUT..], &mut b.h1[from * HIDDEN..]);
        matmul::product::<S, INPUT, HIDDEN>(x1, &w[LAYER[0]..], h1, rows, true);
        matmul::product::<S, HIDDEN, MIDDLE>(h1, &w[LAYER[1]..], &mut b.middle[from * MIDDLE..], rows, false);
    }
}

/// Whose colours.
pub(super) enum Which<'a> {
    /// All samples from one on.
    From(usize),
    /// These.
    Some(&'a [u32]),
}

/// The colour part of the network.
pub(super) struct Colors<'a> {
    pub(super) samples: &'a mut Samples,
    pub(super) field: &'a Field,
    pub(super) which: Which<'a>,
}

impl Task for Colors<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        let Self { samples: b, field, which } = self;
        // Rows where the inputs begin, how many, and where the colours go: some samples are worked out one after the other
        // behind the last, for no way back needs their rows.
        let n = b.len();
        let (from, count) = match which {
            Which::From(from) => (from, n - from),
            Which::Some(some) => (n, some.len()),
        };
        let rows = count.next_multiple_of(16);
        let padded = from + rows;
        for (v, width) in [(&mut b.x3, COLOR_INPUT), (&mut b.h3, HIDDEN), (&mut b.out, OUTPUT)] {
            room(v, padded * width);
        }
        for k in 0..count {
            let s = match which {
                Which::From(from) => from + k,
                Which::Some(some) => some[k] as usize,
            };
            let x = &mut b.x3[(from + k) * COLOR_INPUT..(from + k + 1) * COLOR_INPUT];
            x[..MIDDLE].copy_from_slice(&b.middle[s * MIDDLE..(s + 1) * MIDDLE]);
            x[0] = 1.0;
            x[MIDDLE..].copy_from_slice(&b.directions[b.ray[s] as usize]);
        }
        b.x3[(from + count) * COLOR_INPUT..padded * COLOR_INPUT].fill(0.0);
        let w = &field.net.values;
        let (x3, h3) = (&b.x3[from * COLOR_INPUT..], &mut b.h3[from * HIDDEN..]);
        matmul::product::<S, COLOR_INPUT, HIDDEN>(x3, &w[LAYER[2]..], h3, rows, true);
        matmul::product::<S, HIDDEN, OUTPUT>(h3, &w[LAYER[3]..], &mut b.out[from * OUTPUT..], rows, false);
        if let Which::Some(some) = which {
            for (k, &s) in some.iter().enumerate() {
                b.out.copy_within((n + k) * OUTPUT..(n + k) * OUTPUT + 3, s as usize * OUTPUT);
            }
        }
    }
}

/// Moves the points where the expression has them; features and masks of the samples from `first` on.
#[inline(always)]
fn deform<S: Simd>(
    b: &mut Samples,
    d: &Deformation<'_>,
    first: usize,
    count: usize,
    points: &mut [Each<f32>; 3],
    corners: &mut Sixteen,
) {
    let here = *points;
    d.lattice.sixteen::<S>(&here, corners);
    let inside = corners.inside();
    for s in (0..count).filter(|&s| inside[s]) {
        let x = &mut b.x1[(first + s) * INPUT..(first + s + 1) * INPUT];
        let (c, w) = (corners.corners(s), corners.weights(s));
        let mut shift = [0.0; 4];
        b.in_region[first + s] = true;
        // SAFETY: the blend and the gates have a row for every slot of the lattice.
        unsafe {
            let features = lattice::gather::<S>(d.blend, CHANNELS, 0, &c, &w);
            S::q_store(x.as_mut_ptr().add(EXPRESSION_AT), features);
            S::q_store(shift.as_mut_ptr(), lattice::gather::<S>(d.blend, CHANNELS, 4, &c, &w));
            S::q_store(b.masks[first + s].as_mut_ptr(), lattice::gather::<S>(d.gates, MASKS, 0, &c, &w));
        }
        if b.tells_acts {
            let mut most = [0.0f32; MASKS];
            // SAFETY: as above.
            unsafe { S::q_store(most.as_mut_ptr(), lattice::largest::<S>(d.gates, &c)) };
            let mut bits = 0;
            for (n, &most) in most.iter().enumerate() {
                bits |= u8::from(reach(most) > 0.0) << n;
            }
            b.acts[first + s] = bits;
        }
        x[EXPRESSION_AT + 4] = shift[3];
        for a in 0..3 {
            points[a][s] += shift[a];
        }
    }
    if let Some((lattice, values)) = d.latent {
        lattice.sixteen::<S>(&here, corners);
        for s in 0..count {
            let mut own = [0.0; 4];
            // SAFETY: the displacement has a row for every slot of its lattice.
            unsafe {
                let v = lattice::gather::<S>(values, 4, 0, &corners.corners(s), &corners.weights(s));
                S::q_store(own.as_mut_ptr(), v);
            }
            for a in 0..3 {
                points[a][s] += own[a];
            }
        }
    }
}
