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
fn luma([r, g, b]: [u8; 3]) -> u8 {
    ((77 * u32::from(r) + 150 * u32::from(g) + 29 * u32::from(b) + 128) >> 8) as u8
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
            for (cell, block) in out.iter_mut().zip(row.chunks_exact(3 * factor)) {
                *cell += block.chunks_exact(3).map(|p| u32::from(luma([p[0], p[1], p[2]]))).sum::<u32>();
            }
        };
        if factor == 1 {
            let pixels = image.as_raw().chunks_exact(3).map(|p| luma([p[0], p[1], p[2]])).collect();
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
        let (mut sum, mut squares) = (0i64, 0i64);
        let rows: Vec<&[u8]> = self.pixels.chunks_exact(self.width).collect();
        for window in rows.windows(3) {
            let [above, row, below] = [window[0], window[1], window[2]];
            let (mut s, mut q) = (0i32, 0i64);
            let inner = row.windows(3).zip(&above[1..]).zip(&below[1..]);
            for ((three, &up), &down) in inner {
                let value = i32::from(three[0]) + i32::from(three[2]) + i32::from(up) + i32::from(down) - 4 * i32::from(three[1]);
                s += value;
                q += i64::from(value * value);
            }
            sum += i64::from(s);
            squares += q;
        }
        let n = ((self.width - 2) * (self.height - 2)) as f64;
        let mean = sum as f64 / n;
        (squares as f64 / n - mean * mean).max(0.0) as f32
    }
}

/// Measures a picture.
///
/// Pictures with a side above 1024 pixels are reduced first (means of k×k blocks), so that the sharpness of a face that
/// fills the picture compares between cameras.
pub fn measure(image: &RgbImage) -> Quality {
    let luma = Luma::of(image);
    let mut histogram = [0u64; 256];
    for &p in &luma.pixels {
        histogram[usize::from(p)] += 1;
    }
    let n = luma.pixels.len().max(1) as f64;
    let sum: u64 = histogram.iter().zip(0u64..).map(|(count, level)| count * level).sum();
    let clipped: u64 = histogram[..=2].iter().chain(&histogram[253..]).sum();
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
