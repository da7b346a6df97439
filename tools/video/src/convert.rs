//! Planes to RGB of 8 bits, rounded to the nearest level; the usual coding, 8-bit SDR, goes through `fast`.
//!
//! A row is made in single precision: the two nearest chroma rows are mixed and multiplied by the matrix at chroma
//! resolution, the three results interpolated across, the luma added. Chroma is interpolated linearly from where its
//! samples lie. Equations: ITU-T H.273, 8.3; [`Factors`] holds their numbers.
#![allow(clippy::inline_always, reason = "the vectorised build of a caller has to take in all that it calls")]

use std::marker::PhantomData;

use image::RgbImage;
use pulp::NullaryFnOnce;

use crate::coding::{Coding, Factors, Siting, Transfer};
use crate::fast;
use crate::hdr::ToneMap;
use crate::pixels::{Family, Plane, Planes, Reason};

/// Stored samples of one or two bytes.
trait Sample {
    const BYTES: usize;
    fn read(bytes: &[u8]) -> f32;
}

struct One;

impl Sample for One {
    const BYTES: usize = 1;
    #[inline(always)]
    fn read(bytes: &[u8]) -> f32 {
        f32::from(bytes[0])
    }
}

struct Two;

impl Sample for Two {
    const BYTES: usize = 2;
    #[inline(always)]
    fn read(bytes: &[u8]) -> f32 {
        f32::from(u16::from_le_bytes([bytes[0], bytes[1]]))
    }
}

/// Turns pictures into RGB; its buffers are kept between them.
#[derive(Debug)]
pub(crate) struct Converter {
    arch: pulp::Arch,
    buffers: Buffers,
    /// For HDR, and the coding that it is for.
    tone_map: Option<(Coding, ToneMap)>,
}

/// Rows of one picture's width.
#[derive(Debug, Default)]
struct Buffers {
    /// The two chroma planes between their rows.
    mixed: [Vec<f32>; 2],
    /// Chroma times matrix at chroma resolution: red, green, blue.
    narrow: [Vec<f32>; 3],
    /// The same at full resolution.
    wide: [Vec<f32>; 3],
    fast: fast::Buffers,
}

impl Default for Converter {
    fn default() -> Self {
        Self { arch: pulp::Arch::new(), buffers: Buffers::default(), tone_map: None }
    }
}

impl Converter {
    pub(crate) fn run(&mut self, planes: &Planes<'_>, coding: Coding) -> Result<RgbImage, Reason> {
        let (width, height) = (planes.width, planes.height);
        let mut out = vec![0; 3 * width * height];
        if coding.transfer != Transfer::Sdr && self.tone_map.as_ref().is_none_or(|(of, _)| *of != coding) {
            self.tone_map = Some((coding, ToneMap::new(coding.transfer, coding.wide_gamut)));
        }
        let tone_map = self.tone_map.as_ref().filter(|_| coding.transfer != Transfer::Sdr).map(|(_, map)| map);
        let job = Job { planes, coding, tone_map, buffers: &mut self.buffers, out: &mut out };
        if planes.layout.depth > 8 {
            self.arch.dispatch(Run::<Two>(job, PhantomData));
        } else {
            self.arch.dispatch(Run::<One>(job, PhantomData));
        }
        RgbImage::from_raw(width as u32, height as u32, out).ok_or_else(|| "the picture has a wrong size".to_owned())
    }
}

struct Job<'a> {
    planes: &'a Planes<'a>,
    coding: Coding,
    tone_map: Option<&'a ToneMap>,
    buffers: &'a mut Buffers,
    out: &'a mut [u8],
}

/// A job as what is compiled once for every set of the processor's instructions; all that it calls is inlined into it.
struct Run<'a, S>(Job<'a>, PhantomData<S>);

