//! The better objective: the frames that together have the most entropy over AU levels, camera directions and time,
//! sharp ones first.
//!
//! ```text
//! J = 1/A · Σ_a H_a / ln L_a  +  w_view · H_view / ln C  +  w_time · H_time / ln S  +  w_sharp · mean sharpness rank
//! ```
//!
//! H is the entropy of the chosen frames over the levels of AU a (L_a of them occur), over cells of camera directions (C)
//! and over slots of time (S). Every frame adds one to one bin of each histogram, so that for a fixed number of frames
//! entropy is a constant minus `Σ c ln c / N`: what a frame adds depends on its own bins only, and it only ever shrinks.
//! The greedy choice can therefore keep its candidates in a heap and re-weigh the top alone (Minoux 1978).

use std::cmp::Ordering;
use std::collections::{BTreeMap, BinaryHeap};

use serde::{Deserialize, Serialize};

use crate::error::{DatasetError, Result};

/// What the objective weighs; all AUs together weigh 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct EntropyOptions {
    /// Weight of even camera directions.
    pub view_weight: f64,
    /// Weight of evenness in time, which keeps neighbours apart.
    pub time_weight: f64,
    /// Weight of the mean sharpness rank.
    pub sharp_weight: f64,
    /// Length of a slot of time, seconds.
    pub slot_secs: f64,
}

impl Default for EntropyOptions {
    fn default() -> Self {
        Self { view_weight: 0.25, time_weight: 0.25, sharp_weight: 0.1, slot_secs: 0.25 }
    }
}

impl EntropyOptions {
    pub(crate) fn check(&self) -> Result<()> {
        let weights = [self.view_weight, self.time_weight, self.sharp_weight];
        if weights.iter().all(|w| w.is_finite() && *w >= 0.0) && self.slot_secs > 0.0 && self.slot_secs.is_finite() {
            return Ok(());
        }
        Err(DatasetError::Option {
            message: format!("weights {weights:?} and a slot of {} seconds make no sense", self.slot_secs),
            hint: "weights are 0 or more, a slot is longer than 0".to_owned(),
        })
    }
}

/// A candidate as the objective sees it.
#[derive(Clone, Copy, Debug)]
pub struct Seen<'a> {
    /// Level of each AU.
    pub levels: &'a [usize],
    /// The cell of its camera's direction; see [`crate::views::cell`].
    pub cell: [i32; 2],
    /// Its take.
    pub take: usize,
    /// When it was taken, seconds.
    pub secs: f64,
    /// Its sharpness, the larger the sharper, in any unit; `None` where unknown.
    pub sharpness: Option<f32>,
}

/// The candidates' bins in one histogram after the other, with the weight of each histogram.
struct Bins {
    /// Bins of candidate `c`: `of[c * width..][..width]`, numbered through all histograms.
    of: Vec<u32>,
    width: usize,
    /// Weight of each bin's histogram.
    weights: Vec<f64>,
    /// What each candidate brings by itself.
    own: Vec<f64>,
}

