//! How a stored picture becomes the picture that is shown: widened where its pixels are not square, mirrored, turned.

use image::RgbImage;

/// Mirror left and right first, if so; then turn clockwise.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Orientation {
    pub(crate) mirrored: bool,
    /// 0, 90, 180 or 270.
    pub(crate) clockwise_degrees: u32,
}

impl Orientation {
    /// From a display matrix: (x, y) is shown at (a·x + c·y, b·x + d·y), y downwards; to the nearest quarter turn.
    pub(crate) fn from_matrix(a: i32, b: i32, c: i32, d: i32) -> Self {
        let (a, b, c, d) = (f64::from(a), f64::from(b), f64::from(c), f64::from(d));
        if a * d - b * c == 0.0 {
            return Self::default();
        }
        let mirrored = a * d - b * c < 0.0;
        let sign = if mirrored { -1.0 } else { 1.0 };
        let quarters = ((sign * b).atan2(sign * a).to_degrees() / 90.0).round() as i64;
        Self { mirrored, clockwise_degrees: 90 * quarters.rem_euclid(4) as u32 }
    }

    /// From the 9 numbers of FFmpeg's side data, in the machine's byte order.
    pub(crate) fn from_side_data(bytes: &[u8]) -> Option<Self> {
        let entry = |i: usize| Some(i32::from_ne_bytes(bytes.get(4 * i..4 * i + 4)?.try_into().ok()?));
        Some(Self::from_matrix(entry(0)?, entry(1)?, entry(3)?, entry(4)?))
    }

    /// Turned further by `degrees` clockwise.
    pub(crate) fn turned(self, degrees: u32) -> Self {
        Self { clockwise_degrees: (self.clockwise_degrees + degrees) % 360, ..self }
    }

    /// The size of a picture of this size once it is turned.
    pub(crate) fn size(self, (width, height): (u32, u32)) -> (u32, u32) {
        if self.clockwise_degrees.is_multiple_of(180) { (width, height) } else { (height, width) }
    }

    pub(crate) fn apply(self, picture: RgbImage) -> RgbImage {
        if self == Self::default() {
            return picture;
        }
        let (width, height) = (picture.width() as usize, picture.height() as usize);
        let source = picture.as_raw();
        let mut out = vec![0; source.len()];
        let (shown_width, shown_height) = self.size(picture.dimensions());
        // The stored place of a shown pixel is start + x·across + y·down, in pixels.
        let (w, h) = (width as isize, height as isize);
        let corner = |x: isize, y: isize| y * w + if self.mirrored { w - 1 - x } else { x };
        let right = if self.mirrored { -1 } else { 1 };
        let (start, across, down) = match self.clockwise_degrees {
            90 => (corner(0, h - 1), -w, right),
            180 => (corner(w - 1, h - 1), -right, -w),
            270 => (corner(w - 1, 0), w, -right),
            _ => (corner(0, 0), right, w),
        };
        // Blocks keep the rows that a turn crosses in the cache.
        let (columns, rows) = (shown_width as usize, shown_height as usize);
        for y0 in (0..rows).step_by(BLOCK) {
            for x0 in (0..columns).step_by(BLOCK) {
                for y in y0..(y0 + BLOCK).min(rows) {
                    let end = (x0 + BLOCK).min(columns);
                    let mut from = start + y as isize * down + x0 as isize * across;
                    for pixel in out[3 * (y * columns + x0)..3 * (y * columns + end)].chunks_exact_mut(3) {
                        let place = 3 * from as usize;
                        pixel.copy_from_slice(&source[place..place + 3]);
                        from += across;
                    }
                }
            }
        }
        RgbImage::from_raw(shown_width, shown_height, out).unwrap_or(picture)
    }
}

/// Side of the squares in which pictures are turned, pixels.
const BLOCK: usize = 32;

/// Pictures whose pixels are not square, resampled across to those that are.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Widening {
    width: u32,
    /// First stored column and weights for every shown column.
    taps: Vec<(usize, Vec<f32>)>,
}

