//! Memberships of Gaussians in regions: composited, held to the 2D labels, without gradient to geometry.

use rayon::prelude::*;

use super::Fitter;
use crate::model::{LANES, REGIONS};
use crate::raster::{Tile, WeightRow};
use crate::scene::Frame;
use crate::simd;
use crate::view::View;

/// AUs act fully where a mask holds at least this of a Gaussian: less does not show in the mask.
const SHOWN: f32 = 0.06;
/// From here on memberships have settled, and gates follow them.
const SETTLED: f32 = 0.5;

impl Fitter {
    /// One step on the labels of a frame whose picture has just been binned; the mean squared error.
    ///
    /// In the second half of a fit the gates shrink where memberships fade: an AU acts nowhere that its mask does not show.
    pub(super) fn fit_memberships(&mut self, frame: &Frame<'_>, view: &View, reduce: usize, done: f32) -> f64 {
        let Some(labels) = frame.labels else { return 0.0 };
        let full = frame.camera.intrinsics.width as usize;
        let bins = &self.work.bins;
        let membership = &self.model.membership;
        let memberships = |slot: u32| {
            let (g, lane) = (slot as usize / LANES, slot as usize % LANES);
            std::array::from_fn(|n| logistic(membership[(g * REGIONS + n) * LANES + lane]))
        };
        let label = |x: usize, y: usize| {
            let at = (y * reduce + reduce / 2) * full + x * reduce + reduce / 2;
            if frame.valid.is_some_and(|v| v[at] == 0) { u8::MAX } else { labels[at] }
        };
        let columns = view.columns();
        let rows = view.tiles() / columns.max(1);
        let mut gradients = vec![[0.0f32; 3]; bins.slots.len()];
        let mut rest = gradients.as_mut_slice();
        let mut work = Vec::with_capacity(rows);
        for row in 0..rows {
            let len = bins.entries((row + 1) * columns - 1).end - bins.entries(row * columns).start;
            let (own, more) = rest.split_at_mut(len);
            rest = more;
            work.push((row, own));
        }
        let (width, height) = (view.width, view.height);
        let sums: Vec<(f64, usize)> = work
            .into_par_iter()
            .map_init(Tile::default, |tile, (row, gradients)| {
                let (memberships, label) = (&memberships, &label);
                simd::run(WeightRow { bins, row, columns, width, height, memberships, label, gradients, tile })
            })
            .collect();
        let (squared, pixels) = sums.iter().fold((0.0, 0), |s, n| (s.0 + n.0, s.1 + n.1));
        let rate = self.settings.mask_rate * self.settings.final_rate.powf(done);
        for slot in 0..bins.count.len() {
            let (first, count) = (bins.first[slot] as usize, bins.count[slot] as usize);
            if count == 0 {
                continue;
            }
            let mut sum = [0.0f32; 3];
            for &at in &bins.position[first..first + count] {
                (0..3).for_each(|n| sum[n] += gradients[at as usize][n]);
            }
            for (n, sum) in sum.into_iter().enumerate().take(self.model.layout.regions) {
                let at = (slot / LANES * REGIONS + n) * LANES + slot % LANES;
                let p = logistic(self.model.membership[at]);
                let gradient = sum * p * (1.0 - p);
                if !gradient.is_finite() {
                    continue;
                }
                let m = &mut self.membership_moments.first[at];
                let v = &mut self.membership_moments.second[at];
                *m += 0.1 * (gradient - *m);
                *v += 0.01 * (gradient * gradient - *v);
                let value = &mut self.model.membership[at];
                *value = (*value - rate * *m / (v.sqrt() + 1e-3)).clamp(-9.0, 9.0);
            }
        }
        if done > SETTLED {
            for (gate, logit) in self.model.gates.iter_mut().zip(&self.model.membership) {
                *gate = gate.min(logistic(*logit) / SHOWN);
            }
        }
        squared / (3 * pixels.max(1)) as f64
    }
}

pub(crate) fn logistic(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}
