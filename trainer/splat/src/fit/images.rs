//! What belongs to single images: α and β of eq. 17, latent codes, poses.

use glam::DVec3;
use rand::Rng;
use risorius_formats::Isometry;

use super::pose::{Look, newton};
use crate::model::LATENT;
use crate::scene::rotation_from_vector;
use crate::update::Whole;

/// Least log β.
const LOG_BETA_FLOOR: f32 = -4.0;
/// Codes begin with numbers up to this.
const FIRST_CODE: f32 = 0.1;
/// Curvature of the logarithm of a gain about 0, per pixel: what holds it where pictures are black.
const LIGHT_PRIOR: f64 = 0.01;
/// Most that the logarithm of a gain moves in a step.
const MOST_LIGHT: f32 = 0.2;
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
    /// `[images][3]`: logarithms of the gains of red, green and blue; their mean over the images is 0.
    pub log_gains: Vec<f32>,
    /// Moments of α, log β and codes, in this order, first and second.
    pub(super) moments: Vec<f32>,
    /// Steps of each image.
    pub(super) steps: Vec<f32>,
}

/// Rates and weights of a step.
#[derive(Clone, Copy, Debug)]
pub(super) struct ImageRates {
    pub image: f32,
    pub code: f32,
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
            log_gains: vec![0.0; images * 3],
            moments: Vec::new(),
            steps: vec![0.0; images],
        };
        let total = 2 * out.alphas.len() + out.codes.len();
        out.moments = vec![0.0; 2 * total];
        out
    }

    /// The code of an image.
    pub fn code(&self, image: usize) -> &[f32] {
        self.codes.get(image * LATENT..(image + 1) * LATENT).unwrap_or_default()
    }

    /// What the scene's colours are multiplied by in an image.
    pub fn gain(&self, image: usize) -> [f32; 3] {
        std::array::from_fn(|c| self.log_gains.get(3 * image + c).map_or(1.0, |v| v.exp()))
    }

    /// Moves the gains of an image to the least error: a Newton step with the loss' weights held, from slope and curvature per
    /// channel. The mean over all images stays 0: it belongs to the scene's colours.
    pub(super) fn step_light(&mut self, image: usize, light: &[[f64; 2]; 3], pixels: usize) {
        let images = self.steps.len().max(1) as f32;
        for (c, &[slope, curvature]) in light.iter().enumerate() {
            let own = 3 * image + c;
            let prior = LIGHT_PRIOR * pixels as f64;
            let slope = slope + prior * f64::from(self.log_gains[own]);
            let step = (slope / (curvature + prior).max(1e-9)) as f32;
            if !step.is_finite() {
                continue;
            }
            let step = step.clamp(-MOST_LIGHT, MOST_LIGHT);
            self.log_gains[own] -= step;
            self.log_gains.iter_mut().skip(c).step_by(3).for_each(|v| *v += step / images);
        }
    }

    /// Moves the head's pose of an image to a lesser error; `whole` holds the slopes.
    pub(super) fn step_pose(&mut self, image: usize, look: &Look<'_>, whole: &Whole) {
        let Some(by) = newton(look, &whole.head) else { return };
        let moved = numbers(&by.compose(&self.head_motion(image)));
        self.head_motions[image * 6..image * 6 + 6].copy_from_slice(&moved);
    }

    /// The correction of the head's pose, room axes about the origin.
    pub fn head_motion(&self, image: usize) -> Isometry {
        motion(self.head_motions.get(image * 6..image * 6 + 6).unwrap_or_default())
    }

    /// One step of image `image`. `activations` are ∂L/∂activation of its AUs (`None` without annotation) and of its code
    /// (`None` where it did not act). Returns Σ of eq. 17.
    pub(super) fn step(
        &mut self,
        image: usize,
        activations: (Option<&[f32]>, Option<&[f32]>),
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
        eq17
    }
}

/// Translation and rotation vector of a small rigid motion.
fn numbers(motion: &Isometry) -> [f32; 6] {
    let turn = glam::DQuat::from_mat3(&motion.rotation).normalize().to_scaled_axis();
    let t = motion.translation;
    [t.x, t.y, t.z, turn.x, turn.y, turn.z].map(|v| v as f32)
}

/// A small rigid motion from a translation and a rotation vector.
fn motion(v: &[f32]) -> Isometry {
    let [x, y, z, rx, ry, rz] = std::array::from_fn(|i| v.get(i).copied().map_or(0.0, f64::from));
    Isometry::new(rotation_from_vector(DVec3::new(rx, ry, rz)), DVec3::new(x, y, z))
}