impl Widening {
    /// For pixels `aspect` times as wide as high; `None` where that changes nothing.
    pub(crate) fn new(stored_width: u32, aspect: f64) -> Option<Self> {
        let width = (f64::from(stored_width) * aspect).round().clamp(1.0, 65_535.0) as u32;
        if width == stored_width {
            return None;
        }
        let step = f64::from(stored_width) / f64::from(width);
        // Where there are fewer pixels than before, the kernel covers all that fall into one.
        let reach = step.max(1.0);
        let last = i64::from(stored_width) - 1;
        let taps = (0..width)
            .map(|x| {
                let centre = (f64::from(x) + 0.5) * step - 0.5;
                let first = (centre - 2.0 * reach).ceil() as i64;
                let end = (centre + 2.0 * reach).floor() as i64;
                let begin = first.clamp(0, last);
                let mut weights = vec![0.0; (end.clamp(0, last) - begin + 1) as usize];
                for column in first..=end {
                    weights[(column.clamp(0, last) - begin) as usize] += cubic((column as f64 - centre) / reach);
                }
                let sum: f64 = weights.iter().sum();
                (begin as usize, weights.iter().map(|w| (w / sum) as f32).collect())
            })
            .collect();
        Some(Self { width, taps })
    }

    /// Width of the shown pictures, pixels.
    pub(crate) fn width(&self) -> u32 {
        self.width
    }

    pub(crate) fn apply(&self, picture: &RgbImage) -> RgbImage {
        let mut out = RgbImage::new(self.width, picture.height());
        let rows = picture.as_raw().chunks_exact(3 * picture.width() as usize);
        for (row, shown) in rows.zip(out.chunks_exact_mut(3 * self.width as usize)) {
            for (pixel, (first, weights)) in shown.chunks_exact_mut(3).zip(&self.taps) {
                let mut sum = [0.5f32; 3];
                for (stored, weight) in row[3 * first..].chunks_exact(3).zip(weights) {
                    sum.iter_mut().zip(stored).for_each(|(s, &v)| *s += weight * f32::from(v));
                }
                pixel.iter_mut().zip(sum).for_each(|(p, s)| *p = s as u8);
            }
        }
        out
    }
}

/// The bicubic kernel with −0.6, as FFmpeg's scaler has it.
fn cubic(x: f64) -> f64 {
    const A: f64 = -0.6;
    let x = x.abs();
    if x < 1.0 {
        ((A + 2.0) * x - (A + 3.0)) * x * x + 1.0
    } else if x < 2.0 {
        A * (((x - 5.0) * x + 8.0) * x - 4.0)
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use image::Rgb;
    use image::imageops::{flip_horizontal, rotate90, rotate180, rotate270};

    use super::*;

    #[test]
    fn matrices_are_quarter_turns_with_or_without_a_mirror() {
        let of = |a, b, c, d| {
            let o = Orientation::from_matrix(a, b, c, d);
            (o.mirrored, o.clockwise_degrees)
        };
        assert_eq!(
            [of(1, 0, 0, 1), of(0, 1, -1, 0), of(-1, 0, 0, -1), of(0, -1, 1, 0)],
            [(false, 0), (false, 90), (false, 180), (false, 270)]
        );
        assert_eq!([of(-1, 0, 0, 1), of(1, 0, 0, -1)], [(true, 0), (true, 180)]);
        assert_eq!(of(0, 0, 0, 0), (false, 0));
    }

    #[test]
    fn pictures_are_turned_as_the_image_crate_does() {
        let picture = RgbImage::from_fn(70, 41, |x, y| Rgb([x as u8, y as u8, (x * y) as u8]));
        for mirrored in [false, true] {
            let first = if mirrored { flip_horizontal(&picture) } else { picture.clone() };
            let expected = [first.clone(), rotate90(&first), rotate180(&first), rotate270(&first)];
            for (degrees, expected) in [0, 90, 180, 270].into_iter().zip(expected) {
                let turned = Orientation { mirrored, clockwise_degrees: degrees }.apply(picture.clone());
                assert!(turned == expected, "mirrored {mirrored}, {degrees}°");
            }
        }
    }

    #[test]
    fn widening_keeps_flat_pictures_and_slopes() {
        assert_eq!(Widening::new(404, 1.0), None);
        let wider = Widening::new(404, 540.0 / 404.0).unwrap();
        assert_eq!(wider.width(), 540);
        let slope = RgbImage::from_fn(404, 2, |x, _| Rgb([(x / 2) as u8, 77, 255]));
        let shown = wider.apply(&slope);
        for (x, y, pixel) in shown.enumerate_pixels() {
            assert!(pixel[1] == 77 && pixel[2] == 255, "{x}, {y}: {pixel:?}");
            let expected = (f64::from(x) + 0.5) * 404.0 / 540.0 / 2.0;
            assert!((f64::from(pixel[0]) - expected).abs() < 1.3, "{x}: {pixel:?}");
        }
        assert_eq!(
            Widening::new(720, 8.0 / 9.0).unwrap().apply(&RgbImage::from_pixel(720, 1, Rgb([9; 3]))).as_raw(),
            &vec![9; 3 * 640]
        );
    }
}
