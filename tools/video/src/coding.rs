//! How the pictures of a stream are coded: matrix, range, transfer curve and position of the chroma samples.
//!
//! Tags that are there are believed. Where a stream does not say its matrix, the rule is mpv's: pictures at least 1280
//! wide or more than 576 high are BT.709, smaller ones BT.601; BT.2020 primaries mean the BT.2020 matrix. Where it does
//! not say its range, YUV is limited, grey and RGB are full. Numbers: ITU-T H.273, tables 2 to 4.

use ffmpeg::color::{Primaries, Range, Space, TransferCharacteristic};
use ffmpeg::frame;
use ffmpeg::util::chroma::Location;

use crate::pixels::Family;

/// From luma and chroma to RGB.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Matrix {
    Bt601,
    Bt709,
    Bt2020,
    Smpte240m,
    Fcc,
    YCgCo,
}

/// From signal to light.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Transfer {
    /// Shown as it is.
    Sdr,
    /// Hybrid log-gamma, ARIB STD-B67.
    Hlg,
    /// Perceptual quantiser, SMPTE ST 2084.
    Pq,
}

/// Where a chroma sample lies among the luma samples that share it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Siting {
    /// On the first of them.
    Cosited,
    /// In their middle.
    Centred,
}

/// How the pictures of a stream are coded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Coding {
    pub(crate) matrix: Matrix,
    pub(crate) full_range: bool,
    pub(crate) transfer: Transfer,
    /// Whether the primaries are BT.2020's.
    pub(crate) wide_gamut: bool,
    pub(crate) across: Siting,
    pub(crate) down: Siting,
    /// Whether the matrix is a guess by the size.
    pub(crate) guessed: bool,
}

impl Coding {
    pub(crate) fn of(frame: &frame::Video, family: Family) -> Self {
        let wide_gamut = frame.color_primaries() == Primaries::BT2020;
        let tagged = match (family, frame.color_space()) {
            // Without chroma there is nothing to multiply.
            (Family::Rgb | Family::Grey, _) | (_, Space::BT709) => Some(Matrix::Bt709),
            (_, Space::FCC) => Some(Matrix::Fcc),
            (_, Space::BT470BG | Space::SMPTE170M) => Some(Matrix::Bt601),
            (_, Space::SMPTE240M) => Some(Matrix::Smpte240m),
            (_, Space::YCGCO) => Some(Matrix::YCgCo),
            (_, Space::BT2020NCL | Space::BT2020CL) => Some(Matrix::Bt2020),
            _ => None,
        };
        let full_range = match (family, frame.color_range()) {
            (Family::Rgb, _) | (_, Range::JPEG) | (Family::Grey, Range::Unspecified) => true,
            (Family::Yuv { always_full }, Range::Unspecified) => always_full,
            (_, Range::MPEG) => false,
        };
        let transfer = match frame.color_transfer_characteristic() {
            TransferCharacteristic::SMPTE2084 => Transfer::Pq,
            TransferCharacteristic::ARIB_STD_B67 => Transfer::Hlg,
            _ => Transfer::Sdr,
        };
        let (across, down) = match frame.chroma_location() {
            Location::Center => (Siting::Centred, Siting::Centred),
            Location::TopLeft => (Siting::Cosited, Siting::Cosited),
            Location::Top => (Siting::Centred, Siting::Cosited),
            _ => (Siting::Cosited, Siting::Centred),
        };
        let matrix = tagged.unwrap_or_else(|| {
            if wide_gamut || transfer != Transfer::Sdr { Matrix::Bt2020 } else { guess(frame.width(), frame.height()) }
        });
        Self { matrix, full_range, transfer, wide_gamut, across, down, guessed: tagged.is_none() }
    }
}

/// The matrix of a stream that does not say it, by its size as stored.
pub(crate) fn guess(width: u32, height: u32) -> Matrix {
    if width >= 1280 || height > 576 { Matrix::Bt709 } else { Matrix::Bt601 }
}

