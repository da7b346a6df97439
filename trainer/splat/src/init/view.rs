//! Small pinhole pictures for the plane sweep: frames reduced by a whole number and undistorted, grey with validity.
//!
//! A pixel's grey is 1–255, or 0 where the picture has nothing to say. [`View::packed`] holds the 2×2 greys right and
//! below of each pixel in one word, so that a bilinear sample is one load; it is 0 where any of the four is invalid.

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use risorius_formats::Intrinsics;

use crate::scene::Frame;

/// Pixels that a reduced picture has at most, about.
const AREA: f64 = 36_000.0;

/// A reduced, undistorted picture.
#[derive(Clone, Debug)]
pub(crate) struct View {
    /// Pixels along a row.
    pub(crate) width: usize,
    /// Rows.
    pub(crate) height: usize,
    /// Focal lengths, pixels.
    pub(crate) focal: DVec2,
    /// Principal point, pixels; the centre of the first pixel is (0.5, 0.5).
    pub(crate) center: DVec2,
    /// Row by row, 0 where invalid.
    pub(crate) grey: Vec<u8>,
    /// Row by row: grey at (0, 0), (1, 0), (0, 1), (1, 1) from the lowest byte on.
    pub(crate) packed: Vec<u32>,
    /// Row by row.
    pub(crate) rgb: Vec<[u8; 3]>,
}

/// How many times a picture of this size is reduced.
pub(crate) fn divisor(width: u32, height: u32) -> usize {
    let area = f64::from(width) * f64::from(height);
    (area / AREA).sqrt().round().clamp(1.0, 16.0) as usize
}

/// Where the full-size picture shows the centres of the pixels of a reduced pinhole picture.
#[derive(Clone, Debug, Default)]
pub(crate) struct Undistortion {
    lens: Option<Intrinsics>,
    /// Row by row; NaN where no pixel shows the direction.
    places: Vec<DVec2>,
}

impl Undistortion {
    /// Of one lens; nothing for a pinhole.
    pub(crate) fn new(lens: &Intrinsics) -> Self {
        if is_pinhole(lens) {
            return Self::default();
        }
        let d = divisor(lens.width, lens.height);
        let (width, height) = (lens.width as usize / d, lens.height as usize / d);
        let by = 1.0 / d as f64;
        let (focal, center) = (DVec2::new(lens.fx, lens.fy) * by, DVec2::new(lens.cx, lens.cy) * by);
        let place = |i: usize| {
            let pixel = DVec2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
            let ideal = (pixel - center) / focal;
            let at = lens.project(ideal.extend(1.0));
            // Beyond the fold of the lens model no pixel shows this direction.
            let known = lens.unproject(at).is_some_and(|back| (back - ideal).length() < 1e-3);
            if known { at } else { DVec2::NAN }
        };
        Self { lens: Some(*lens), places: (0..width * height).into_par_iter().map(place).collect() }
    }
}

fn is_pinhole(lens: &Intrinsics) -> bool {
    lens.distortion.is_none() && lens.skew == 0.0
}

impl View {
    /// The reduced picture of a frame, by the undistortion of its lens if that is at hand; `None` where the frame's picture is smaller than its camera says.
    pub(crate) fn new(frame: &Frame<'_>, undistortion: &Undistortion) -> Option<Self> {
        let lens = &frame.camera.intrinsics;
        let (full_width, full_height) = (lens.width as usize, lens.height as usize);
        let area = full_width.checked_mul(full_height)?;
        let masked = frame.valid.is_some_and(|v| v.len() < area);
        if area == 0 || frame.rgb.len() < area * 3 || masked {
            return None;
        }
        let d = divisor(lens.width, lens.height).min(full_width).min(full_height);
        let (width, height) = (full_width / d, full_height / d);
        let by = 1.0 / d as f64;
        let mut view = Self {
            width,
            height,
            focal: DVec2::new(lens.fx, lens.fy) * by,
            center: DVec2::new(lens.cx, lens.cy) * by,
            grey: vec![0; width * height],
            packed: Vec::new(),
            rgb: vec![[0; 3]; width * height],
        };
        if is_pinhole(lens) {
            view.reduce(frame, d);
        } else if undistortion.lens == Some(*lens) {
            view.undistort(frame, d, &undistortion.places);
        } else {
            view.undistort(frame, d, &Undistortion::new(lens).places);
        }
        view.pack();
        Some(view)
    }

