//! What the scores of a person's resting face are, and the AUs above them.
//!
//! The resting score of an AU is a quadratic of yaw and pitch. Its six coefficients are those of people in general unless
//! the video says otherwise: a least-squares fit with a Gaussian prior. Which frames show a resting face is not known;
//! an expression only adds to a score, so frames above the fit count little, and those in which nothing moves count most
//! (re-weighted until it settles). OpenFace takes the median of the whole video for the same purpose.

use nalgebra::{SMatrix, SVector};

use super::readout::Readout;
use super::{FEATURES, POSE_TERMS, UNITS, Units, pose_terms};
/// From which frames a person's rest is learned.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Calibration {
    /// All of them: the best, and what OpenFace does.
    #[default]
    WholeVideo,
    /// Those before, as a live system has to.
    Online,
}

/// A recorded score counts as this share of an independent one: neighbouring frames repeat each other.
const INDEPENDENT: f64 = 0.2;
/// A frame with so much of an expression (sum of intensities) counts half.
const ACTIVE: f64 = 3.0;
/// A score so many deviations above the fit counts half; one below it counts in full.
const ABOVE: f64 = 3.0;
/// Rounds of re-weighting.
const ROUNDS: usize = 12;
/// Frames that an online calibration keeps: half of them are dropped when it is full.
const REMEMBERED: usize = 1200;
/// Frames between two online fits.
const REFIT: usize = 30;

type Terms = SVector<f64, POSE_TERMS>;
type Normal = SMatrix<f64, POSE_TERMS, POSE_TERMS>;

/// A person's resting scores.
#[derive(Clone, Debug)]
pub struct Person {
    readout: &'static Readout,
    rest: [Terms; UNITS],
    online: Option<Memory>,
}

/// What an online calibration has seen.
#[derive(Clone, Debug)]
struct Memory {
    frames: Vec<[f32; FEATURES]>,
    seen: usize,
    step: usize,
}

impl Person {
    /// Learns a person's rest from frames of a video; online, from none yet.
    ///
    /// `readout` is what the scores were made with.
    pub fn learn(readout: &'static Readout, frames: &[[f32; FEATURES]], calibration: Calibration) -> Self {
        let mut person = Self { readout, rest: prior(readout), online: None };
        match calibration {
            Calibration::WholeVideo => person.rest = fit(readout, frames),
            Calibration::Online => person.online = Some(Memory { frames: Vec::new(), seen: 0, step: 1 }),
        }
        person
    }

    /// The AUs of a frame; an online calibration learns from it first. `None` without features.
    pub fn units(&mut self, features: &[f32]) -> Option<Units> {
        let frame = <[f32; FEATURES]>::try_from(features).ok()?;
        if let Some(memory) = &mut self.online {
            memory.push(&frame);
            if memory.seen % REFIT == 1 {
                self.rest = fit(self.readout, &memory.frames);
            }
        }
        let intensities = intensities(self.readout, &self.rest, &frame).map(|v| v as f32);
        let presences = std::array::from_fn(|j| intensities[j] >= self.readout.presence[j]);
        Some(Units { intensities, presences })
    }
}

impl Memory {
    fn push(&mut self, frame: &[f32; FEATURES]) {
        if self.seen.is_multiple_of(self.step) {
            self.frames.push(*frame);
        }
        self.seen += 1;
        if self.frames.len() == REMEMBERED {
            // Every second one, so that what is kept stays spread over all that was seen.
            let mut keep = false;
            self.frames.retain(|_| {
                keep = !keep;
                keep
            });
            self.step *= 2;
        }
    }
}

fn prior(readout: &Readout) -> [Terms; UNITS] {
    std::array::from_fn(|j| Terms::from_fn(|k, _| f64::from(readout.prior_mean[POSE_TERMS * j + k])))
}

fn terms(frame: &[f32; FEATURES]) -> Terms {
    Terms::from(pose_terms(f64::from(frame[UNITS]), f64::from(frame[UNITS + 1])))
}

/// Intensities 0–5 of a frame.
fn intensities(readout: &Readout, rest: &[Terms; UNITS], frame: &[f32; FEATURES]) -> [f64; UNITS] {
    let terms = terms(frame);
    std::array::from_fn(|j| {
        let above = f64::from(frame[j]) - rest[j].dot(&terms) - f64::from(readout.threshold[j]);
        (f64::from(readout.gain[j]) * above).clamp(0.0, 5.0)
    })
}

/// The resting scores behind frames of which some show expressions.
fn fit(readout: &Readout, frames: &[[f32; FEATURES]]) -> [Terms; UNITS] {
    let mut rest = prior(readout);
    let poses: Vec<Terms> = frames.iter().map(terms).collect();
    if frames.is_empty() {
        return rest;
    }
    // People's faces differ by more than the expressions of many videos: the first guess has to be robust on its own.
    for (j, rest) in rest.iter_mut().enumerate() {
        let mut residuals: Vec<f64> = frames.iter().zip(&poses).map(|(f, q)| f64::from(f[j]) - rest.dot(q)).collect();
        residuals.sort_unstable_by(f64::total_cmp);
        let deviation = f64::from(readout.prior_deviation[POSE_TERMS * j]);
        // A few frames are not believed: shrunk as the mean of their independent share would be.
        let trust = frames.len() as f64 * INDEPENDENT * deviation * deviation;
        let noise = f64::from(readout.noise[j]).powi(2);
        rest[0] += residuals[residuals.len() * 2 / 5] * trust / (trust + noise);
    }
    for _ in 0..ROUNDS {
        let calm: Vec<f64> = frames
            .iter()
            .map(|f| {
                // A blink is over before the rest of the face has moved.
                let sum: f64 = intensities(readout, &rest, f)[..UNITS - 1].iter().sum();
                1.0 / (1.0 + (sum / ACTIVE).powi(2))
            })
            .collect();
        let mut next = rest;
        for (j, next) in next.iter_mut().enumerate() {
            let noise = f64::from(readout.noise[j]);
            let (mut normal, mut right) = (Normal::zeros(), Terms::zeros());
            for ((frame, q), calm) in frames.iter().zip(&poses).zip(&calm) {
                let above = ((f64::from(frame[j]) - rest[j].dot(q)) / noise).max(0.0);
                let weight = INDEPENDENT * calm / (1.0 + (above / ABOVE).powi(2)) / (noise * noise);
                normal += q * q.transpose() * weight;
                right += q * (weight * f64::from(frame[j]));
            }
            for k in 0..POSE_TERMS {
                let at = POSE_TERMS * j + k;
                let precision = 1.0 / f64::from(readout.prior_deviation[at]).powi(2).max(1e-12);
                normal[(k, k)] += precision;
                right[k] += precision * f64::from(readout.prior_mean[at]);
            }
            if let Some(factor) = normal.cholesky() {
                *next = factor.solve(&right);
            }
        }
        rest = next;
    }
    rest
}

#[cfg(test)]
#[path = "person_tests.rs"]
mod tests;