impl<S: Sample> NullaryFnOnce for Run<'_, S> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        match (self.0.planes.layout.family, self.0.tone_map) {
            (Family::Rgb, _) => self.0.convert_rgb::<S>(),
            (Family::Grey, None) => self.0.convert_grey::<S>(&Sdr),
            (Family::Grey, Some(map)) => self.0.convert_grey::<S>(&Hdr(map)),
            (Family::Yuv { .. }, None) if S::BYTES == 1 && self.0.planes.layout.log2_across <= 1 => {
                fast::run(self.0.planes, self.0.coding, &mut self.0.buffers.fast, self.0.out);
            }
            (Family::Yuv { .. }, None) => self.0.convert_yuv::<S>(&Sdr),
            (Family::Yuv { .. }, Some(map)) => self.0.convert_yuv::<S>(&Hdr(map)),
        }
    }
}

/// What becomes of an RGB signal of 0 to 255.
trait Emit {
    fn pixel(&self, rgb: [f32; 3]) -> [u8; 3];
}

struct Sdr;

impl Emit for Sdr {
    #[inline(always)]
    fn pixel(&self, rgb: [f32; 3]) -> [u8; 3] {
        [to_level(rgb[0]), to_level(rgb[1]), to_level(rgb[2])]
    }
}

struct Hdr<'a>(&'a ToneMap);

impl Emit for Hdr<'_> {
    #[inline(always)]
    fn pixel(&self, rgb: [f32; 3]) -> [u8; 3] {
        self.0.pixel(rgb)
    }
}

/// Rounds to the nearest level. Adding 2²³ leaves the integer in the lowest bits, which vectorises where a cast does not.
#[inline(always)]
fn to_level(value: f32) -> u8 {
    let value = if value > 0.0 { value } else { 0.0 };
    let value = if value < 255.0 { value } else { 255.0 };
    (value + 8_388_608.0).to_bits() as u8
}

/// The two rows that `y` lies between and the share of the second.
pub(crate) fn between(y: usize, log2: u32, siting: Siting, count: usize) -> (usize, usize, f32) {
    let size = 1usize << log2;
    // In 2·size-ths of a chroma row, so that the middle of `size` luma rows is a whole number.
    let place = match siting {
        Siting::Cosited => 2 * y,
        Siting::Centred => (2 * y + 1).saturating_sub(size),
    };
    let first = (place / (2 * size)).min(count - 1);
    let share = (place % (2 * size)) as f32 / (2 * size) as f32;
    (first, (first + 1).min(count - 1), share)
}

