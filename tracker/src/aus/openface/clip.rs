//! What depends on the whole clip: the person's median of x, the quantile that is rest, and means over neighbouring frames.
//!
//! y = x·w + constant − median·w (dynamic ones), minus the value at the cut-off quantile of the clip, clamped to 0–5, mean of
//! three frames; presences are means of seven frames of at least one half. The median is that of a histogram over every
//! second frame, as OpenFace's; it serves all frames, where OpenFace leaves those after the 3,000th at the median so far.

use risorius_formats::au::OPENFACE_INTENSITIES;

use super::predictors::{Predictor, Predictors, Purpose};
use super::{HOG_NUMBERS, OpenFaceModels};
use crate::aus::UNITS;
use crate::error::Result;

/// Range and bins of the histogram of a FHOG number.
const HOG_BINS: Bins = Bins { low: -0.005, high: 1.0, count: 1000 };
/// Range and bins of the histogram of a displacement or coefficient.
const SHAPE_BINS: Bins = Bins { low: -60.0, high: 60.0, count: 10_000 };
/// Neighbours on each side in the mean of an intensity.
const INTENSITY_REACH: usize = 1;
/// Neighbours on each side in the mean of a presence.
const PRESENCE_REACH: usize = 3;

#[derive(Clone, Copy, Debug)]
struct Bins {
    low: f64,
    high: f64,
    count: usize,
}

impl Bins {
    fn width(&self) -> f64 {
        (self.high - self.low) / self.count as f64
    }

    fn bin(&self, value: f64) -> usize {
        ((value - self.low) / self.width()).clamp(0.0, (self.count - 1) as f64) as usize
    }

    /// The middle of the first bin up to which half of the values lie.
    fn median(&self, histogram: &[u32], values: u32) -> f64 {
        let half = values.div_ceil(2);
        let mut sum = 0;
        let reached = |n: &u32| {
            sum += n;
            sum >= half
        };
        let bin = histogram.iter().position(reached).unwrap_or(0);
        self.low + (bin as f64 + 0.5) * self.width()
    }
}

/// Histograms of x over a clip, and x·w of each frame.
#[derive(Debug)]
pub struct ClipStatistics<'a> {
    predictors: &'a Predictors,
    hog: Vec<u32>,
    shape: Vec<u32>,
    frames: u32,
    counted: u32,
}

impl<'a> ClipStatistics<'a> {
    /// Of a clip that is yet to come.
    pub fn new(models: &'a OpenFaceModels) -> Self {
        Self::of(&models.predictors, models.numbers())
    }

    fn of(predictors: &'a Predictors, numbers: usize) -> Self {
        let shape = numbers - HOG_NUMBERS;
        Self {
            predictors,
            hog: vec![0; HOG_NUMBERS * HOG_BINS.count],
            shape: vec![0; shape * SHAPE_BINS.count],
            frames: 0,
            counted: 0,
        }
    }

    /// Takes x of the next frame, `None` where there is no face, and gives x·w of each predictor.
    pub fn push(&mut self, x: Option<&[f32]>) -> Option<Vec<f32>> {
        self.frames += 1;
        let x = x?;
        if self.frames % 2 == 1 {
            let (hog, shape) = x.split_at(HOG_NUMBERS.min(x.len()));
            count(&mut self.hog, HOG_BINS, hog);
            count(&mut self.shape, SHAPE_BINS, shape);
            self.counted += 1;
        }
        Some(self.predictors.products(x))
    }

    /// How many numbers [`Self::push`] gives.
    pub fn products(&self) -> usize {
        self.predictors.len()
    }

    /// The AUs of the clip from x·w of each frame in its order, `None` where there is no face.
    pub fn aus(&self, products: impl Iterator<Item = Result<Option<Vec<f32>>>>) -> Result<ClipAus> {
        ClipAus::learn(self.predictors, &self.medians(), products)
    }

    /// The median of each number of x.
    pub fn medians(&self) -> Vec<f32> {
        let of = |histograms: &[u32], bins: Bins| {
            histograms.chunks_exact(bins.count).map(|h| bins.median(h, self.counted)).collect::<Vec<f64>>()
        };
        // A histogram that begins below 0 gives a median below 0 where a number is 0.
        let hog = of(&self.hog, HOG_BINS).into_iter().map(|v| v.max(0.0));
        hog.chain(of(&self.shape, SHAPE_BINS)).map(|v| v as f32).collect()
    }
}

