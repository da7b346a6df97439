//! SSIM and MS-SSIM as TensorFlow computes them (`tf.image.ssim`, `tf.image.ssim_multiscale`; Wang et al. 2003, 2004):
//! 11×11 Gaussian of σ 1.5, K1 0.01, K2 0.03, valid convolution, RGB channels one by one, 2×2 means between scales (odd
//! sides repeat their last row or column), negative values 0 before the power.

use image::RgbImage;
use rayon::prelude::*;
use serde::Serialize;

/// Side of the window.
const WINDOW: usize = 11;
const SIGMA: f64 = 1.5;
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;
/// Exponents of the scales, the finest first.
const POWERS: [f64; 5] = [0.0448, 0.2856, 0.3001, 0.2363, 0.1333];

/// MS-SSIM of two pictures.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct MsSsim {
    /// 0–1.
    pub value: f64,
    /// Scales that fit: 5 from 176 pixels on. Fewer take the first exponents, scaled to the same sum, and cannot be
    /// compared with values of five.
    pub scales: usize,
}

/// One channel of a picture, 0–1.
#[derive(Clone)]
struct Plane {
    width: usize,
    height: usize,
    values: Vec<f64>,
}

impl Plane {
    fn channel(image: &RgbImage, channel: usize) -> Self {
        Self {
            width: image.width() as usize,
            height: image.height() as usize,
            values: image.as_raw().iter().skip(channel).step_by(3).map(|&v| f64::from(v) / 255.0).collect(),
        }
    }

    fn zip(&self, other: &Self, f: impl Fn(f64, f64) -> f64) -> Self {
        let values = self.values.iter().zip(&other.values).map(|(a, b)| f(*a, *b)).collect();
        Self { values, ..*self }
    }

    /// Weighted means under every window that lies inside.
    fn blurred(&self, kernel: &[f64; WINDOW]) -> Self {
        let (width, height) = (self.width - WINDOW + 1, self.height - WINDOW + 1);
        let mut rows = vec![0.0; width * self.height];
        for (row, out) in self.values.chunks_exact(self.width).zip(rows.chunks_exact_mut(width)) {
            for (x, out) in out.iter_mut().enumerate() {
                *out = row[x..x + WINDOW].iter().zip(kernel).map(|(v, k)| v * k).sum();
            }
        }
        let mut values = vec![0.0; width * height];
        for (y, out) in values.chunks_exact_mut(width).enumerate() {
            for (dy, k) in kernel.iter().enumerate() {
                for (out, v) in out.iter_mut().zip(&rows[(y + dy) * width..]) {
                    *out += v * k;
                }
            }
        }
        Self { width, height, values }
    }

    fn halved(&self) -> Self {
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let at = |x: usize, y: usize| self.values[y.min(self.height - 1) * self.width + x.min(self.width - 1)];
        let mean = |i: usize| {
            let (x, y) = (i % width * 2, i / width * 2);
            (at(x, y) + at(x + 1, y) + at(x, y + 1) + at(x + 1, y + 1)) / 4.0
        };
        Self { width, height, values: (0..width * height).map(mean).collect() }
    }

    fn fits(&self) -> bool {
        self.width >= WINDOW && self.height >= WINDOW
    }
}

fn kernel() -> [f64; WINDOW] {
    let weight = |i: usize| (-((i as f64 - 5.0).powi(2)) / (2.0 * SIGMA * SIGMA)).exp();
    let sum: f64 = (0..WINDOW).map(weight).sum();
    std::array::from_fn(|i| weight(i) / sum)
}

/// SSIM and its contrast-structure part under every window.
fn similarity(a: &Plane, b: &Plane, kernel: &[f64; WINDOW]) -> (Plane, Plane) {
    let (mean_a, mean_b) = (a.blurred(kernel), b.blurred(kernel));
    let products = a.zip(b, |a, b| 2.0 * a * b).blurred(kernel);
    let squares = a.zip(b, |a, b| a * a + b * b).blurred(kernel);
    let mut structure = mean_a.clone();
    let mut whole = mean_a.clone();
    for i in 0..mean_a.values.len() {
        let (p, q) = (mean_a.values[i], mean_b.values[i]);
        let (product, square) = (2.0 * p * q, p * p + q * q);
        let cs = (products.values[i] - product + C2) / (squares.values[i] - square + C2);
        structure.values[i] = cs;
        whole.values[i] = cs * (product + C1) / (square + C1);
    }
    (whole, structure)
}

fn mean(plane: &Plane) -> f64 {
    plane.values.iter().sum::<f64>() / plane.values.len().max(1) as f64
}