impl Job<'_> {
    #[inline(always)]
    fn convert_yuv<S: Sample>(self, emit: &impl Emit) {
        let Planes { width, height, layout, planes } = self.planes;
        let factors = Factors::new(self.coding.matrix, self.coding.full_range, layout.depth);
        let columns = width.div_ceil(1 << layout.log2_across);
        let rows = height.div_ceil(1 << layout.log2_down);
        let Buffers { mixed, narrow, wide, .. } = self.buffers;
        for narrow in mixed.iter_mut().chain(narrow.iter_mut()) {
            narrow.resize(columns, 0.0);
        }
        for wide in wide.iter_mut() {
            wide.resize(*width, 0.0);
        }
        for (y, out) in self.out.chunks_exact_mut(3 * width).enumerate() {
            let (first, second, share) = between(y, layout.log2_down, self.coding.down, rows);
            for (mixed, &plane) in mixed.iter_mut().zip(&planes[1..3]) {
                mix::<S>(row::<S>(plane, first, columns), row::<S>(plane, second, columns), share, mixed);
            }
            for c in 0..3 {
                multiply(&mixed[0], &mixed[1], [factors.u[c], factors.v[c], factors.offset[c]], &mut narrow[c]);
                if layout.log2_across > 0 {
                    widen(&narrow[c], &mut wide[c], layout.log2_across, self.coding.across);
                }
            }
            let chroma: &[Vec<f32>; 3] = if layout.log2_across > 0 { wide } else { narrow };
            let luma = row::<S>(planes[0], y, *width);
            add::<S>(luma, factors.luma, &chroma[0], &chroma[1], &chroma[2], emit, out);
        }
    }

    #[inline(always)]
    fn convert_grey<S: Sample>(self, emit: &impl Emit) {
        let width = self.planes.width;
        let factors = Factors::new(self.coding.matrix, self.coding.full_range, self.planes.layout.depth);
        // Without the middle of chroma.
        let middle = (1u32 << (self.planes.layout.depth - 1)) as f32;
        let offset = factors.offset[0] + middle * (factors.u[0] + factors.v[0]);
        for (y, out) in self.out.chunks_exact_mut(3 * width).enumerate() {
            let stored = row::<S>(self.planes.planes[0], y, width).chunks_exact(S::BYTES);
            for (pixel, stored) in out.chunks_exact_mut(3).zip(stored) {
                pixel.copy_from_slice(&emit.pixel([S::read(stored) * factors.luma + offset; 3]));
            }
        }
    }

    #[inline(always)]
    fn convert_rgb<S: Sample>(self) {
        let width = self.planes.width;
        let scale = 255.0 / ((1u32 << self.planes.layout.depth) - 1) as f32;
        for (y, out) in self.out.chunks_exact_mut(3 * width).enumerate() {
            for (channel, &plane) in self.planes.planes.iter().enumerate() {
                let stored = row::<S>(plane, y, width).chunks_exact(S::BYTES);
                for (pixel, stored) in out.chunks_exact_mut(3).zip(stored) {
                    pixel[channel] = to_level(S::read(stored) * scale);
                }
            }
        }
    }
}

#[inline(always)]
fn row<S: Sample>(plane: Plane<'_>, y: usize, count: usize) -> &[u8] {
    &plane.data[y * plane.stride..][..count * S::BYTES]
}

// Each loop has few slices, all of them parameters: then the compiler knows that they do not overlap, and vectorises.

#[inline(always)]
fn mix<S: Sample>(first: &[u8], second: &[u8], share: f32, out: &mut [f32]) {
    let pairs = first.chunks_exact(S::BYTES).zip(second.chunks_exact(S::BYTES));
    for (out, (a, b)) in out.iter_mut().zip(pairs) {
        let (a, b) = (S::read(a), S::read(b));
        *out = a + (b - a) * share;
    }
}

#[inline(always)]
fn multiply(u: &[f32], v: &[f32], [of_u, of_v, offset]: [f32; 3], out: &mut [f32]) {
    for (out, (u, v)) in out.iter_mut().zip(u.iter().zip(v)) {
        *out = of_u * u + of_v * v + offset;
    }
}

/// Interpolates a row across.
#[inline(always)]
fn widen(narrow: &[f32], wide: &mut [f32], log2: u32, siting: Siting) {
    let Some(&last) = narrow.last() else { return };
    if log2 == 1 && siting == Siting::Cosited {
        let pairs = narrow.iter().zip(&narrow[1..]);
        for (out, (a, b)) in wide.chunks_exact_mut(2).zip(pairs) {
            out[0] = *a;
            out[1] = 0.5 * (a + b);
        }
        wide[2 * (narrow.len() - 1)..].fill(last);
        return;
    }
    for (x, out) in wide.iter_mut().enumerate() {
        let (first, second, share) = between(x, log2, siting, narrow.len());
        *out = narrow[first] + (narrow[second] - narrow[first]) * share;
    }
}

#[inline(always)]
fn add<S: Sample>(luma: &[u8], scale: f32, red: &[f32], green: &[f32], blue: &[f32], emit: &impl Emit, out: &mut [u8]) {
    let chroma = red.iter().zip(green).zip(blue);
    let stored = luma.chunks_exact(S::BYTES);
    for ((pixel, stored), ((red, green), blue)) in out.chunks_exact_mut(3).zip(stored).zip(chroma) {
        let value = S::read(stored) * scale;
        let rgb = emit.pixel([value + red, value + green, value + blue]);
        pixel[0] = rgb[0];
        pixel[1] = rgb[1];
        pixel[2] = rgb[2];
    }
}

