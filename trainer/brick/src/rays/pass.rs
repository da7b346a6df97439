//! The samples of one part of the scene along a chunk's rays: what they weigh, show, and pass back.
#![allow(unsafe_code, reason = "vectors of sixteen samples")]

use super::Upstream;
use crate::cull::SEEN;
use crate::evaluate::Samples;
use crate::field::{Field, monomials};
use crate::math;
use crate::occupancy::{Occupancy, part_at};
use crate::simd::Simd;
use crate::sixteen::POINTS;

/// What one part of the scene has along each ray.
#[derive(Clone, Debug, Default)]
pub(crate) struct Pass {
    pub(crate) samples: Samples,
    /// Opacity of each sample; negative where the ray had already ended.
    pub(super) alpha: Vec<f32>,
    /// Transmittance in front of each sample.
    before: Vec<f32>,
    /// Colour of each sample.
    color: Vec<[f32; 3]>,
    /// How far along its ray each sample lies, box units.
    pub(super) along: Vec<f32>,
    /// Rays that may have more samples.
    pub(super) alive: Vec<u32>,
    /// Samples of the last wave that have a colour.
    shown: Vec<u32>,
}

/// Sums over the samples behind the current one, per ray.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Behind {
    /// ⟨gradient, what they show⟩
    pub(super) suffix: f32,
    /// Σ weight, Σ weight · distance of all samples of the ray.
    pub(super) total: [f32; 2],
    /// The same of those passed on the way back.
    pub(super) passed: [f32; 2],
}

/// What is asked of the density besides explaining the pixels.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Prior {
    /// Weight of ln(1 + 2σ²): thin density goes, what is opaque stays.
    pub(crate) haze: f32,
    /// Weight of the spread of each ray's weights (Σ w_i w_j |t_i − t_j| + ⅓ Σ w_i² step).
    pub(crate) spread: f32,
}

impl Pass {
    pub(super) fn begin(&mut self, directions: &[[f32; 3]]) {
        self.samples.clear();
        self.samples.directions.extend(directions.iter().map(|d| monomials(*d)));
        self.alpha.clear();
        self.before.clear();
        self.color.clear();
        self.along.clear();
        self.alive.clear();
    }

    /// Takes the density from samples where nothing is.
    pub(super) fn silence(&mut self, from: usize, occupancy: &Occupancy) {
        for i in from..self.samples.len() {
            if !occupancy.holds(self.samples.point[i]) {
                self.samples.silence(i);
            }
        }
    }

    /// How much of each sample from `from` on its ray shows: opacities, and what is in front.
    #[inline(always)]
    pub(super) fn weigh_samples<S: Simd>(&mut self, from: usize, step: f32, opaque: f32, left: &mut [f32]) {
        let n = self.samples.len();
        self.alpha.resize(n, 0.0);
        self.before.resize(n, 0.0);
        for first in (from..n).step_by(POINTS) {
            let count = (n - first).min(POINTS);
            let mut each = [0.0; POINTS];
            for i in 0..count {
                each[i] = self.samples.density(first + i);
            }
            // SAFETY: arrays of 16.
            unsafe {
                S::store(each.as_mut_ptr(), math::opacity_each::<S>(S::load(each.as_ptr()), step));
            }
            for i in 0..count {
                let left = &mut left[self.samples.ray[first + i] as usize];
                self.before[first + i] = *left;
                if *left < opaque {
                    self.alpha[first + i] = -1.0;
                } else {
                    self.alpha[first + i] = each[i];
                    *left *= 1.0 - each[i];
                }
            }
        }
    }

    /// Adds the colours of the samples from `from` on to their rays'. With `faint`, samples whose weights sum to no more
    /// than its limit along a ray stay without colour: none exceeds 1, so nor does what is missing.
    #[inline(always)]
    pub(super) fn color_samples<S: Simd>(
        &mut self,
        field: &Field,
        from: usize,
        faint: Option<(f32, &mut [f32])>,
        out: &mut [[f32; 3]],
    ) {
        let n = self.samples.len();
        self.color.resize(n, [0.0; 3]);
        self.shown.clear();
        if let Some((limit, sums)) = faint {
            for i in from..n {
                let w = self.weight(i);
                let sum = &mut sums[self.samples.ray[i] as usize];
                if *sum + w <= limit {
                    *sum += w;
                } else {
                    self.shown.push(i as u32);
                }
            }
            self.samples.color_some(field, &self.shown);
        } else {
            self.samples.color_all(field, from);
            self.shown.extend((from as u32..n as u32).filter(|&i| self.alpha[i as usize] >= 0.0));
        }
        for shown in self.shown.chunks(POINTS) {
            let mut each = [[0.0; POINTS]; 3];
            for (k, &i) in shown.iter().enumerate() {
                let raw = self.samples.color(i as usize);
                for c in 0..3 {
                    each[c][k] = raw[c];
                }
            }
            for each in &mut each {
                // SAFETY: arrays of 16.
                unsafe { S::store(each.as_mut_ptr(), math::sigmoid_each::<S>(S::load(each.as_ptr()))) }
            }
            for (k, &i) in shown.iter().enumerate() {
                let i = i as usize;
                let w = self.before[i] * self.alpha[i];
                let out = &mut out[self.samples.ray[i] as usize];
                for c in 0..3 {
                    self.color[i][c] = each[c][k];
                    out[c] += w * each[c][k];
                }
            }
        }
    }

