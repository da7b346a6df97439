//! Pruning and splitting: rebuilds every array in a new order.

use super::begin::{empty, order, slot};
use super::{Fitter, Settings};
use crate::model::{DELTAS, EMPTY, Gaussians, LANES, REGIONS, channel};
use crate::update::Moments;

/// Half the distance of two children, in standard deviations of the parent along its longest axis.
const APART: f32 = 0.55;
/// Their standard deviation along it, against the parent's.
const NARROWER: f32 = 0.6;
/// Their opacity against the parent's.
const FAINTER: f32 = 0.9;

/// A Gaussian of the next generation.
#[derive(Clone, Copy)]
struct Child {
    slot: usize,
    /// 0 for a Gaussian that stays, −1 and 1 for the halves of one that is split.
    side: f32,
    mean: [f32; 3],
}

/// The densification that is due after a share `done` of the fit, if it has not been done.
pub(super) fn is_due(settings: &Settings, densified: u32, done: f32) -> bool {
    let [from, to] = settings.densify_between;
    let step = (to - from) / settings.densifications.saturating_sub(1).max(1) as f32;
    densified < settings.densifications && done >= from + densified as f32 * step
}

impl Fitter {
    /// Removes what is nearly transparent and splits what asks most loudly to move.
    pub(super) fn densify(&mut self) {
        self.progress.densified += 1;
        let s = &self.settings;
        let left = s.densifications.saturating_sub(self.progress.densified) as usize;
        let at = |slot: usize, c: usize| (slot / LANES * channel::COUNT + c) * LANES + slot % LANES;
        let base = &self.model.base;
        let least = super::begin::logit(s.prune_opacity);
        let is_there = |slot: usize| {
            let opacity = base[at(slot, channel::OPACITY)];
            opacity > EMPTY * 0.5 && opacity >= least
        };
        let mut alive: Vec<usize> = (0..self.model.groups() * LANES).filter(|&i| is_there(i)).collect();
        // Equal steps towards the goal.
        let room = s.gaussians.saturating_sub(alive.len());
        let splits = (room / (left + 1)).min(alive.len());
        let movement = &self.movement;
        let mut by_movement = alive.clone();
        by_movement.sort_unstable_by(|&a, &b| movement[b].total_cmp(&movement[a]).then(a.cmp(&b)));
        let mut split = vec![false; self.model.groups() * LANES];
        by_movement.iter().take(splits).filter(|&&i| movement[i] > 0.0).for_each(|&i| split[i] = true);
        let mean = |slot: usize| std::array::from_fn(|c| base[at(slot, channel::MEAN + c)]);
        let mut children = Vec::with_capacity(alive.len() + splits);
        for slot in alive.drain(..) {
            if split[slot] {
                let offset = longest_axis(base, slot);
                for side in [-1.0f32, 1.0] {
                    let m: [f32; 3] = mean(slot);
                    let mean = std::array::from_fn(|c| m[c] + side * APART * offset[c]);
                    children.push(Child { slot, side, mean });
                }
            } else {
                children.push(Child { slot, side: 0.0, mean: mean(slot) });
            }
        }
        self.rebuild(&children);
    }

    fn rebuild(&mut self, children: &[Child]) {
        let old = &self.model;
        let edge = old.deformable * LANES;
        let means: Vec<[f32; 3]> = children.iter().map(|c| c.mean).collect();
        let flags: Vec<bool> = children.iter().map(|c| c.slot < edge).collect();
        let deformable = flags.iter().filter(|d| **d).count();
        let mut model = empty(old.layout.clone(), deformable, children.len() - deformable);
        let places: Vec<(usize, Child)> = order(&means, &flags)
            .iter()
            .enumerate()
            .map(|(i, &from)| (slot(i, deformable), children[from as usize]))
            .collect();
        let bases = old.layout.bases();
        copy(&places, channel::COUNT, &old.base, &mut model.base, usize::MAX);
        copy(&places, bases * DELTAS, &old.deltas, &mut model.deltas, edge);
        copy(&places, REGIONS, &old.gates, &mut model.gates, edge);
        copy(&places, REGIONS, &old.membership, &mut model.membership, usize::MAX);
        copy(&places, 1, &old.head_weight, &mut model.head_weight, usize::MAX);
        for &(to, child) in &places {
            if child.side != 0.0 {
                divide(&mut model, old, to, &child);
            }
        }
        // Children begin without moments.
        let kept: Vec<(usize, Child)> = places.iter().copied().filter(|(_, c)| c.side == 0.0).collect();
        let moved = |values: &[f32], width: usize, len: usize, edge: usize| {
            let mut out = vec![0.0; len];
            copy(&kept, width, values, &mut out, edge);
            out
        };
        let both = |m: &Moments, width: usize, len: usize, edge: usize| Moments {
            first: moved(&m.first, width, len, edge),
            second: moved(&m.second, width, len, edge),
        };
        self.base_moments = both(&self.base_moments, channel::COUNT, model.base.len(), usize::MAX);
        self.delta_moments = both(&self.delta_moments, bases * DELTAS, model.deltas.len(), edge);
        self.membership_moments = both(&self.membership_moments, REGIONS, model.membership.len(), usize::MAX);
        self.movement = vec![0.0; model.groups() * LANES];
        self.model = model;
    }
}

/// Copies rows of `width` channels to their new slots, of old slots below `edge` only.
fn copy(places: &[(usize, Child)], width: usize, from: &[f32], to: &mut [f32], edge: usize) {
    for (new, child) in places.iter().filter(|(_, c)| c.slot < edge) {
        let (a, b) = (child.slot / LANES * width * LANES + child.slot % LANES, new / LANES * width * LANES + new % LANES);
        for c in 0..width {
            to[b + c * LANES] = from[a + c * LANES];
        }
    }
}

/// The longest axis of a Gaussian times its standard deviation.
fn longest_axis(base: &[f32], slot: usize) -> [f32; 3] {
    let v = |c: usize| base[(slot / LANES * channel::COUNT + c) * LANES + slot % LANES];
    let k = longest(base, slot);
    let q = glam::Quat::from_xyzw(v(7), v(8), v(9), v(6)).normalize();
    let axis = glam::Mat3::from_quat(q).col(k) * v(channel::LOG_SCALE + k).exp();
    if axis.is_finite() { axis.to_array() } else { [0.0; 3] }
}

fn longest(base: &[f32], slot: usize) -> usize {
    let v = |k: usize| base[(slot / LANES * channel::COUNT + channel::LOG_SCALE + k) * LANES + slot % LANES];
    (1..3).fold(0, |best, k| if v(k) > v(best) { k } else { best })
}

/// Makes slot `to` of `model` one half of the Gaussian it was copied from.
fn divide(model: &mut Gaussians, old: &Gaussians, to: usize, child: &Child) {
    let k = longest(&old.base, child.slot);
    let at = |c: usize| (to / LANES * channel::COUNT + c) * LANES + to % LANES;
    for c in 0..3 {
        model.base[at(channel::MEAN + c)] = child.mean[c];
    }
    model.base[at(channel::LOG_SCALE + k)] += NARROWER.ln();
    let opacity = 1.0 / (1.0 + (-model.base[at(channel::OPACITY)]).exp());
    model.base[at(channel::OPACITY)] = super::begin::logit(opacity * FAINTER);
}
