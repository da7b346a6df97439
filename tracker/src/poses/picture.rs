//! Grey pictures at halved sizes, read between pixels.
//!
//! Levels hold 16 × the grey value, softened by 1-2-1 in both directions: reading a sharp picture between its pixels by a
//! bilinear rule is biased towards the pixel centres, and that bias would end in the poses.

use image::RgbImage;

/// Levels are dropped until the longer side is at most this, pixels: a face's background needs no more.
const MOST_SIDE: u32 = 1400;
/// The smallest level keeps at least this shorter side, pixels.
const LEAST_SIDE: u32 = 48;

/// One size of a picture.
#[derive(Clone, Debug)]
pub(crate) struct Level {
    width: usize,
    height: usize,
    data: Vec<u16>,
}

impl Level {
    /// Whether all of a box of pixels (x and y ranges) can be read.
    pub(crate) fn holds(&self, x: [f32; 2], y: [f32; 2]) -> bool {
        x[0] >= 0.5 && y[0] >= 0.5 && x[1] < self.width as f32 - 0.5 && y[1] < self.height as f32 - 0.5
    }

    /// The value at a place (the first pixel's centre is 0.5, 0.5); it has to lie inside, see [`Self::holds`].
    #[inline]
    pub(crate) fn at(&self, x: f32, y: f32) -> f32 {
        let (x, y) = (x - 0.5, y - 0.5);
        let (ix, iy) = ((x as usize).min(self.width - 2), (y as usize).min(self.height - 2));
        let (fx, fy) = (x - ix as f32, y - iy as f32);
        let row = iy * self.width + ix;
        let [a, b] = [f32::from(self.data[row]), f32::from(self.data[row + 1])];
        let [c, d] = [f32::from(self.data[row + self.width]), f32::from(self.data[row + self.width + 1])];
        let (top, bottom) = (a + (b - a) * fx, c + (d - c) * fx);
        top + (bottom - top) * fy
    }

    fn halved(&self) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let mut data = Vec::with_capacity(width * height);
        for y in 0..height {
            let rows = [&self.data[2 * y * self.width..], &self.data[(2 * y + 1) * self.width..]];
            for x in 0..width {
                let sum: u32 = rows.iter().map(|r| u32::from(r[2 * x]) + u32::from(r[2 * x + 1])).sum();
                data.push((sum / 4) as u16);
            }
        }
        Self { width, height, data }
    }

    /// 1-2-1 in both directions; the border repeats.
    fn softened(&self) -> Self {
        let (w, h) = (self.width, self.height);
        if w < 2 || h < 2 {
            return self.clone();
        }
        let mut across = vec![0u16; w * h];
        for (out, row) in across.chunks_exact_mut(w).zip(self.data.chunks_exact(w)) {
            out[0] = (3 * row[0] + row[1]) / 4;
            out[w - 1] = (3 * row[w - 1] + row[w - 2]) / 4;
            for (o, r) in out[1..].iter_mut().zip(row.windows(3)) {
                *o = (r[0] + 2 * r[1] + r[2]) / 4;
            }
        }
        let mut data = vec![0u16; w * h];
        for y in 0..h {
            let (above, below) = (y.saturating_sub(1) * w, (y + 1).min(h - 1) * w);
            for x in 0..w {
                data[y * w + x] = (across[above + x] + 2 * across[y * w + x] + across[below + x]) / 4;
            }
        }
        Self { width: w, height: h, data }
    }
}

/// A picture at its size and halved ones. Level `l` is 2^l times smaller than the take's frames.
#[derive(Clone, Debug)]
pub(crate) struct Picture {
    /// The first levels may be missing, see [`Self::finest`].
    levels: Vec<Level>,
    finest: usize,
}

impl Picture {
    /// With levels down to a small one.
    pub(crate) fn new(picture: &RgbImage) -> Self {
        let (width, height) = (picture.width() as usize, picture.height() as usize);
        // 16 × luma: 77 + 150 + 29 = 256.
        let luma = |p: &[u8]| ((77 * u32::from(p[0]) + 150 * u32::from(p[1]) + 29 * u32::from(p[2])) >> 4) as u16;
        let mut sharp = Level { width, height, data: picture.as_raw().chunks_exact(3).map(luma).collect() };
        let (mut side, mut finest) = (picture.width().max(picture.height()), 0);
        while side > MOST_SIDE {
            sharp = sharp.halved();
            side /= 2;
            finest += 1;
        }
        let mut levels = Vec::new();
        loop {
            let smaller = sharp.halved();
            levels.push(sharp.softened());
            if (smaller.width.min(smaller.height) as u32) < LEAST_SIDE || levels.len() == 5 {
                break;
            }
            sharp = smaller;
        }
        Self { levels, finest }
    }

    /// Full width and height, pixels (to a multiple of the finest level's pixels).
    pub(crate) fn size(&self) -> [u32; 2] {
        [self.levels[0].width, self.levels[0].height].map(|n| (n << self.finest) as u32)
    }

    /// The largest level there is.
    pub(crate) fn finest(&self) -> usize {
        self.finest
    }

    /// The smallest level there is.
    pub(crate) fn coarsest(&self) -> usize {
        self.finest + self.levels.len() - 1
    }

    /// A level; those that are missing are replaced by the nearest.
    pub(crate) fn level(&self, level: usize) -> &Level {
        &self.levels[level.saturating_sub(self.finest).min(self.levels.len() - 1)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ramp_is_read_exactly_between_pixels_at_every_level() {
        let ramp = RgbImage::from_fn(200, 120, |x, y| image::Rgb([(x / 2 + y / 4) as u8; 3]));
        let picture = Picture::new(&ramp);
        assert_eq!((picture.finest(), picture.coarsest()), (0, 1));
        for level in 0..=1 {
            let s = (1 << level) as f32;
            let value = picture.level(level).at(80.6 / s, 61.3 / s) / 16.0;
            // The ramp has steps of its own: x / 2 and y / 4 are rounded down.
            let exact = (80.6 - 0.5) / 2.0 + (61.3 - 0.5) / 4.0 - 0.25 - 0.375;
            assert!((value - exact).abs() < 0.3, "{level}: {value} {exact}");
        }
    }

    #[test]
    fn large_pictures_lose_their_first_levels_and_edges_are_guarded() {
        let picture = Picture::new(&RgbImage::new(3000, 100));
        assert_eq!(picture.finest(), 2);
        let level = picture.level(0);
        assert_eq!((level.width, level.height), (750, 25));
        assert!(level.holds([0.5, 700.0], [0.5, 24.0]) && !level.holds([0.4, 700.0], [0.5, 24.0]));
        assert!(!level.holds([0.5, 749.6], [0.5, 24.0]));
    }
}
