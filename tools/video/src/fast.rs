//! The conversion of `convert` in 16-bit integers, for 8-bit YUV: most videos are that, and it is what decoding costs beside
//! the decoder.
//!
//! Signals have 5 binary places. Against the exact result a channel differs by one level at
//! most, where that lies within 0.1 of the middle between two levels.
#![allow(clippy::inline_always, reason = "the vectorised build of a caller has to take in all that it calls")]

use crate::coding::{Coding, Factors, Siting};
use crate::convert::between;
use crate::pixels::{Plane, Planes};

/// Binary places of a signal.
const PLACES: u32 = 5;

/// Rows of one picture's width.
#[derive(Debug, Default)]
pub(crate) struct Buffers {
    /// The two chroma planes between their rows, 2⁸ units a level, from their middle.
    mixed: [Vec<i16>; 2],
    /// Chroma times matrix at chroma resolution: red, green, blue.
    narrow: [Vec<i16>; 3],
    /// The same at full resolution.
    wide: [Vec<i16>; 3],
}

// Nothing here can overflow: signals are below 2¹⁵ whatever the picture holds. The operations that would check it keep
// loops from being vectorised.

/// The upper half of a product, which processors have an instruction for; rounded down.
#[inline(always)]
fn upper(a: i16, b: i16) -> i16 {
    (i32::from(a).wrapping_mul(i32::from(b)) >> 16) as i16
}

#[inline(always)]
pub(crate) fn run(planes: &Planes<'_>, coding: Coding, buffers: &mut Buffers, out: &mut [u8]) {
    let Planes { width, height, layout, planes } = planes;
    let factors = Factors::new(coding.matrix, coding.full_range, 8);
    // The upper half of 2⁷ times a stored luma times this has 5 places, as has that of 2⁶ times a mixed chroma.
    let luma_factor = (factors.luma * 16384.0).round() as i16;
    let chroma_factor = |f: f32| (f * 8192.0).round() as i16;
    let (of_u, of_v) = (factors.u.map(chroma_factor), factors.v.map(chroma_factor));
    // The black level, a half for rounding, and what three products lose by being rounded down.
    let black = if coding.full_range { 0.0 } else { -16.0 * factors.luma };
    let offset = ((black + 0.5) * 32.0 + 1.5).round() as i16;
    let columns = width.div_ceil(1 << layout.log2_across);
    let rows = height.div_ceil(1 << layout.log2_down);
    let Buffers { mixed, narrow, wide } = buffers;
    for narrow in mixed.iter_mut().chain(narrow.iter_mut()) {
        narrow.resize(columns, 0);
    }
    for wide in wide.iter_mut() {
        wide.resize(*width, 0);
    }
    for (y, out) in out.chunks_exact_mut(3 * width).enumerate() {
        let (first, second, share) = between(y, layout.log2_down, coding.down, rows);
        let share = (4.0 * share) as i16;
        for (mixed, &plane) in mixed.iter_mut().zip(&planes[1..3]) {
            mix(row(plane, first, columns), row(plane, second, columns), share, mixed);
        }
        for c in 0..3 {
            multiply(&mixed[0], &mixed[1], of_u[c], of_v[c], offset, &mut narrow[c]);
            if layout.log2_across == 1 {
                widen(&narrow[c], &mut wide[c], coding.across);
            }
        }
        let chroma: &[Vec<i16>; 3] = if layout.log2_across == 1 { wide } else { narrow };
        add(row(planes[0], y, *width), luma_factor, &chroma[0], &chroma[1], &chroma[2], out);
    }
}

#[inline(always)]
fn row(plane: Plane<'_>, y: usize, count: usize) -> &[u8] {
    &plane.data[y * plane.stride..][..count]
}

#[inline(always)]
fn mix(first: &[u8], second: &[u8], share: i16, out: &mut [i16]) {
    let own = 4 - share;
    for (out, (a, b)) in out.iter_mut().zip(first.iter().zip(second)) {
        let sum = own.wrapping_mul(i16::from(*a)).wrapping_add(share.wrapping_mul(i16::from(*b)));
        *out = sum.wrapping_sub(512) << 6;
    }
}

#[inline(always)]
fn multiply(u: &[i16], v: &[i16], of_u: i16, of_v: i16, offset: i16, out: &mut [i16]) {
    for (out, (u, v)) in out.iter_mut().zip(u.iter().zip(v)) {
        *out = upper(*u, of_u).wrapping_add(upper(*v, of_v)).wrapping_add(offset);
    }
}

#[inline(always)]
fn mean(a: i16, b: i16) -> i16 {
    a.wrapping_add(b).wrapping_add(1) >> 1
}

/// Interpolates a row across.
#[inline(always)]
fn widen(narrow: &[i16], wide: &mut [i16], siting: Siting) {
    let (Some(&first), Some(&last)) = (narrow.first(), narrow.last()) else { return };
    match siting {
        Siting::Cosited => {
            for (out, (a, b)) in wide.chunks_exact_mut(2).zip(narrow.iter().zip(&narrow[1..])) {
                out[0] = *a;
                out[1] = mean(*a, *b);
            }
            wide[2 * (narrow.len() - 1)..].fill(last);
        }
        Siting::Centred => {
            wide[0] = first;
            // In halves first: three times a signal does not fit.
            for (out, (a, b)) in wide[1..].chunks_exact_mut(2).zip(narrow.iter().zip(&narrow[1..])) {
                let half = mean(*a, *b);
                out[0] = mean(*a, half);
                out[1] = mean(*b, half);
            }
            let done = 2 * narrow.len() - 1;
            if let Some(rest) = wide.get_mut(done..) {
                rest.fill(last);
            }
        }
    }
}

#[inline(always)]
fn add(luma: &[u8], factor: i16, red: &[i16], green: &[i16], blue: &[i16], out: &mut [u8]) {
    let chroma = red.iter().zip(green).zip(blue);
    for ((pixel, stored), ((red, green), blue)) in out.chunks_exact_mut(3).zip(luma).zip(chroma) {
        let value = upper(i16::from(*stored) << 7, factor);
        pixel[0] = level(value.wrapping_add(*red));
        pixel[1] = level(value.wrapping_add(*green));
        pixel[2] = level(value.wrapping_add(*blue));
    }
}

#[inline(always)]
fn level(signal: i16) -> u8 {
    (signal >> PLACES).clamp(0, 255) as u8
}