    /// Turns gradients of the rays into those of the samples; `rays` begin with what lies behind everything. `half` is the
    /// length of a unit along the ray, for the depth.
    #[inline(always)]
    pub(super) fn decomposite(
        &mut self,
        step: f32,
        half: f32,
        upstream: Upstream<'_>,
        rays: &mut [Behind],
        prior: Prior,
    ) {
        let n = self.samples.len();
        self.samples.d_density.resize(n, 0.0);
        self.samples.d_color.resize(n, [0.0; 3]);
        for ray in rays.iter_mut() {
            ray.total = [0.0; 2];
            ray.passed = [0.0; 2];
        }
        for i in 0..n {
            let w = self.weight(i);
            let total = &mut rays[self.samples.ray[i] as usize].total;
            *total = [total[0] + w, total[1] + w * self.along[i]];
        }
        for i in (0..n).rev() {
            let alpha = self.alpha[i];
            if alpha < 0.0 {
                self.samples.d_density[i] = 0.0;
                self.samples.d_color[i] = [0.0; 3];
                continue;
            }
            let ray = self.samples.ray[i] as usize;
            let (d, color, before) = (upstream.color[ray], self.color[i], self.before[i]);
            let scale = upstream.regular.map_or(1.0, |d| d[ray]);
            let depth = upstream.depth.map(|d| d[ray]);
            let ray = &mut rays[ray];
            let (w, t) = (before * alpha, self.along[i]);
            let front = [ray.total[0] - ray.passed[0] - w, ray.total[1] - ray.passed[1] - w * t];
            let apart = t * front[0] - front[1] + ray.passed[1] - t * ray.passed[0];
            let mut g = math::dot(d, color) + scale * prior.spread * (2.0 * apart + 2.0 / 3.0 * w * step);
            if let Some([along, weight]) = depth {
                g += along * t * half + weight;
            }
            let sigma = math::density(self.samples.density(i));
            let d_sigma = step * (before * (1.0 - alpha) * g - ray.suffix);
            let thin = scale * prior.haze * 4.0 * sigma / (1.0 + 2.0 * sigma * sigma);
            self.samples.d_density[i] = (d_sigma + thin) * sigma;
            self.samples.d_color[i] = std::array::from_fn(|c| w * d[c] * color[c] * (1.0 - color[c]));
            ray.suffix += w * g;
            ray.passed = [ray.passed[0] + w, ray.passed[1] + w * t];
        }
    }

    /// Adds what `prior` holds against each ray's samples.
    pub(super) fn add_regular(&self, step: f32, prior: Prior, out: &mut [f32]) {
        // Σ weight, Σ weight · distance in front of the current sample.
        let mut front = vec![[0.0f32; 2]; out.len()];
        for i in 0..self.samples.len() {
            if self.alpha[i] < 0.0 {
                continue;
            }
            let ray = self.samples.ray[i] as usize;
            let (w, t, sigma) = (self.weight(i), self.along[i], math::density(self.samples.density(i)));
            let [weight, far] = front[ray];
            let spread = 2.0 * w * (t * weight - far) + w * w * step / 3.0;
            out[ray] += prior.haze * (2.0 * sigma * sigma).ln_1p() + prior.spread * spread;
            front[ray] = [weight + w, far + w * t];
        }
    }

    /// How much of its ray's colour sample `i` is.
    #[inline(always)]
    pub(super) fn weight(&self, i: usize) -> f32 {
        self.before[i] * self.alpha[i].max(0.0)
    }

    /// The largest weight of any ray, per part of a cell.
    pub(crate) fn weigh(&self, weights: &mut [f32]) {
        for (i, &p) in self.samples.point.iter().enumerate() {
            let w = self.before[i] * self.alpha[i];
            if w < SEEN {
                // Decides nothing, and most samples are such: each would cost a miss of the cache.
                continue;
            }
            let slot = &mut weights[part_at(p)];
            if w > *slot {
                *slot = w;
            }
        }
    }
}
