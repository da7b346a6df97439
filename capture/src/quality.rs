//! Sharpness and exposure of a picture, and how much two pictures differ.

use image::RgbImage;

/// The longer side of the luma image that is measured, at most; larger pictures are reduced by whole factors.
const MEASURED_SIDE: u32 = 1024;
/// About how many pixels stand for a picture when two are compared.
const SAMPLES: usize = 16384;

/// What is measured of one picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Quality {
    /// Variance of the 4-neighbour Laplacian of the luma, in squared 8-bit levels.
    pub sharpness: f32,
    /// Mean luma, 0–255.
    pub luma_mean: f32,
    /// Share of pixels with luma ≤ 2 or ≥ 253, 0–1.
    pub clipped_share: f32,
}

/// An 8-bit luma image, row by row.
struct Luma {
    width: usize,
    height: usize,
    pixels: Vec<u8>,
}

/// Rec. 601 luma in 8-bit steps.
///
/// At most 256 · 255 + 128, which fits. Here and below the sums are written as wrapping ones because checked ones keep the
/// compiler from using vector instructions, which makes these loops four times slower.
fn luma([r, g, b]: [u8; 3]) -> u8 {
    let sum = 77u16
        .wrapping_mul(r.into())
        .wrapping_add(150u16.wrapping_mul(g.into()))
        .wrapping_add(29u16.wrapping_mul(b.into()));
    (sum.wrapping_add(128) >> 8) as u8
}

impl Luma {
    /// The luma of `image`, reduced by the smallest whole factor that brings the longer side to [`MEASURED_SIDE`].
    fn of(image: &RgbImage) -> Self {
        let (long, short) = (image.width().max(image.height()), image.width().min(image.height()));
        let factor = long.div_ceil(MEASURED_SIDE).clamp(1, short.max(1)) as usize;
        let stride = 3 * image.width() as usize;
        // A last, incomplete block is left out.
        let (width, height) = (image.width() as usize / factor, image.height() as usize / factor);
        let row_luma = |row: &[u8], out: &mut [u32]| {
            for (cell, block) in out.iter_mut().zip(row.as_chunks::<3>().0.chunks_exact(factor)) {
                *cell = block.iter().fold(*cell, |sum, p| sum.wrapping_add(luma(*p).into()));
            }
        };
        if factor == 1 {
            let mut pixels = vec![0; width * height];
            for (out, pixel) in pixels.iter_mut().zip(image.as_raw().as_chunks::<3>().0) {
                *out = luma(*pixel);
            }
            return Self { width, height, pixels };
        }
        let area = (factor * factor) as u32;
        let mut pixels = Vec::with_capacity(width * height);
        let mut sums = vec![0u32; width];
        for rows in image.as_raw().chunks_exact(stride * factor).take(height) {
            sums.fill(0);
            rows.chunks_exact(stride).for_each(|row| row_luma(row, &mut sums));
            pixels.extend(sums.iter().map(|s| ((s + area / 2) / area) as u8));
        }
        Self { width, height, pixels }
    }

    /// Variance of the Laplacian over the inner pixels; exact integer sums, so that it does not depend on threads.
    fn laplacian_variance(&self) -> f32 {
        if self.width < 3 || self.height < 3 {
            return 0.0;
        }
        let n = self.width - 2;
        let (mut sum, mut squares) = (0i64, 0i64);
        let rows: Vec<&[u8]> = self.pixels.chunks_exact(self.width).collect();
        for window in rows.windows(3) {
            let (left, middle, right) = (&window[1][..n], &window[1][1..=n], &window[1][2..]);
            let (above, below) = (&window[0][1..=n], &window[2][1..=n]);
            // A row has at most 1022 values of at most 1020 each: 32 bits hold their squares.
            let (mut row_sum, mut row_squares) = (0i32, 0u32);
            for i in 0..n {
                let around = i32::from(left[i])
                    .wrapping_add(right[i].into())
                    .wrapping_add(above[i].into())
                    .wrapping_add(below[i].into());
                let value = around.wrapping_sub(4i32.wrapping_mul(middle[i].into()));
                row_sum = row_sum.wrapping_add(value);
                row_squares = row_squares.wrapping_add(value.wrapping_mul(value) as u32);
            }
            sum += i64::from(row_sum);
            squares += i64::from(row_squares);
        }
        let count = (n * (self.height - 2)) as f64;
        let mean = sum as f64 / count;
        (squares as f64 / count - mean * mean).max(0.0) as f32
    }
}

/// Measures a picture.
///
/// Pictures with a side above 1024 pixels are reduced first (means of k×k blocks), so that the sharpness of a face that
/// fills the picture compares between cameras.
pub fn measure(image: &RgbImage) -> Quality {
    let luma = Luma::of(image);
    let (mut sum, mut clipped) = (0u64, 0u64);
    for row in luma.pixels.chunks(luma.width.max(1)) {
        let (mut row_sum, mut row_clipped) = (0u32, 0u32);
        for &p in row {
            row_sum = row_sum.wrapping_add(p.into());
            row_clipped = row_clipped.wrapping_add(u32::from(p.wrapping_sub(3) >= 250));
        }
        sum += u64::from(row_sum);
        clipped += u64::from(row_clipped);
    }
    let n = luma.pixels.len().max(1) as f64;
    Quality {
        sharpness: luma.laplacian_variance(),
        luma_mean: (sum as f64 / n) as f32,
        clipped_share: (clipped as f64 / n) as f32,
    }
}

