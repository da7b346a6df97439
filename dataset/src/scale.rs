//! Smaller pictures by true area averaging.
//!
//! The capture notebook of the Nerfies family meant to do this but ran a bilinear filter, which aliases at factors 4
//! and 8 (fact sheet §3.8); pictures made here differ from theirs by that.

use image::RgbImage;

/// Widths and heights become multiples of this, so that every scale divides them.
pub const GRID: u32 = 8;

/// The size after trimming right and bottom to multiples of [`GRID`]; `None` when nothing would be left.
pub fn trimmed_size(width: u32, height: u32) -> Option<(u32, u32)> {
    let (w, h) = (width / GRID * GRID, height / GRID * GRID);
    (w > 0 && h > 0).then_some((w, h))
}

/// The picture at `1/divisor` of its trimmed size: every pixel is the mean of `divisor²` ones, rounded half up.
///
/// `divisor` must divide [`GRID`].
pub fn reduced(image: &RgbImage, divisor: u32) -> RgbImage {
    let (width, height) = trimmed_size(image.width(), image.height()).unwrap_or((0, 0));
    let divisor = divisor.max(1);
    let (w, h) = (width / divisor, height / divisor);
    let stride = image.width() as usize * 3;
    let source = image.as_raw();
    if divisor == 1 {
        let rows = source.chunks_exact(stride.max(1)).take(h as usize).flat_map(|row| &row[..w as usize * 3]);
        return RgbImage::from_raw(w, h, rows.copied().collect()).unwrap_or_default();
    }
    let d = divisor as usize;
    let count = divisor * divisor;
    let mut sums = vec![0u32; w as usize * 3];
    let mut out = Vec::with_capacity(w as usize * h as usize * 3);
    for band in source.chunks_exact(stride.max(1) * d).take(h as usize) {
        sums.fill(0);
        for row in band.chunks_exact(stride) {
            for (sum, block) in sums.chunks_exact_mut(3).zip(row.chunks_exact(3 * d)) {
                for pixel in block.chunks_exact(3) {
                    sum[0] += u32::from(pixel[0]);
                    sum[1] += u32::from(pixel[1]);
                    sum[2] += u32::from(pixel[2]);
                }
            }
        }
        out.extend(sums.iter().map(|&s| ((s + count / 2) / count) as u8));
    }
    RgbImage::from_raw(w, h, out).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;
    use proptest::prelude::*;

    #[test]
    fn sizes_are_trimmed_right_and_bottom() {
        assert_eq!(trimmed_size(540, 960), Some((536, 960)));
        assert_eq!(trimmed_size(7, 100), None);
        let image = RgbImage::from_fn(17, 9, |x, y| Rgb([x as u8, y as u8, 0]));
        let full = reduced(&image, 1);
        assert_eq!((full.width(), full.height()), (16, 8));
        assert!(full.enumerate_pixels().all(|(x, y, p)| p.0 == [x as u8, y as u8, 0]));
    }

    #[test]
    fn the_finest_pattern_becomes_grey_and_halves_round_up() {
        let board = RgbImage::from_fn(16, 16, |x, y| Rgb([if (x + y) % 2 == 0 { 255 } else { 0 }; 3]));
        for divisor in [2, 4, 8] {
            // 127.5 → 128: aliasing filters would keep stripes.
            assert!(reduced(&board, divisor).pixels().all(|p| p.0 == [128; 3]), "{divisor}");
        }
    }

    proptest! {
        #[test]
        fn each_pixel_is_the_mean_of_its_block(w in 8u32..30, h in 8u32..30, seed in any::<u32>(), divisor in prop::sample::select(vec![1u32, 2, 4, 8])) {
            let value = |x: u32, y: u32, c: u32| (x.wrapping_mul(7919) ^ y.wrapping_mul(104_729) ^ c.wrapping_mul(31) ^ seed).wrapping_mul(2_654_435_761) >> 24;
            let image = RgbImage::from_fn(w, h, |x, y| Rgb([0, 1, 2].map(|c| value(x, y, c) as u8)));
            let small = reduced(&image, divisor);
            prop_assert_eq!((small.width(), small.height()), (w / 8 * 8 / divisor, h / 8 * 8 / divisor));
            for (x, y, p) in small.enumerate_pixels() {
                for c in 0..3 {
                    let sum: u32 = (0..divisor * divisor).map(|i| value(x * divisor + i % divisor, y * divisor + i / divisor, c)).sum();
                    let mean = f64::from(sum) / f64::from(divisor * divisor);
                    prop_assert_eq!(p.0[c as usize], (mean + 0.5).floor() as u8);
                }
            }
        }
    }
}