fn count(histograms: &mut [u32], bins: Bins, values: &[f32]) {
    for (histogram, value) in histograms.chunks_exact_mut(bins.count).zip(values) {
        histogram[bins.bin(f64::from(*value))] += 1;
    }
}

/// Intensities and presences of one frame, in the order of [`OPENFACE_INTENSITIES`]; `None` where no model gives them.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FrameAus {
    /// 0–5.
    pub intensities: [Option<f32>; UNITS],
    /// Whether the AU is there.
    pub presences: [Option<bool>; UNITS],
}

/// The AUs of every frame of a clip.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ClipAus {
    frames: Vec<FrameAus>,
}

impl ClipAus {
    /// From x·w of each frame in its order, `None` where there is no face.
    pub fn learn(
        predictors: &Predictors,
        medians: &[f32],
        products: impl Iterator<Item = Result<Option<Vec<f32>>>>,
    ) -> Result<Self> {
        let mut curves: Vec<Vec<Option<f64>>> = vec![Vec::new(); predictors.len()];
        for products in products {
            let products = products?;
            for (k, curve) in curves.iter_mut().enumerate() {
                curve.push(products.as_ref().and_then(|p| p.get(k)).map(|v| f64::from(*v)));
            }
        }
        let mut frames = vec![FrameAus::default(); curves.first().map_or(0, Vec::len)];
        for (predictor, curve) in predictors.0.iter().zip(curves) {
            let Some(slot) = OPENFACE_INTENSITIES.iter().position(|u| *u == predictor.unit) else { continue };
            let values = above_rest(predictor, medians, &curve);
            match predictor.purpose {
                Purpose::Intensity { .. } => {
                    let clamped: Vec<_> = values.iter().map(|v| v.map(|v| v.clamp(0.0, 5.0))).collect();
                    for (frame, value) in frames.iter_mut().zip(means(&clamped, INTENSITY_REACH)) {
                        frame.intensities[slot] = value.map(|v| v as f32);
                    }
                }
                Purpose::Presence { positive, negative } => {
                    let votes: Vec<_> =
                        values.iter().map(|v| v.map(|v| if v > 0.0 { positive } else { negative })).collect();
                    for (frame, value) in frames.iter_mut().zip(means(&votes, PRESENCE_REACH)) {
                        frame.presences[slot] = value.map(|v| v >= 0.5);
                    }
                }
            }
        }
        Ok(Self { frames })
    }

    /// The AUs of a frame.
    pub fn get(&self, frame: usize) -> Option<&FrameAus> {
        self.frames.get(frame)
    }
}

/// y of each frame, less its value at rest.
fn above_rest(predictor: &Predictor, medians: &[f32], products: &[Option<f64>]) -> Vec<Option<f64>> {
    let median = if predictor.is_dynamic { predictor.product(medians) } else { 0.0 };
    let values: Vec<Option<f64>> = products.iter().map(|v| v.map(|v| v - median + predictor.constant)).collect();
    let Purpose::Intensity { cutoff: Some(cutoff) } = predictor.purpose else { return values };
    let mut known: Vec<f64> = values.iter().flatten().copied().collect();
    known.sort_unstable_by(f64::total_cmp);
    let at = ((known.len() as f64 * cutoff) as usize).min(known.len().saturating_sub(1));
    let rest = known.get(at).copied().unwrap_or(0.0);
    values.into_iter().map(|v| v.map(|v| v - rest)).collect()
}

/// The mean of each value with those up to `reach` before and after it; the first and last stay as they are, as OpenFace's.
fn means(values: &[Option<f64>], reach: usize) -> Vec<Option<f64>> {
    let mean = |i: usize| {
        let here = values[i]?;
        if i < reach || i + reach >= values.len() {
            return Some(here);
        }
        let around = values[i - reach..=i + reach].iter().flatten();
        Some(around.clone().sum::<f64>() / around.count() as f64)
    };
    (0..values.len()).map(mean).collect()
}

#[cfg(test)]
#[path = "clip_tests.rs"]
mod tests;
