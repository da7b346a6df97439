//! The linear part of the AU regressor: from one frame's inputs to two scores for each AU.

use risorius_formats::Similarity;

use super::{FEATURES, PITCH, UNITS, YAW};
use crate::run::mesh::{MESH_POINTS, Mesh};

/// Numbers of the aligned mesh.
pub const MESH_NUMBERS: usize = 3 * MESH_POINTS;

/// Weights of one kind of input: 8-bit integers, each row (AU) with its own scale.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Part {
    /// One row for each AU; none at all where the readout does without this input.
    pub weights: Vec<i8>,
    /// What a weight's unit is worth in each row.
    pub scales: Vec<f32>,
}

/// What a readout reads of one frame; an input that it does without is ignored.
#[derive(Clone, Copy, Debug)]
pub struct Inputs<'a> {
    /// [`super::fhog`] of the aligned face.
    pub fhog: &'a [f32],
    /// The aligned mesh.
    pub mesh: &'a [f32],
    /// Coefficients of the blendshape network.
    pub blendshapes: &'a [f32],
    /// The landmark network's 16×16 map, where it sees the face.
    pub inner16: &'a [f32],
}

/// Two linear readouts that do not share an input, and the numbers that make one AU of both.
///
/// Their scores are in units of intensity. The AU is the mean of both, `share` of it from the skin; how far they agree
/// says how sure it is.
#[derive(Clone, Debug, PartialEq)]
pub struct Readout {
    /// Reads the FHOG of the skin.
    pub skin: Part,
    /// Read together, beside the skin: mesh, blendshapes, inner map.
    pub points: [Part; 3],
    /// Share of the skin's score in each AU, 0–1.
    pub share: Vec<f32>,
    /// Intensity per mixed score above rest, by AU.
    pub gain: Vec<f32>,
    /// Intensity at which an AU counts as present, by AU.
    pub presence: Vec<f32>,
    /// Agreement with the truth on rendered people nobody trained on, r by AU.
    pub reliability: Vec<f32>,
}

/// Scores of one frame: those of the skin, then those of the points.
pub type Scores = [f32; 2 * UNITS];

impl Readout {
    /// The scores of a frame; `None` where an input has another length than its rows, or is not finite.
    pub fn scores(&self, inputs: &Inputs) -> Option<Scores> {
        let mut scores = [0.0; 2 * UNITS];
        let (skin, points) = scores.split_at_mut(UNITS);
        self.skin.add(inputs.fhog, skin)?;
        for (part, input) in self.points.iter().zip([inputs.mesh, inputs.blendshapes, inputs.inner16]) {
            part.add(input, points)?;
        }
        scores.iter().all(|v| v.is_finite()).then_some(scores)
    }
}

impl Part {
    /// Adds the product with an input to the scores.
    fn add(&self, input: &[f32], scores: &mut [f32]) -> Option<()> {
        if self.weights.is_empty() {
            return Some(());
        }
        if self.weights.len() != UNITS * input.len() || self.scales.len() != UNITS {
            return None;
        }
        for ((score, row), scale) in scores.iter_mut().zip(self.weights.chunks_exact(input.len())).zip(&self.scales) {
            *score += scale * dot(row, input);
        }
        Some(())
    }
}

/// Sixteen sums at once, in a fixed order: the compiler makes vector code of it, and the result is the same everywhere.
fn dot(weights: &[i8], input: &[f32]) -> f32 {
    const LANES: usize = 16;
    let mut sums = [0.0f32; LANES];
    let (w, x) = (weights.chunks_exact(LANES), input.chunks_exact(LANES));
    let rest: f32 = w.remainder().iter().zip(x.remainder()).map(|(w, x)| f32::from(*w) * x).sum();
    for (w, x) in w.zip(x) {
        for i in 0..LANES {
            sums[i] += f32::from(w[i]) * x[i];
        }
    }
    sums.iter().sum::<f32>() + rest
}

/// The mesh in the canonical frame: x, y, z of each point.
pub fn aligned(mesh: &Mesh, canonical_from_picture: &Similarity) -> Vec<f32> {
    let point = |p: &[f32; 3]| canonical_from_picture.transform_point(glam::DVec3::from(p.map(f64::from)));
    mesh.iter().map(point).flat_map(|p| [p.x as f32, p.y as f32, p.z as f32]).collect()
}

/// What is kept of a frame: the scores, yaw and pitch of the head against the camera, radians.
pub fn features(scores: &Scores, canonical_from_picture: &Similarity) -> [f32; FEATURES] {
    let toward = canonical_from_picture.rotation.row(2);
    let mut out = [0.0; FEATURES];
    out[..scores.len()].copy_from_slice(scores);
    out[YAW] = toward.x.atan2(toward.z) as f32;
    out[PITCH] = (-toward.y).clamp(-1.0, 1.0).asin() as f32;
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fast_product_is_the_plain_one() {
        for length in [0, 1, 15, 16, 17, 100, 1434] {
            let weights: Vec<i8> = (0..length).map(|i| ((i * 37) % 255) as i8).collect();
            let input: Vec<f32> = (0..length).map(|i| ((i * 13) % 29) as f32 * 0.1 - 1.0).collect();
            let plain: f64 = weights.iter().zip(&input).map(|(w, x)| f64::from(*w) * f64::from(*x)).sum();
            assert!((f64::from(dot(&weights, &input)) - plain).abs() < 1e-3 * (1.0 + plain.abs()), "{length}");
        }
    }

    #[test]
    fn inputs_of_another_size_have_no_scores() {
        let part = |length: usize| Part { weights: vec![1; UNITS * length], scales: vec![0.5; UNITS] };
        let numbers = vec![0.0; UNITS];
        let readout = Readout {
            skin: part(4),
            points: [part(2), Part::default(), part(1)],
            share: numbers.clone(),
            gain: numbers.clone(),
            presence: numbers.clone(),
            reliability: numbers,
        };
        let inputs = Inputs { fhog: &[1.0, 2.0, 3.0, 4.0], mesh: &[2.0, 2.0], blendshapes: &[7.0], inner16: &[1.0] };
        let scores = readout.scores(&inputs).unwrap();
        assert_eq!((scores[0], scores[UNITS], scores[2 * UNITS - 1]), (5.0, 2.5, 2.5));
        assert_eq!(readout.scores(&Inputs { mesh: &[1.0], ..inputs }), None);
        assert_eq!(readout.scores(&Inputs { inner16: &[f32::NAN], ..inputs }), None);
    }
}
