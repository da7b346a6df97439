//! What belongs to single images: attributes and how sure they are (eq. 17), the latent code, the camera's motion.

use rayon::prelude::*;

use super::lane::Image;
use crate::model::{Brick, LATENT};
use crate::table::TableGrad;

/// ln 0.03: β has a floor, or a perfect AU would push it to 0 and the next spike to infinity.
const LOG_BETA_FLOOR: f32 = -3.506_558;

/// Gradients of what belongs to single images, and of the displacements that their codes mix.
#[derive(Debug, Default)]
pub(super) struct Own {
    pub(super) codes: TableGrad,
    pub(super) alphas: TableGrad,
    pub(super) log_betas: TableGrad,
    pub(super) motions: TableGrad,
    pub(super) latent_bases: Vec<TableGrad>,
    /// Sum of eq. 17 over the annotated AUs of the step, and their number.
    pub(super) attribute: (f64, usize),
}

/// How strongly [`Own`] is held.
#[derive(Clone, Copy, Debug)]
pub(super) struct Holds {
    /// Weight of eq. 17.
    pub(super) attribute_weight: f32,
    /// Weight of ‖ω‖²; `None` while codes are not learned.
    pub(super) latent_weight: Option<f32>,
    /// Whether cameras move.
    pub(super) cameras: bool,
    /// Numbers of pixels that a gradient sums over.
    pub(super) scale: f32,
}

impl Own {
    /// Takes up what the images say; `d_activations` are the gradients of each image's activations.
    pub(super) fn gather(&mut self, model: &Brick, images: &[&Image], d_activations: &[Vec<f32>], holds: Holds) {
        self.codes.fit(&model.codes);
        self.alphas.fit(&model.alphas);
        self.log_betas.fit(&model.log_betas);
        self.motions.fit(&model.motions);
        self.latent_bases.resize_with(model.latent_bases.len(), TableGrad::default);
        self.latent_bases.iter_mut().zip(&model.latent_bases).for_each(|(g, t)| g.fit(t));
        self.attribute = (0.0, 0);
        let k = model.layout.region_of.len();
        for (image, d) in images.iter().zip(d_activations).filter(|(image, _)| image.annotated) {
            self.attributes(model, image.view, &d[..k], holds);
        }
        if let Some(weight) = holds.latent_weight {
            let coded = images.iter().zip(d_activations).filter(|(image, _)| image.coded);
            let (images, d_activations): (Vec<&Image>, Vec<&[f32]>) =
                coded.map(|(&image, d)| (image, d.as_slice())).unzip();
            self.codes(model, &images, &d_activations, weight * holds.scale);
        }
        for image in images.iter().filter(|_| holds.cameras) {
            let row = &mut self.motions.values[image.view * 6..(image.view + 1) * 6];
            row.iter_mut().zip(image.d_motion).for_each(|(a, b)| *a += b);
            self.motions.touched[image.view] = true;
        }
    }

    /// α and β of an image: what the pixels ask for against eq. 17.
    fn attributes(&mut self, model: &Brick, view: usize, d_activations: &[f32], holds: Holds) {
        let k = d_activations.len();
        let (deltas, logs) = (&model.alphas.values, &model.log_betas.values);
        for (i, d) in d_activations.iter().enumerate() {
            let at = view * k + i;
            let log_beta = logs[at].max(LOG_BETA_FLOOR);
            let precise = (deltas[at] * (-log_beta).exp()).powi(2);
            let weight = holds.attribute_weight * holds.scale / k as f32;
            self.alphas.values[at] += d * 0.5 + weight * deltas[at] * (-2.0 * log_beta).exp();
            self.log_betas.values[at] += weight * (log_beta - precise);
            self.attribute.0 += f64::from(0.5 * (precise + log_beta * log_beta));
        }
        self.attribute.1 += k;
        self.alphas.touched[view] = true;
        self.log_betas.touched[view] = true;
    }

    /// ω of the images and the displacements they mix.
    fn codes(&mut self, model: &Brick, images: &[&Image], d_activations: &[&[f32]], weight: f32) {
        let k = model.layout.region_of.len();
        let code = |image: &Image, j: usize| model.code(image.view)[j];
        let d_codes: Vec<Vec<f32>> = self
            .latent_bases
            .par_iter_mut()
            .zip(&model.latent_bases)
            .enumerate()
            .map(|(j, (grad, basis))| {
                grad.touched.fill(true);
                let through_displacement = |image: &&Image| {
                    let c = code(image, j);
                    let mut sum = 0.0;
                    for ((out, &d), &v) in grad.values.iter_mut().zip(&image.d_latent).zip(&basis.values) {
                        *out += c * d;
                        sum += d * v;
                    }
                    sum
                };
                images.iter().map(through_displacement).collect()
            })
            .collect();
        for (i, image) in images.iter().enumerate() {
            for (j, d_codes) in d_codes.iter().enumerate() {
                self.codes.values[image.view * LATENT + j] +=
                    d_codes[i] + d_activations[i][k + j] + 2.0 * weight * code(image, j);
            }
            self.codes.touched[image.view] = true;
        }
    }
}