/// Indices of `min(target, seen)` candidates, ascending: greedily those that raise J most, ties by index.
pub fn select(seen: &[Seen<'_>], active: &[bool], target: usize, options: EntropyOptions) -> Vec<usize> {
    let bins = bins(seen, active, options);
    let mut counts = vec![0usize; bins.weights.len()];
    let gain = |c: usize, counts: &[usize]| -> f64 {
        let of = &bins.of[c * bins.width..][..bins.width];
        bins.own[c] - of.iter().map(|&b| bins.weights[b as usize] * step(counts[b as usize])).sum::<f64>()
    };
    let mut heap: BinaryHeap<Entry> = (0..seen.len()).map(|c| Entry { gain: gain(c, &counts), index: c }).collect();
    let mut chosen = Vec::with_capacity(target.min(seen.len()));
    while chosen.len() < target {
        let Some(top) = heap.pop() else { break };
        let fresh = Entry { gain: gain(top.index, &counts), index: top.index };
        // Gains only shrink: what still beats the others' old gains beats their new ones.
        if heap.peek().is_some_and(|next| *next > fresh) {
            heap.push(fresh);
            continue;
        }
        for &b in &bins.of[top.index * bins.width..][..bins.width] {
            counts[b as usize] += 1;
        }
        chosen.push(top.index);
    }
    chosen.sort_unstable();
    chosen
}

/// What the next frame in a bin of `count` adds to `Σ c ln c`.
fn step(count: usize) -> f64 {
    let x_ln_x = |x: f64| if x > 0.0 { x * x.ln() } else { 0.0 };
    x_ln_x(count as f64 + 1.0) - x_ln_x(count as f64)
}

#[derive(PartialEq)]
struct Entry {
    gain: f64,
    index: usize,
}

impl Eq for Entry {}

impl Ord for Entry {
    fn cmp(&self, other: &Self) -> Ordering {
        self.gain.total_cmp(&other.gain).then(other.index.cmp(&self.index))
    }
}

impl PartialOrd for Entry {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

fn bins(seen: &[Seen<'_>], active: &[bool], options: EntropyOptions) -> Bins {
    let mut histograms: Vec<(Vec<u32>, usize, f64)> = Vec::new();
    let units: Vec<usize> = (0..active.len()).filter(|&a| active[a]).collect();
    for &unit in &units {
        let (of, count) = numbered(seen.iter().map(|s| s.levels[unit]));
        histograms.push((of, count, 1.0 / units.len() as f64));
    }
    let (of, count) = numbered(seen.iter().map(|s| s.cell));
    histograms.push((of, count, options.view_weight));
    let (of, count) = numbered(seen.iter().map(|s| (s.take, (s.secs / options.slot_secs).floor() as i64)));
    histograms.push((of, count, options.time_weight));
    let width = histograms.len();
    let mut result = Bins { of: vec![0; seen.len() * width], width, weights: Vec::new(), own: vec![0.0; seen.len()] };
    for (column, (of, count, weight)) in histograms.into_iter().enumerate() {
        let first = result.weights.len() as u32;
        for (c, bin) in of.into_iter().enumerate() {
            result.of[c * width + column] = first + bin;
        }
        // One bin has no entropy, whatever is chosen.
        let weight = if count > 1 { weight / (count as f64).ln() } else { 0.0 };
        result.weights.extend(std::iter::repeat_n(weight, count));
    }
    for (own, rank) in result.own.iter_mut().zip(sharpness_ranks(seen)) {
        *own = options.sharp_weight * rank;
    }
    result
}

/// Numbers what occurs from 0, in ascending order.
fn numbered<K: Ord + Copy>(keys: impl Iterator<Item = K> + Clone) -> (Vec<u32>, usize) {
    let mut numbers: BTreeMap<K, u32> = keys.clone().map(|k| (k, 0)).collect();
    for (number, slot) in (0..).zip(numbers.values_mut()) {
        *slot = number;
    }
    (keys.map(|k| numbers[&k]).collect(), numbers.len())
}

/// The share of the take's frames that each one is sharper than, 0–1; a half where nothing is known.
pub fn sharpness_ranks(seen: &[Seen<'_>]) -> Vec<f64> {
    let mut ranks = vec![0.5; seen.len()];
    let takes: std::collections::BTreeSet<usize> = seen.iter().map(|s| s.take).collect();
    for take in takes {
        let known = |c: usize| seen[c].sharpness.filter(|v| v.is_finite() && seen[c].take == take).map(|v| (v, c));
        let mut order: Vec<(f32, usize)> = (0..seen.len()).filter_map(known).collect();
        order.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let last = order.len().saturating_sub(1).max(1) as f64;
        // Equal sharpness, equal rank: the first of a run stands for all.
        let mut first = 0;
        for i in 0..order.len() {
            if order[i].0 != order[first].0 {
                first = i;
            }
            ranks[order[i].1] = first as f64 / last;
        }
    }
    ranks
}

#[cfg(test)]
#[path = "entropy_tests.rs"]
mod tests;
