//! What the scores of a person's resting face are, and the AUs above them.
//!
//! The resting score is a line in yaw and pitch, fitted to this person alone: levels of rendered people say nothing about
//! real ones. Slopes come from a robust fit that is shrunk towards 0, the level is the median of what the slopes leave.
//! The confidence of an AU: how well its two readouts correlate over the frames that rest was learned from, how far it
//! rises in them, how well it is seen on rendered people, and how near the two readouts are in the frame itself.

use super::memory::Memory;
use super::readout::Readout;
use super::{FEATURES, PITCH, SCORES, UNITS, Units, YAW};
use crate::poses::triangulate::median;

/// From which frames a person's rest is learned.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Calibration {
    /// All of them: the best, and what OpenFace does.
    #[default]
    WholeVideo,
    /// Those before, as a live system has to.
    Online,
}

/// Variance of yaw and pitch (radians²) at which a slope is half of what least squares would have it.
const SLOPE_RIDGE: f64 = 0.002;
/// A score so many deviations above the line counts half: an expression adds to a score.
const ABOVE: f64 = 1.5;
/// The same below the line.
const BELOW: f64 = 3.0;
/// Rounds of re-weighting.
const ROUNDS: usize = 8;
/// An AU whose 99th percentile reaches this intensity has half of the evidence that its movement can give.
const HALF_MOVED: f64 = 0.5;
/// How much a difference between the readouts, relative to 1 + intensity, lowers the confidence of a frame.
const APART: f64 = 0.25;
/// Deviation of normal noise over the median of its absolute value.
const DEVIATION_OF_MEDIAN: f64 = 1.4826;

/// Resting scores of a person who looks into the camera, and how they change with yaw and pitch.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Line {
    level: f64,
    slopes: [f64; 2],
}

impl Line {
    fn at(&self, [yaw, pitch]: [f64; 2]) -> f64 {
        self.level + self.slopes[0] * yaw + self.slopes[1] * pitch
    }
}

/// A person's resting scores.
#[derive(Clone, Debug)]
pub struct Person {
    readout: &'static Readout,
    rest: Option<Rest>,
    online: Option<Memory<[f32; FEATURES]>>,
}

/// What is learned from a set of frames.
#[derive(Clone, Debug)]
struct Rest {
    lines: [Line; SCORES],
    /// How much the frames say for each AU, 0–1.
    evidence: [f64; UNITS],
}

impl Person {
    /// Learns a person's rest from frames of a video; online, from none yet.
    ///
    /// `readout` is what the scores were made with.
    pub fn learn(readout: &'static Readout, frames: &[[f32; FEATURES]], calibration: Calibration) -> Self {
        match calibration {
            Calibration::WholeVideo => Self { readout, rest: Rest::learn(readout, frames), online: None },
            Calibration::Online => Self { readout, rest: None, online: Some(Memory::default()) },
        }
    }

    /// The AUs of a frame; an online calibration learns from it first. `None` without features or any frame of rest.
    pub fn units(&mut self, features: &[f32]) -> Option<Units> {
        let frame = <[f32; FEATURES]>::try_from(features).ok()?;
        if let Some(memory) = &mut self.online {
            memory.push(frame);
            if memory.is_due() {
                self.rest = Rest::learn(self.readout, memory.frames());
            }
        }
        let rest = self.rest.as_ref()?;
        let [skin, points] = rest.above(&frame);
        let intensities: [f64; UNITS] =
            std::array::from_fn(|j| mixed(self.readout, j, skin[j], points[j]).clamp(0.0, 5.0));
        let confidences = std::array::from_fn(|j| {
            let apart = (skin[j] - points[j]) / (1.0 + intensities[j]);
            (rest.evidence[j] / (1.0 + APART * apart * apart)) as f32
        });
        let intensities = intensities.map(|v| v as f32);
        let presences = std::array::from_fn(|j| intensities[j] >= self.readout.presence[j]);
        Some(Units { intensities, presences, confidences })
    }
}

/// The AU of two scores above rest, not yet clamped.
fn mixed(readout: &Readout, j: usize, skin: f64, points: f64) -> f64 {
    let share = f64::from(readout.share[j]);
    f64::from(readout.gain[j]) * (share * skin + (1.0 - share) * points)
}

/// How much a clip says for an AU: whether its readouts agree, whether it moves, and how well it is seen in general.
fn evidence(readout: &Readout, j: usize, above: &[[[f64; UNITS]; 2]]) -> f64 {
    let part = |i: usize| above.iter().map(move |a| a[i][j].clamp(-1.0, 5.0));
    let agreement = correlation(part(0), part(1)).max(0.0);
    let mut intensities: Vec<f64> = above.iter().map(|a| mixed(readout, j, a[0][j], a[1][j]).clamp(0.0, 5.0)).collect();
    let at = intensities.len() * 99 / 100;
    let peak = intensities.select_nth_unstable_by(at, f64::total_cmp).1;
    (agreement * f64::from(readout.reliability[j])).sqrt() * *peak / (*peak + HALF_MOVED)
}

