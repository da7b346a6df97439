//! The picture behind a head that moves before a still camera: per pixel, the median of the frames that do not show
//! the head there.

use image::RgbImage;
use rayon::prelude::*;
use risorius_formats::pose_report::PoseMethod;

use crate::data::{TrainData, TrainFrame};

/// Levels by which a pixel has to differ from the plate to show something else: above the noise of a codec.
const DIFFERS: u8 = 12;

/// A picture of what is behind the head, at the scale that is fitted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Plate {
    /// Pixels along a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// RGB bytes.
    pub rgb: Vec<u8>,
}

impl Plate {
    /// The plate of a dataset whose poses came from the head; `None` for others.
    pub fn of(data: &TrainData) -> Option<Self> {
        let extras = data.extras()?;
        if extras.method != PoseMethod::Head || data.frames.iter().any(|f| f.valid.is_none()) {
            return None;
        }
        let (width, height) = (data.frames[0].camera.intrinsics.width, data.frames[0].camera.intrinsics.height);
        let count = width as usize * height as usize;
        let frames: Vec<_> =
            data.frames.iter().filter(|f| f.camera.intrinsics.width == width && f.pixels.len() == count * 3).collect();
        let shows_head = |frame: &TrainFrame, i: usize| frame.valid.as_ref().is_some_and(|v| v[i] > 0);
        let medians: Vec<Option<[u8; 3]>> = (0..count)
            .into_par_iter()
            .map(|i| {
                let mut seen: [Vec<u8>; 3] = Default::default();
                for frame in frames.iter().filter(|f| !shows_head(f, i)) {
                    (0..3).for_each(|c| seen[c].push(frame.pixels[i * 3 + c]));
                }
                // A few frames are no median: what the hull misses of the head would shine through.
                (seen[0].len() * 20 >= frames.len()).then(|| {
                    seen.map(|mut values| {
                        let middle = values.len() / 2;
                        *values.select_nth_unstable(middle).1
                    })
                })
            })
            .collect();
        Some(Self { width, height, rgb: fill(&medians, width as usize, height as usize) })
    }
}

impl Plate {
    /// What a frame shows of the person: the hull of the head, and all that differs from the plate; a byte per pixel, 255 or 0.
    ///
    /// `None` where the frame has another size.
    pub fn person(&self, frame: &TrainFrame) -> Option<Vec<u8>> {
        let hull = frame.valid.as_ref()?;
        let same = frame.pixels.len() == self.rgb.len() && hull.len() * 3 == self.rgb.len();
        let pixels = || frame.pixels.as_chunks::<3>().0.iter().zip(self.rgb.as_chunks::<3>().0);
        let differs = |(a, b): (&[u8; 3], &[u8; 3])| a.iter().zip(b).any(|(a, b)| a.abs_diff(*b) > DIFFERS);
        same.then(|| {
            hull.iter().zip(pixels()).map(|(&inside, pair)| if inside > 0 || differs(pair) { 255 } else { 0 }).collect()
        })
    }

    /// The plate at another size: RGB bytes.
    pub fn resized(&self, width: u32, height: u32) -> Vec<u8> {
        if (width, height) == (self.width, self.height) {
            return self.rgb.clone();
        }
        let picture = RgbImage::from_raw(self.width, self.height, self.rgb.clone()).unwrap_or_default();
        image::imageops::resize(&picture, width, height, image::imageops::FilterType::Triangle).into_raw()
    }
}

/// Spreads known pixels over unknown ones, ring by ring.
fn fill(known: &[Option<[u8; 3]>], width: usize, height: usize) -> Vec<u8> {
    let mut pixels = known.to_vec();
    let mut open: Vec<usize> = (0..pixels.len()).filter(|&i| pixels[i].is_none()).collect();
    while !open.is_empty() {
        let before = pixels.clone();
        open.retain(|&i| {
            let (x, y) = (i % width, i / width);
            let mut sum = [0u32; 3];
            let mut n = 0;
            for (nx, ny) in [(x.wrapping_sub(1), y), (x + 1, y), (x, y.wrapping_sub(1)), (x, y + 1)] {
                if nx < width
                    && ny < height
                    && let Some(rgb) = before[ny * width + nx]
                {
                    (0..3).for_each(|c| sum[c] += u32::from(rgb[c]));
                    n += 1;
                }
            }
            if n > 0 {
                pixels[i] = Some(sum.map(|s| (s / n) as u8));
            }
            n == 0
        });
        if before == pixels {
            break;
        }
    }
    pixels.into_iter().flat_map(|p| p.unwrap_or([128; 3])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn holes_take_their_neighbours_colour() {
        let known = [Some([10, 0, 0]), None, None, Some([30, 0, 0])];
        assert_eq!(fill(&known, 4, 1), [10, 0, 0, 10, 0, 0, 30, 0, 0, 30, 0, 0]);
        assert_eq!(fill(&[None, None], 2, 1), [128; 6]);
    }
}