/// RGB of 0 to 255 as `scale`·luma + `u`·(Cb − middle) + `v`·(Cr − middle) + `offset`, for stored numbers; the offsets hold
/// the middle and the black level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Factors {
    pub(crate) luma: f32,
    pub(crate) u: [f32; 3],
    pub(crate) v: [f32; 3],
    pub(crate) offset: [f32; 3],
}

impl Factors {
    pub(crate) fn new(matrix: Matrix, full_range: bool, depth: u32) -> Self {
        // Weights of red and blue in luma.
        let weights = match matrix {
            Matrix::Bt601 => Some((0.299, 0.114)),
            Matrix::Bt709 => Some((0.2126, 0.0722)),
            Matrix::Bt2020 => Some((0.2627, 0.0593)),
            Matrix::Smpte240m => Some((0.212, 0.087)),
            Matrix::Fcc => Some((0.30, 0.11)),
            Matrix::YCgCo => None,
        };
        // The first chroma plane is Cb (Cg), the second Cr (Co); each spans −0.5 to 0.5.
        let (u, v) = match weights {
            Some((red, blue)) => {
                let green = 1.0 - red - blue;
                let (from_blue, from_red) = (2.0 * (1.0 - blue), 2.0 * (1.0 - red));
                ([0.0, -from_blue * blue / green, from_blue], [from_red, -from_red * red / green, 0.0])
            }
            None => ([-1.0, 1.0, -1.0], [1.0, 0.0, -1.0]),
        };
        let unit = f64::from(1u32 << (depth - 8));
        let top = f64::from((1u32 << depth) - 1);
        let (black, luma_span, chroma_span) =
            if full_range { (0.0, top, top) } else { (16.0 * unit, 219.0 * unit, 224.0 * unit) };
        let middle = 128.0 * unit;
        let luma = 255.0 / luma_span;
        let scaled = |row: [f64; 3]| row.map(|c| c * 255.0 / chroma_span);
        let (u, v) = (scaled(u), scaled(v));
        let offset = [0, 1, 2].map(|c| (-black * luma - middle * (u[c] + v[c])) as f32);
        Self { luma: luma as f32, u: u.map(|c| c as f32), v: v.map(|c| c as f32), offset }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rgb(matrix: Matrix, full: bool, depth: u32, yuv: [f32; 3]) -> [f32; 3] {
        let f = Factors::new(matrix, full, depth);
        [0, 1, 2].map(|c| f.luma * yuv[0] + f.u[c] * yuv[1] + f.v[c] * yuv[2] + f.offset[c])
    }

    #[test]
    fn white_black_and_red_are_where_the_standards_put_them() {
        let near = |a: [f32; 3], b: [f32; 3]| a.iter().zip(b).all(|(x, y)| (x - y).abs() < 0.7);
        for matrix in [Matrix::Bt601, Matrix::Bt709, Matrix::Bt2020, Matrix::Smpte240m, Matrix::Fcc, Matrix::YCgCo] {
            assert!(near(rgb(matrix, false, 8, [235.0, 128.0, 128.0]), [255.0; 3]), "{matrix:?}");
            assert!(near(rgb(matrix, false, 10, [64.0, 512.0, 512.0]), [0.0; 3]), "{matrix:?}");
            assert!(near(rgb(matrix, true, 10, [1023.0, 512.0, 512.0]), [255.0; 3]), "{matrix:?}");
        }
        // Pure red in BT.709 and BT.601, limited range: H.273's own numbers, rounded.
        assert!(near(rgb(Matrix::Bt709, false, 8, [62.56, 102.34, 240.0]), [255.0, 0.0, 0.0]));
        assert!(near(rgb(Matrix::Bt601, false, 8, [81.48, 90.2, 240.0]), [255.0, 0.0, 0.0]));
    }

    #[test]
    fn an_unspecified_matrix_goes_by_the_size() {
        assert_eq!([guess(720, 576), guess(1280, 544), guess(540, 960)], [Matrix::Bt601, Matrix::Bt709, Matrix::Bt709]);
    }
}
