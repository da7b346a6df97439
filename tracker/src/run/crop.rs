//! Square crops around a face, and sampling them from a picture.
//!
//! All pixel coordinates have the centre of the first pixel at (0.5, 0.5), in the picture and in the crop.

use image::RgbImage;

use crate::models::manifest::Layout;

/// A square region of a picture that stands upright on the face.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Crop {
    /// Its middle, pixels of the picture.
    pub center: [f32; 2],
    /// Length of its side, pixels of the picture.
    pub side: f32,
    /// Clockwise angle of the line from the image-left to the image-right eye, radians.
    pub angle: f32,
}

/// `a_from_b` of points in the plane: `a = M b + t`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Affine {
    /// M, by rows.
    pub linear: [[f32; 2]; 2],
    /// t.
    pub shift: [f32; 2],
}

impl Affine {
    /// The point of `a` for a point of `b`.
    pub fn apply(&self, p: [f32; 2]) -> [f32; 2] {
        let [[a, b], [c, d]] = self.linear;
        [a * p[0] + b * p[1] + self.shift[0], c * p[0] + d * p[1] + self.shift[1]]
    }
}

impl Crop {
    /// The crop around a face's points: the box in which the eyes are level, enlarged by `margin`. `left_eye` and
    /// `right_eye` are the outer corners, image-left and image-right.
    ///
    /// `None` where the points have no extent or are not numbers.
    pub fn around(
        points: impl Iterator<Item = [f32; 2]>,
        left_eye: [f32; 2],
        right_eye: [f32; 2],
        margin: f32,
    ) -> Option<Self> {
        let angle = (right_eye[1] - left_eye[1]).atan2(right_eye[0] - left_eye[0]);
        let (sin, cos) = angle.sin_cos();
        let (mut low, mut high) = ([f32::MAX; 2], [f32::MIN; 2]);
        for [x, y] in points {
            let level = [cos * x + sin * y, cos * y - sin * x];
            for axis in 0..2 {
                low[axis] = low[axis].min(level[axis]);
                high[axis] = high[axis].max(level[axis]);
            }
        }
        let [x, y] = [0, 1].map(|axis| 0.5 * (low[axis] + high[axis]));
        let side = margin * (high[0] - low[0]).max(high[1] - low[1]);
        let crop = Self { center: [cos * x - sin * y, sin * x + cos * y], side, angle };
        crop.is_sane().then_some(crop)
    }

    /// Whether there is something in it.
    pub fn is_sane(&self) -> bool {
        self.side >= 4.0 && self.side < 1e5 && self.center.iter().all(|c| c.abs() < 1e6) && self.angle.is_finite()
    }

    /// From pixels of a crop of `size`×`size` pixels to those of the picture.
    pub fn picture_from_crop(&self, size: u32) -> Affine {
        let size = size as f32;
        let k = self.side / size;
        let (sin, cos) = self.angle.sin_cos();
        let linear = [[k * cos, -k * sin], [k * sin, k * cos]];
        let half = 0.5 * size;
        let shift = [
            self.center[0] - (linear[0][0] + linear[0][1]) * half,
            self.center[1] - (linear[1][0] + linear[1][1]) * half,
        ];
        Affine { linear, shift }
    }

    /// How far another crop is from this one: shift and change of size in shares of the side, or the turn in radians,
    /// whichever is largest.
    pub fn distance(&self, other: &Self) -> f32 {
        let shift = (self.center[0] - other.center[0]).hypot(self.center[1] - other.center[1]) / self.side;
        let growth = (other.side / self.side).ln().abs();
        shift.max(growth).max(turn(self.angle, other.angle).abs())
    }

    /// The crop `share` of the way from `self` to `new`.
    #[must_use]
    pub fn blended(&self, new: &Self, share: f32) -> Self {
        let between = |a: f32, b: f32| a + share * (b - a);
        Self {
            center: [between(self.center[0], new.center[0]), between(self.center[1], new.center[1])],
            side: between(self.side, new.side),
            angle: self.angle + share * turn(self.angle, new.angle),
        }
    }

    /// Where the crop will be `share` times the way from `before` to `self` later.
    #[must_use]
    pub fn extrapolated(&self, before: &Self, share: f32) -> Self {
        let step = |axis: usize| share * (self.center[axis] - before.center[axis]);
        Self {
            center: [self.center[0] + step(0), self.center[1] + step(1)],
            side: self.side * (self.side / before.side).powf(share).clamp(0.8, 1.25),
            angle: self.angle + share * turn(before.angle, self.angle),
        }
    }
}