    /// Means of d×d blocks; a block with an invalid pixel is invalid.
    fn reduce(&mut self, frame: &Frame<'_>, d: usize) {
        let full_width = frame.camera.intrinsics.width as usize;
        let share = (d * d) as u32;
        for y in 0..self.height {
            for x in 0..self.width {
                let mut sum = [0u32; 3];
                let mut valid = true;
                for row in y * d..(y + 1) * d {
                    let from = row * full_width + x * d;
                    for pixel in frame.rgb[from * 3..(from + d) * 3].chunks_exact(3) {
                        for (s, &p) in sum.iter_mut().zip(pixel) {
                            *s = s.wrapping_add(u32::from(p));
                        }
                    }
                    valid &= frame.valid.is_none_or(|v| v[from..from + d].iter().all(|&v| v > 0));
                }
                self.put(x, y, sum.map(|s| (s + share / 2) / share), valid);
            }
        }
    }

    /// Means of d×d bilinear samples through the lens.
    fn undistort(&mut self, frame: &Frame<'_>, d: usize, places: &[DVec2]) {
        let lens = &frame.camera.intrinsics;
        let share = (d * d) as f64;
        for y in 0..self.height {
            for x in 0..self.width {
                let at = places[y * self.width + x];
                let mut sum = [0.0; 3];
                let mut valid = at.is_finite();
                for k in 0..d * d {
                    let offset = DVec2::new((k % d) as f64, (k / d) as f64) - 0.5 * (d as f64 - 1.0);
                    match bilinear(frame, lens, at + offset).filter(|_| valid) {
                        Some(rgb) => (0..3).for_each(|c| sum[c] += rgb[c] / share),
                        None => valid = false,
                    }
                }
                self.put(x, y, sum.map(|s| s.round() as u32), valid);
            }
        }
    }

    fn put(&mut self, x: usize, y: usize, rgb: [u32; 3], valid: bool) {
        let i = y * self.width + x;
        let [r, g, b] = rgb;
        self.rgb[i] = rgb.map(|v| v.min(255) as u8);
        self.grey[i] = if valid { ((77 * r + 150 * g + 29 * b + 128) >> 8).clamp(1, 255) as u8 } else { 0 };
    }

    fn pack(&mut self) {
        let (width, height) = (self.width, self.height);
        self.packed = vec![0; width * height];
        for y in 0..height.saturating_sub(1) {
            for x in 0..width.saturating_sub(1) {
                let i = y * width + x;
                let g = &self.grey;
                let four = [g[i], g[i + 1], g[i + width], g[i + width + 1]];
                if four.iter().all(|&g| g > 0) {
                    self.packed[i] = u32::from_le_bytes(four);
                }
            }
        }
    }

    /// The ray of a pixel's centre in camera space, with z = 1.
    pub(crate) fn ray(&self, x: usize, y: usize) -> DVec3 {
        ((DVec2::new(x as f64 + 0.5, y as f64 + 0.5) - self.center) / self.focal).extend(1.0)
    }

    /// The pixel that a point in camera space falls on, as an index; `None` behind the camera and outside the picture.
    pub(crate) fn pixel_of(&self, point_in_camera: DVec3) -> Option<usize> {
        if point_in_camera.z <= 1e-6 {
            return None;
        }
        let at = point_in_camera.truncate() / point_in_camera.z * self.focal + self.center;
        let inside = at.x >= 0.0 && at.y >= 0.0 && at.x < self.width as f64 && at.y < self.height as f64;
        inside.then(|| at.y as usize * self.width + at.x as usize)
    }
}

/// The colour at a position of the full-size picture, 0–255; `None` outside and where a pixel is invalid.
pub(crate) fn bilinear(frame: &Frame<'_>, lens: &Intrinsics, at: DVec2) -> Option<[f64; 3]> {
    let (width, height) = (lens.width as usize, lens.height as usize);
    let p = at - 0.5;
    let inside = p.x > -0.5 && p.y > -0.5 && p.x < width as f64 - 0.5 && p.y < height as f64 - 0.5;
    if !inside {
        return None;
    }
    let p = p.clamp(DVec2::ZERO, DVec2::new(width as f64 - 1.0, height as f64 - 1.0));
    let (x, y) = (p.x as usize, p.y as usize);
    let (fx, fy) = (p.x - x as f64, p.y - y as f64);
    let (x1, y1) = ((x + 1).min(width - 1), (y + 1).min(height - 1));
    let mut sum = [0.0; 3];
    for (x, y, share) in
        [(x, y, (1.0 - fx) * (1.0 - fy)), (x1, y, fx * (1.0 - fy)), (x, y1, (1.0 - fx) * fy), (x1, y1, fx * fy)]
    {
        let i = y * width + x;
        if frame.valid.is_some_and(|v| v.get(i).is_none_or(|&v| v == 0)) {
            return None;
        }
        let pixel = frame.rgb.get(i * 3..i * 3 + 3)?;
        (0..3).for_each(|c| sum[c] += share * f64::from(pixel[c]));
    }
    Some(sum)
}
