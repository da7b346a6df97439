//! AU-balanced sampling: about as many frames of every (AU, intensity) block as there can be (paper §III-A;
//! pseudo-code and choices: fact sheet §7).
//!
//! The paper sorts the blocks by size and samples each uniformly, without the frames that earlier blocks took. It leaves
//! open what a level is ([`Bins`], the number of levels), how many frames a block may take ([`Quota`]) and whether frames
//! that it already has count ([`BalanceOptions::count_existing`]).

use risorius_formats::AttributeSpec;
use risorius_formats::au::MAX_INTENSITY;
use serde::{Deserialize, Serialize};

/// What the intensity levels span.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Bins {
    /// The whole 0–5 scale: with 6 levels these are FACS' own steps, the same for every AU.
    #[default]
    Scale,
    /// Each AU's own range in the capture: weak AUs get as many levels as strong ones.
    Range,
}

/// How many frames a block may take.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Quota {
    /// The rest of the budget over the rest of the blocks: what small blocks leave goes to larger ones.
    #[default]
    Running,
    /// The budget over all blocks; what is missing in the end is filled evenly over time.
    Fixed,
    /// The same ceiling for all blocks, such that the blocks' sizes under it add up to the budget.
    Ceiling,
}

/// How to balance.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BalanceOptions {
    /// Number of intensity levels; 6 over 0–5 are whole steps.
    pub levels: usize,
    /// How many frames a block may take.
    pub quota: Quota,
    /// Whether frames that other blocks already took count against a block's quota: a flatter histogram with fewer
    /// neutral frames.
    pub count_existing: bool,
}

impl Default for BalanceOptions {
    fn default() -> Self {
        Self { levels: 6, quota: Quota::Running, count_existing: false }
    }
}

/// The level of an intensity 0–5: the nearest of `levels` evenly spaced ones, halves upwards.
pub fn level_of(intensity: f32, levels: usize) -> usize {
    level_in(intensity, 0.0, MAX_INTENSITY, levels)
}

fn level_in(intensity: f32, low: f32, high: f32, levels: usize) -> usize {
    let top = levels.saturating_sub(1);
    let width = (f64::from(high) - f64::from(low)).max(1e-6);
    // In f64, and with a NaN falling to level 0 instead of panicking.
    let scaled = (f64::from(intensity) - f64::from(low)) / width * top as f64 + 0.5;
    (scaled.floor().max(0.0) as usize).min(top)
}

/// The level of each attribute in a frame of smoothed `intensities`, 0–5.
pub fn levels_of_frame(intensities: &[f32], specs: &[AttributeSpec], levels: usize, bins: Bins) -> Vec<usize> {
    let level = |(&v, spec): (&f32, &AttributeSpec)| match bins {
        Bins::Scale => level_of(v, levels),
        Bins::Range => level_in(v, spec.au_min, spec.au_max, levels),
    };
    intensities.iter().zip(specs).map(level).collect()
}

/// One (AU, intensity level) block.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Block {
    /// Index of the AU.
    pub unit: usize,
    /// Intensity level.
    pub level: usize,
    /// The candidates in it, ascending.
    pub members: Vec<usize>,
}

/// All blocks with members, in the order of sampling: small ones first, ties by AU, then by falling intensity.
///
/// `levels_of[c][a]` is the level of AU `a` in candidate `c`; AUs that are not `active` make no blocks.
pub fn blocks(levels_of: &[Vec<usize>], active: &[bool], levels: usize) -> Vec<Block> {
    let mut result = Vec::new();
    for unit in (0..active.len()).filter(|&a| active[a]) {
        let mut members = vec![Vec::new(); levels];
        for (candidate, own) in levels_of.iter().enumerate() {
            members[own[unit]].push(candidate);
        }
        let filled = members.into_iter().enumerate().filter(|(_, m)| !m.is_empty());
        result.extend(filled.map(|(level, members)| Block { unit, level, members }));
    }
    result.sort_by_key(|b| (b.members.len(), b.unit, usize::MAX - b.level));
    result
}

/// `count` of `available` ranks, evenly spread, ascending and distinct.
pub fn spread(available: usize, count: usize) -> Vec<usize> {
    let count = count.min(available);
    // floor((i + ½) · available / count), in whole numbers.
    (0..count).map(|i| (2 * i + 1) * available / (2 * count)).collect()
}

/// The balanced choice: indices of `min(target, candidates)` candidates, ascending.
pub fn select_balanced(
    levels_of: &[Vec<usize>],
    active: &[bool],
    target: usize,
    options: BalanceOptions,
) -> Vec<usize> {
    let mut selected = vec![false; levels_of.len()];
    let mut taken = 0;
    let blocks = blocks(levels_of, active, options.levels);
    let ceiling = ceiling(&blocks, target);
    for (place, block) in blocks.iter().enumerate() {
        let rest = target.saturating_sub(taken);
        let mut quota = match options.quota {
            Quota::Running => rest.div_ceil(blocks.len() - place),
            Quota::Fixed => (target / blocks.len()).max(1).min(rest),
            Quota::Ceiling => ceiling.min(rest),
        };
        if rest == 0 {
            break;
        }
        let available: Vec<_> = block.members.iter().copied().filter(|&c| !selected[c]).collect();
        if options.count_existing {
            quota = quota.saturating_sub(block.members.len() - available.len());
        }
        for rank in spread(available.len(), quota) {
            selected[available[rank]] = true;
            taken += 1;
        }
    }
    fill(&mut selected, target.saturating_sub(taken));
    indices(&selected)
}

/// The largest whole number under which the block sizes, cut to it, add up to no more than `target`; at least 1.
fn ceiling(blocks: &[Block], target: usize) -> usize {
    // Blocks stand in ascending order of size.
    let mut left = target;
    for (place, block) in blocks.iter().enumerate() {
        let share = left / (blocks.len() - place);
        if block.members.len() > share {
            return share.max(1);
        }
        left -= block.members.len();
    }
    blocks.last().map_or(1, |b| b.members.len())
}

/// The baseline: `min(target, candidates)` of them, evenly spread over their order.
pub fn select_uniform(candidates: usize, target: usize) -> Vec<usize> {
    spread(candidates, target)
}

fn fill(selected: &mut [bool], missing: usize) {
    let rest: Vec<_> = (0..selected.len()).filter(|&c| !selected[c]).collect();
    for rank in spread(rest.len(), missing) {
        selected[rest[rank]] = true;
    }
}

fn indices(selected: &[bool]) -> Vec<usize> {
    (0..selected.len()).filter(|&c| selected[c]).collect()
}

#[cfg(test)]
#[path = "balance_tests.rs"]
mod tests;