#[cfg(test)]
mod tests {
    use ffmpeg::format::Pixel;
    use ffmpeg::frame;

    use super::*;
    use crate::coding::Matrix;
    use crate::pixels::with_planes;

    /// A picture of noise; the same in 10 bits, where every number is four times as large.
    fn noise(width: u32, height: u32, format: Pixel, ten_bits: bool) -> frame::Video {
        let mut picture = frame::Video::new(format, width, height);
        let mut state = 1u32;
        for plane in 0..3 {
            let (stride, columns) = (picture.stride(plane), picture.plane_width(plane) as usize);
            for row in picture.data_mut(plane).chunks_mut(stride) {
                for x in 0..columns {
                    state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    let value = (state >> 24) as u8;
                    if ten_bits {
                        row[2 * x..2 * x + 2].copy_from_slice(&(u16::from(value) << 2).to_le_bytes());
                    } else {
                        row[x] = value;
                    }
                }
            }
        }
        picture
    }

    #[test]
    fn integers_and_floats_agree() {
        let pairs = [
            (Pixel::YUV420P, Pixel::YUV420P10LE),
            (Pixel::YUV422P, Pixel::YUV422P10LE),
            (Pixel::YUV444P, Pixel::YUV444P10LE),
        ];
        for (eight, ten) in pairs {
            for (matrix, across) in [
                (Matrix::Bt601, Siting::Cosited),
                (Matrix::Bt709, Siting::Centred),
                (Matrix::Bt2020, Siting::Cosited),
                (Matrix::YCgCo, Siting::Centred),
            ] {
                for (width, height) in [(35, 17), (64, 2), (1, 1), (2, 3)] {
                    let coding = Coding {
                        matrix,
                        full_range: false,
                        transfer: Transfer::Sdr,
                        wide_gamut: false,
                        across,
                        down: Siting::Centred,
                        guessed: false,
                    };
                    let [a, b] = [(eight, false), (ten, true)].map(|(format, ten_bits)| {
                        let picture = noise(width, height, format, ten_bits);
                        with_planes(&picture, |p| Converter::default().run(p, coding)).unwrap()
                    });
                    let differences = a.as_raw().iter().zip(b.as_raw()).map(|(a, b)| a.abs_diff(*b));
                    let (most, sum) = differences.fold((0, 0u32), |(m, s), d| (m.max(d), s + u32::from(d)));
                    assert!(most <= 1, "{eight:?} {matrix:?} {across:?} {width}×{height}: {most}");
                    let mean = f64::from(sum) / a.as_raw().len() as f64;
                    assert!(width < 35 || mean < 0.1, "{eight:?} {matrix:?}: {mean}");
                }
            }
        }
    }

    #[test]
    fn grey_and_rgb_keep_their_levels() {
        let mut grey = frame::Video::new(Pixel::GRAY8, 4, 2);
        let stride = grey.stride(0);
        grey.data_mut(0)[stride..stride + 4].copy_from_slice(&[0, 16, 128, 255]);
        let coding = Coding::of(&grey, Family::Grey);
        let picture = with_planes(&grey, |p| Converter::default().run(p, coding)).unwrap();
        assert_eq!(picture.as_raw()[12..], [0, 0, 0, 16, 16, 16, 128, 128, 128, 255, 255, 255]);
        let mut rgb = frame::Video::new(Pixel::RGB24, 2, 1);
        rgb.data_mut(0)[..6].copy_from_slice(&[200, 60, 40, 1, 2, 3]);
        let coding = Coding::of(&rgb, crate::pixels::family(Pixel::RGB24));
        let picture = with_planes(&rgb, |p| Converter::default().run(p, coding)).unwrap();
        assert_eq!(picture.as_raw()[..], [200, 60, 40, 1, 2, 3]);
    }
}