/// MS-SSIM; `None` for pictures of different sizes or smaller than one window.
pub fn ms_ssim(a: &RgbImage, b: &RgbImage) -> Option<MsSsim> {
    if a.dimensions() != b.dimensions() {
        return None;
    }
    let (mut width, mut height, mut scales) = (a.width() as usize, a.height() as usize, 0);
    while scales < POWERS.len() && width >= WINDOW && height >= WINDOW {
        (width, height, scales) = (width.div_ceil(2), height.div_ceil(2), scales + 1);
    }
    if scales == 0 {
        return None;
    }
    let total: f64 = POWERS.iter().sum::<f64>() / POWERS[..scales].iter().sum::<f64>();
    let kernel = kernel();
    let channel = |c: usize| {
        let (mut a, mut b) = (Plane::channel(a, c), Plane::channel(b, c));
        let mut product = 1.0;
        for (scale, power) in POWERS[..scales].iter().enumerate() {
            if scale > 0 {
                (a, b) = (a.halved(), b.halved());
            }
            let (whole, structure) = similarity(&a, &b, &kernel);
            let value = if scale + 1 == scales { mean(&whole) } else { mean(&structure) };
            product *= value.max(0.0).powf(power * total);
        }
        product
    };
    let channels: Vec<f64> = (0..3).into_par_iter().map(channel).collect();
    Some(MsSsim { value: channels.iter().sum::<f64>() / 3.0, scales })
}

/// SSIM of every pixel whose window lies inside, mean over channels.
#[derive(Clone, Debug)]
pub struct SsimMap {
    /// Row by row, `width − 10` × `height − 10`.
    pub values: Vec<f64>,
    /// Pixels on each side that have no value.
    pub border: usize,
    /// Values in a row.
    pub width: usize,
}

impl SsimMap {
    /// Mean over the pixels (in the picture's own coordinates, row by row) for which `inside` holds; `None` without any.
    pub fn mean_inside(&self, inside: impl Fn(usize) -> bool) -> Option<f64> {
        let full = self.width + 2 * self.border;
        let (mut sum, mut count) = (0.0, 0usize);
        for (i, value) in self.values.iter().enumerate() {
            if inside((i / self.width + self.border) * full + i % self.width + self.border) {
                sum += value;
                count += 1;
            }
        }
        (count > 0).then(|| sum / count as f64)
    }
}

/// SSIM pixel by pixel; `None` for pictures of different sizes or smaller than one window.
pub fn ssim_map(a: &RgbImage, b: &RgbImage) -> Option<SsimMap> {
    let first = Plane::channel(a, 0);
    if a.dimensions() != b.dimensions() || !first.fits() {
        return None;
    }
    let kernel = kernel();
    let maps: Vec<Plane> =
        (0..3).into_par_iter().map(|c| similarity(&Plane::channel(a, c), &Plane::channel(b, c), &kernel).0).collect();
    let width = maps[0].width;
    let values = (0..maps[0].values.len()).map(|i| maps.iter().map(|m| m.values[i]).sum::<f64>() / 3.0).collect();
    Some(SsimMap { values, border: WINDOW / 2, width })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_is_like_itself_and_unlike_its_negative() {
        let a = crate::eval::scores::testing::pattern(180, 200, 0);
        let same = ms_ssim(&a, &a).unwrap();
        assert!((same.value - 1.0).abs() < 1e-12 && same.scales == 5);
        let negative = RgbImage::from_fn(180, 200, |x, y| image::Rgb(a.get_pixel(x, y).0.map(|v| 255 - v)));
        let other = ms_ssim(&a, &negative).unwrap();
        assert!(other.value.is_finite() && (0.0..0.2).contains(&other.value), "{}", other.value);
        assert_eq!(ms_ssim(&RgbImage::new(40, 60), &RgbImage::new(40, 60)).unwrap().scales, 2);
        assert!(
            ms_ssim(&a, &RgbImage::new(180, 201)).is_none()
                && ms_ssim(&RgbImage::new(8, 8), &RgbImage::new(8, 8)).is_none()
        );
    }

    #[test]
    fn the_map_tells_where() {
        let a = crate::eval::scores::testing::pattern(64, 48, 0);
        let mut b = a.clone();
        for y in 0..48 {
            for x in 0..20 {
                b.put_pixel(x, y, image::Rgb([90, 90, 90]));
            }
        }
        let map = ssim_map(&a, &b).unwrap();
        assert_eq!(map.values.len(), 54 * 38);
        let (left, right) = (map.mean_inside(|i| i % 64 < 14).unwrap(), map.mean_inside(|i| i % 64 > 26).unwrap());
        assert!(left < 0.5 && (right - 1.0).abs() < 1e-12, "{left} {right}");
        assert!(map.mean_inside(|_| false).is_none());
    }
}