/// Single pixels of a picture on a regular grid, to compare it with the next one.
///
/// Not means of areas: they would hide the sensor noise, which is what tells a still face from a repeated frame.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Samples(Vec<u8>);

impl Samples {
    /// About 16,000 luma samples of a picture.
    pub fn of(image: &RgbImage) -> Self {
        let (width, height) = (image.width() as usize, image.height() as usize);
        let step = (((width * height) as f64 / SAMPLES as f64).sqrt() as usize).max(1);
        let pixel = |x: usize, y: usize| image.as_raw().get(3 * (y * width + x)..).and_then(|p| p.first_chunk::<3>());
        let grid = (0..height).step_by(step).flat_map(|y| (0..width).step_by(step).map(move |x| (x, y)));
        Self(grid.filter_map(|(x, y)| pixel(x, y)).map(|p| luma(*p)).collect())
    }

    /// Mean absolute difference of the luma, 8-bit levels.
    pub fn difference(&self, other: &Self) -> f32 {
        let sum: u64 = self.0.iter().zip(&other.0).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
        (sum as f64 / self.0.len().max(1) as f64) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;

    #[test]
    fn a_flat_picture_has_no_sharpness_and_its_own_mean() {
        let q = measure(&RgbImage::from_pixel(64, 48, Rgb([100, 100, 100])));
        assert_eq!(q, Quality { sharpness: 0.0, luma_mean: 100.0, clipped_share: 0.0 });
    }

    #[test]
    fn the_ends_of_the_range_are_clipped() {
        let q = |v: u8| measure(&RgbImage::from_pixel(4, 4, Rgb([v, v, v]))).clipped_share;
        assert_eq!([0, 2, 3, 128, 252, 253, 255].map(q), [1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0]);
    }

    #[test]
    fn the_fast_sums_are_those_of_the_plain_formula() {
        let image =
            RgbImage::from_fn(61, 37, |x, y| Rgb([(x * 41 + y * 7) as u8, (x * y * 3) as u8, (y * 97 + x) as u8]));
        let grey = |x: u32, y: u32| {
            let p = image.get_pixel(x, y).0.map(f64::from);
            ((77.0 * p[0] + 150.0 * p[1] + 29.0 * p[2] + 128.0) / 256.0).floor()
        };
        let mut values = Vec::new();
        for (x, y) in (1..60).flat_map(|x| (1..36).map(move |y| (x, y))) {
            values.push(grey(x - 1, y) + grey(x + 1, y) + grey(x, y - 1) + grey(x, y + 1) - 4.0 * grey(x, y));
        }
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / values.len() as f64;
        let luma =
            (0..61).flat_map(|x| (0..37).map(move |y| (x, y))).map(|(x, y)| grey(x, y)).sum::<f64>() / (61.0 * 37.0);
        let q = measure(&image);
        assert!((f64::from(q.sharpness) / variance - 1.0).abs() < 1e-6, "{q:?}, not {variance}");
        assert!((f64::from(q.luma_mean) - luma).abs() < 1e-4, "{q:?}, not {luma}");
    }

    #[test]
    fn a_checkerboard_has_the_variance_of_the_closed_form() {
        // Laplacian of a 0/10 checkerboard: ±40 in equal numbers, so the variance is 1600.
        let board = RgbImage::from_fn(34, 34, |x, y| Rgb([if (x + y) % 2 == 0 { 0 } else { 10 }; 3]));
        let q = measure(&board);
        assert!((q.sharpness - 1600.0).abs() < 1e-3, "{q:?}");
        assert_eq!((q.luma_mean, q.clipped_share), (5.0, 0.5));
    }

    #[test]
    fn large_pictures_are_reduced_by_means_of_blocks() {
        // Blocks of 2×2 average the one-pixel board away, and leave a two-pixel board as it is.
        let fine = RgbImage::from_fn(2048, 64, |x, y| Rgb([if (x + y) % 2 == 0 { 0 } else { 10 }; 3]));
        let coarse = RgbImage::from_fn(2048, 68, |x, y| Rgb([if (x / 2 + y / 2) % 2 == 0 { 0 } else { 10 }; 3]));
        assert_eq!(measure(&fine).sharpness, 0.0);
        assert!((measure(&coarse).sharpness - 1600.0).abs() < 1e-3);
    }

    #[test]
    fn tiny_pictures_do_no_harm() {
        for size in [(1, 1), (2, 5), (3, 3), (4000, 1)] {
            let q = measure(&RgbImage::new(size.0, size.1));
            assert_eq!((q.sharpness, q.clipped_share), (0.0, 1.0), "{size:?}");
        }
    }

    #[test]
    fn the_difference_of_samples_is_in_levels() {
        let a = Samples::of(&RgbImage::from_pixel(640, 480, Rgb([10, 10, 10])));
        let b = Samples::of(&RgbImage::from_pixel(640, 480, Rgb([13, 13, 13])));
        assert_eq!((a.difference(&a), a.difference(&b)), (0.0, 3.0));
    }
}