fn pose(frame: &[f32; FEATURES]) -> [f64; 2] {
    [f64::from(frame[YAW]), f64::from(frame[PITCH])]
}

impl Rest {
    /// `None` without frames.
    fn learn(readout: &Readout, frames: &[[f32; FEATURES]]) -> Option<Self> {
        let poses: Vec<[f64; 2]> = frames.iter().map(pose).collect();
        let middle = [0, 1].map(|axis| poses.iter().map(|p| p[axis]).collect::<Vec<_>>());
        let [yaw, pitch] = middle.map(|mut values| median(&mut values));
        let middle = [yaw?, pitch?];
        let lines = std::array::from_fn(|k| {
            let scores: Vec<f64> = frames.iter().map(|f| f64::from(f[k])).collect();
            line(&scores, &poses, middle)
        });
        let mut rest = Self { lines, evidence: [0.0; UNITS] };
        let above: Vec<[[f64; UNITS]; 2]> = frames.iter().map(|f| rest.above(f)).collect();
        rest.evidence = std::array::from_fn(|j| evidence(readout, j, &above));
        Some(rest)
    }

    /// Both scores of each AU above rest.
    fn above(&self, frame: &[f32; FEATURES]) -> [[f64; UNITS]; 2] {
        let pose = pose(frame);
        let above = |k: usize| f64::from(frame[k]) - self.lines[k].at(pose);
        [std::array::from_fn(above), std::array::from_fn(|j| above(UNITS + j))]
    }
}

/// The line behind scores of which some are raised by expressions.
fn line(scores: &[f64], poses: &[[f64; 2]], middle: [f64; 2]) -> Line {
    let turned: Vec<[f64; 2]> = poses.iter().map(|p| [p[0] - middle[0], p[1] - middle[1]]).collect();
    let mut buffer = scores.to_vec();
    let Some(mut level) = median(&mut buffer) else { return Line::default() };
    let mut slopes = [0.0; 2];
    let ridge = SLOPE_RIDGE * scores.len() as f64;
    for _ in 0..ROUNDS {
        let residual = |i: usize, slopes: [f64; 2]| scores[i] - slopes[0] * turned[i][0] - slopes[1] * turned[i][1];
        for (i, slot) in buffer.iter_mut().enumerate() {
            *slot = (residual(i, slopes) - level).abs();
        }
        let deviation = DEVIATION_OF_MEDIAN * median(&mut buffer).unwrap_or(0.0) + 1e-6;
        let (mut xx, mut xy, mut yy, mut right) = (ridge, 0.0, ridge, [0.0; 2]);
        for (i, [x, y]) in turned.iter().enumerate() {
            let above = (residual(i, slopes) - level) / deviation;
            let weight = 1.0 / (1.0 + (above / if above > 0.0 { ABOVE } else { BELOW }).powi(2));
            xx += weight * x * x;
            xy += weight * x * y;
            yy += weight * y * y;
            right[0] += weight * x * (scores[i] - level);
            right[1] += weight * y * (scores[i] - level);
        }
        let determinant = xx * yy - xy * xy;
        slopes = [(right[0] * yy - right[1] * xy) / determinant, (right[1] * xx - right[0] * xy) / determinant];
        for (i, slot) in buffer.iter_mut().enumerate() {
            *slot = residual(i, slopes);
        }
        level = median(&mut buffer).unwrap_or(level);
    }
    Line { level: level - slopes[0] * middle[0] - slopes[1] * middle[1], slopes }
}

/// Pearson's r; 0 where nothing varies.
fn correlation(a: impl Iterator<Item = f64> + Clone, b: impl Iterator<Item = f64> + Clone) -> f64 {
    let count = a.clone().count().max(1) as f64;
    let (ma, mb) = (a.clone().sum::<f64>() / count, b.clone().sum::<f64>() / count);
    let (mut aa, mut ab, mut bb) = (0.0, 0.0, 0.0);
    for (a, b) in a.zip(b) {
        aa += (a - ma) * (a - ma);
        ab += (a - ma) * (b - mb);
        bb += (b - mb) * (b - mb);
    }
    if aa * bb > 0.0 { ab / (aa * bb).sqrt() } else { 0.0 }
}

#[cfg(test)]
#[path = "person_tests.rs"]
mod tests;
