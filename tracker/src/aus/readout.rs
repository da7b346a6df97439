//! The linear part of the AU regressor.

use risorius_formats::Similarity;

use super::{FEATURES, UNITS};
use crate::run::mesh::{MESH_POINTS, Mesh};

/// Numbers of the aligned mesh.
pub const MESH_NUMBERS: usize = 3 * MESH_POINTS;

/// Weights of one kind of input: 8-bit integers, each row (AU) with its own scale.
#[derive(Clone, Debug, PartialEq)]
pub struct Part {
    /// One row for each AU.
    pub weights: Vec<i8>,
    /// What a weight's unit is worth in each row.
    pub scales: Vec<f32>,
}

/// A readout and the numbers that turn its scores into AUs.
#[derive(Clone, Debug, PartialEq)]
pub struct Readout {
    /// For the mesh, the blendshapes and the inner maps, as far as this readout needs them.
    pub parts: Vec<Part>,
    /// Intensity per score above rest, by AU.
    pub gain: Vec<f32>,
    /// Score above rest at which an AU begins, by AU.
    pub threshold: Vec<f32>,
    /// Intensity at which an AU counts as present, by AU.
    pub presence: Vec<f32>,
    /// Mean over people of the resting score's pose terms, AU by AU.
    pub prior_mean: Vec<f32>,
    /// How people differ in them.
    pub prior_deviation: Vec<f32>,
    /// Deviation of a resting person's scores from the fit, by AU.
    pub noise: Vec<f32>,
}

impl Readout {
    /// The score of each AU; one input for each part, of the length its rows have.
    pub fn scores(&self, inputs: &[&[f32]]) -> Option<[f32; UNITS]> {
        if inputs.len() != self.parts.len() {
            return None;
        }
        let mut scores = [0.0; UNITS];
        for (part, input) in self.parts.iter().zip(inputs) {
            if part.weights.len() != UNITS * input.len() {
                return None;
            }
            for ((score, row), scale) in scores.iter_mut().zip(part.weights.chunks_exact(input.len())).zip(&part.scales)
            {
                *score += scale * dot(row, input);
            }
        }
        Some(scores)
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
pub fn features(scores: &[f32; UNITS], canonical_from_picture: &Similarity) -> [f32; FEATURES] {
    let toward = canonical_from_picture.rotation.row(2);
    let mut out = [0.0; FEATURES];
    out[..UNITS].copy_from_slice(scores);
    out[UNITS] = toward.x.atan2(toward.z) as f32;
    out[UNITS + 1] = (-toward.y).clamp(-1.0, 1.0).asin() as f32;
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
        let part = Part { weights: vec![1; UNITS * 4], scales: vec![0.5; UNITS] };
        let numbers = vec![0.0; UNITS];
        let readout = Readout {
            parts: vec![part],
            gain: numbers.clone(),
            threshold: numbers.clone(),
            presence: numbers.clone(),
            prior_mean: vec![],
            prior_deviation: vec![],
            noise: numbers,
        };
        assert_eq!(readout.scores(&[&[1.0, 2.0, 3.0, 4.0]]), Some([5.0; UNITS]));
        assert_eq!(readout.scores(&[&[1.0, 2.0]]), None);
        assert_eq!(readout.scores(&[]), None);
    }
}
