//! What belongs to single images: α and β of eq. 17, latent codes, poses.

use glam::DVec3;
use rand::Rng;
use risorius_formats::Isometry;

use crate::model::LATENT;
use crate::scene::rotation_from_vector;
use crate::update::Whole;

/// Least log β.
const LOG_BETA_FLOOR: f32 = -4.0;
/// Codes begin with numbers up to this.
const FIRST_CODE: f32 = 0.1;
/// Adam's ε for these numbers.
const EPSILON: f32 = 1e-8;

/// Numbers of each training image: its AU offsets (α), uncertainties (log β), latent code, head and camera corrections.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PerImage {
    /// `[images][AUs]`, added to the annotated attributes (−1..1).
    pub alphas: Vec<f32>,
    /// `[images][AUs]`.
    pub log_betas: Vec<f32>,
    /// `[images][LATENT]`.
    pub codes: Vec<f32>,
    /// `[images][6]`: translation (metres) and rotation vector (radians) of the head against its first pose.
    pub head_motions: Vec<f32>,
    /// `[images][6]`: the same of the camera, in camera axes.
    pub camera_motions: Vec<f32>,
    /// Moments of all of these, in this order, first and second.
    pub(super) moments: Vec<f32>,
    /// Steps of each image.
    pub(super) steps: Vec<f32>,
}

/// Rates and weights of a step.
#[derive(Clone, Copy, Debug)]
pub(super) struct ImageRates {
    pub image: f32,
    pub code: f32,
    /// Translation and rotation; zero where poses stay.
    pub head: [f32; 2],
    pub camera: [f32; 2],
    /// Weight of eq. 17 per AU.
    pub attribute: f32,
    /// Weight of ‖ω‖².
    pub latent: f32,
}

impl PerImage {
    /// Nothing but small codes, drawn from `rng`: were they zero, they and the deltas that they weigh would have no gradient.
    pub(super) fn new(images: usize, aus: usize, rng: &mut impl Rng) -> Self {
        let mut out = Self::zero(images, aus);
        out.codes.fill_with(|| rng.random_range(-FIRST_CODE..FIRST_CODE));
        out
    }

    /// Numbers that change nothing.
    pub(super) fn zero(images: usize, aus: usize) -> Self {
        let mut out = Self {
            alphas: vec![0.0; images * aus],
            log_betas: vec![-1.0; images * aus],
            codes: vec![0.0; images * LATENT],
            head_motions: vec![0.0; images * 6],
            camera_motions: vec![0.0; images * 6],
            moments: Vec::new(),
            steps: vec![0.0; images],
        };
        let total = 2 * out.alphas.len() + out.codes.len() + 2 * out.head_motions.len();
        out.moments = vec![0.0; 2 * total];
        out
    }

    /// The code of an image.
    pub fn code(&self, image: usize) -> &[f32] {
        self.codes.get(image * LATENT..(image + 1) * LATENT).unwrap_or_default()
    }

    /// The correction of an image's camera: `corrected_from_given`, camera axes.
    pub fn camera_motion(&self, image: usize) -> Isometry {
        motion(self.camera_motions.get(image * 6..image * 6 + 6).unwrap_or_default())
    }

    /// The correction of the head's pose, room axes about the origin.
    pub fn head_motion(&self, image: usize) -> Isometry {
        motion(self.head_motions.get(image * 6..image * 6 + 6).unwrap_or_default())
    }

    /// One step of image `image`. `activations` are ∂L/∂activation of its AUs (`None` without annotation) and of its code
    /// (`None` where it did not act); `turn_to_room` brings vectors of camera axes to room axes. Returns Σ of eq. 17.
    pub(super) fn step(
        &mut self,
        image: usize,
        activations: (Option<&[f32]>, Option<&[f32]>),
        whole: &Whole,
        room_from_camera: &glam::DMat3,
        rates: &ImageRates,
    ) -> f64 {
        self.steps[image] += 1.0;
        let correction = (1.0 - 0.99f32.powf(self.steps[image])).sqrt() / (1.0 - 0.9f32.powf(self.steps[image]));
        let mut eq17 = 0.0;
        let mut offset = 0;
        let total = self.moments.len() / 2;
        let (first, second) = self.moments.split_at_mut(total);
        let mut adam = |values: &mut [f32], at: usize, gradient: f32, rate: f32, offset: usize| {
            if rate == 0.0 || !gradient.is_finite() {
                return;
            }
            let (m, v) = (&mut first[offset + at], &mut second[offset + at]);
            *m += 0.1 * (gradient - *m);
            *v += 0.01 * (gradient * gradient - *v);
            values[at] -= rate * correction * *m / (v.sqrt() + EPSILON);
        };
        let aus = self.alphas.len() / self.steps.len().max(1);
        if let Some(d) = activations.0 {
            for (k, d) in d.iter().enumerate() {
                let at = image * aus + k;
                let log_beta = self.log_betas[at].max(LOG_BETA_FLOOR);
                let delta = self.alphas[at];
                let precise = (delta * (-log_beta).exp()).powi(2);
                eq17 += f64::from(0.5 * (precise + log_beta * log_beta));
                // An activation is half an attribute.
                let gradient = 0.5 * d + rates.attribute * delta * (-2.0 * log_beta).exp();
                adam(&mut self.alphas, at, gradient, rates.image, offset);
                let gradient = rates.attribute * (log_beta - precise);
                adam(&mut self.log_betas, at, gradient, rates.image, offset + self.steps.len() * aus);
            }
        }
        offset += 2 * self.alphas.len();
        if let Some(d) = activations.1 {
            for (j, d) in d.iter().enumerate() {
                let at = image * LATENT + j;
                let gradient = d + 2.0 * rates.latent * self.codes[at];
                adam(&mut self.codes, at, gradient, rates.code, offset);
            }
        }
        offset += self.codes.len();
        let to_room = |v: &[f32]| (*room_from_camera * DVec3::new(v[0].into(), v[1].into(), v[2].into())).as_vec3();
        let head = [to_room(&whole.head[..3]), to_room(&whole.head[3..])];
        for i in 0..6 {
            let at = image * 6 + i;
            adam(&mut self.head_motions, at, head[i / 3][i % 3], rates.head[i / 3], offset);
            let offset = offset + self.steps.len() * 6;
            adam(&mut self.camera_motions, at, whole.camera[i], rates.camera[i / 3], offset);
        }
        eq17
    }
}

/// A small rigid motion from a translation and a rotation vector.
fn motion(v: &[f32]) -> Isometry {
    let [x, y, z, rx, ry, rz] = std::array::from_fn(|i| v.get(i).copied().map_or(0.0, f64::from));
    Isometry::new(rotation_from_vector(DVec3::new(rx, ry, rz)), DVec3::new(x, y, z))
}
