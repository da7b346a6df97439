//! AU-balanced sampling: about as many frames of every (AU, intensity) block as there can be (paper §III-A;
//! pseudo-code and choices: fact sheet §7).

use risorius_formats::au::MAX_INTENSITY;

/// How to balance.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BalanceOptions {
    /// Number of intensity levels over 0–5; 6 are whole steps.
    pub levels: usize,
    /// Whether frames that other blocks already took count against a block's quota: a flatter histogram with fewer
    /// neutral frames.
    pub count_existing: bool,
}

impl Default for BalanceOptions {
    fn default() -> Self {
        Self { levels: 6, count_existing: false }
    }
}

/// The level of an intensity 0–5: the nearest of `levels` evenly spaced ones, halves upwards.
pub fn level_of(intensity: f32, levels: usize) -> usize {
    let top = levels.saturating_sub(1);
    // In f64, and with a NaN falling to level 0 instead of panicking.
    let scaled = f64::from(intensity) / f64::from(MAX_INTENSITY) * top as f64 + 0.5;
    (scaled.floor().max(0.0) as usize).min(top)
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
        for level in 0..levels {
            let members: Vec<_> = (0..levels_of.len()).filter(|&c| levels_of[c][unit] == level).collect();
            if !members.is_empty() {
                result.push(Block { unit, level, members });
            }
        }
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
    let mut left = blocks.len();
    for block in &blocks {
        // The rest of the budget over the rest of the blocks, so that small blocks leave their share to large ones.
        let mut quota = target.saturating_sub(taken).div_ceil(left);
        left -= 1;
        if quota == 0 {
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