/// From one angle to another the short way, radians.
fn turn(from: f32, to: f32) -> f32 {
    use std::f32::consts::{PI, TAU};
    (to - from + PI).rem_euclid(TAU) - PI
}

/// The picture that a network reads, made from a larger one.
#[derive(Clone, Copy, Debug)]
pub struct Sampling {
    /// Width of the network's picture, pixels.
    pub width: u32,
    /// Height of the network's picture, pixels.
    pub height: u32,
    /// Order of its axes.
    pub layout: Layout,
    /// Level that becomes 0.
    pub mean: f32,
    /// Value per level.
    pub scale: f32,
}

/// A tap of the sampler stands for at most so many pixels of the picture, so that large pictures are averaged, not
/// skipped over.
const PIXELS_PER_TAP: f32 = 1.6;

impl Sampling {
    /// How many numbers the network's picture has.
    pub fn len(&self) -> usize {
        (self.width * self.height * 3) as usize
    }

    /// Whether it has none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Fills `out` with the RGB values (level − mean) × scale of the network's picture. Beyond the edges the picture is
    /// black. Each value is the mean of `taps`² bilinear samples, one where the picture is not made smaller.
    pub fn sample(&self, picture: &RgbImage, picture_from_input: &Affine, out: &mut Vec<f32>) {
        out.clear();
        out.resize(self.len(), 0.0);
        let [[xx, xy], [yx, yy]] = picture_from_input.linear;
        let taps = ((xx.hypot(yx).max(xy.hypot(yy)) / PIXELS_PER_TAP).ceil() as u32).clamp(1, 8);
        let (width, height) = (self.width as usize, self.height as usize);
        let plane = width * height;
        let weight = self.scale / (taps * taps) as f32;
        let zero = -self.mean * self.scale;
        for row in 0..height {
            for column in 0..width {
                let mut sum = [0.0f32; 3];
                for tap in 0..taps * taps {
                    let u = column as f32 + ((tap % taps) as f32 + 0.5) / taps as f32;
                    let v = row as f32 + ((tap / taps) as f32 + 0.5) / taps as f32;
                    let [x, y] = picture_from_input.apply([u, v]);
                    add_bilinear(picture, x - 0.5, y - 0.5, &mut sum);
                }
                let at = row * width + column;
                for (c, value) in sum.into_iter().enumerate() {
                    let place = if self.layout == Layout::Nhwc { 3 * at + c } else { c * plane + at };
                    out[place] = value * weight + zero;
                }
            }
        }
    }
}

/// Adds the bilinear sample at (x, y), where whole numbers are the centres of pixels.
#[inline]
fn add_bilinear(picture: &RgbImage, x: f32, y: f32, sum: &mut [f32; 3]) {
    let (width, height) = (picture.width() as i32, picture.height() as i32);
    let (left, top) = (x.floor(), y.floor());
    let (fx, fy) = (x - left, y - top);
    // Saturating casts: a wild crop is simply outside.
    let (left, top) = (left as i32, top as i32);
    let bytes = picture.as_raw();
    if left >= 0 && top >= 0 && left < width - 1 && top < height - 1 {
        let row = 3 * width as usize;
        let at = top as usize * row + 3 * left as usize;
        let (upper, lower) = (&bytes[at..at + 6], &bytes[at + row..at + row + 6]);
        for c in 0..3 {
            let above = f32::from(upper[c]) + fx * (f32::from(upper[c + 3]) - f32::from(upper[c]));
            let below = f32::from(lower[c]) + fx * (f32::from(lower[c + 3]) - f32::from(lower[c]));
            sum[c] += above + fy * (below - above);
        }
        return;
    }
    for (dx, dy, w) in
        [(0, 0, (1.0 - fx) * (1.0 - fy)), (1, 0, fx * (1.0 - fy)), (0, 1, (1.0 - fx) * fy), (1, 1, fx * fy)]
    {
        let (px, py) = (left.saturating_add(dx), top.saturating_add(dy));
        if px >= 0 && py >= 0 && px < width && py < height {
            let at = 3 * (py as usize * width as usize + px as usize);
            for c in 0..3 {
                sum[c] += w * f32::from(bytes[at + c]);
            }
        }
    }
}

#[cfg(test)]
#[path = "crop_tests.rs"]
mod tests;
