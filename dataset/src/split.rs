//! Which frames are held out, so that a fit can be judged on what it has not seen.
//!
//! At 120 frames per second a frame and its neighbour show the same face: whoever holds out single frames tests memory.
//! [`SplitKind::TimeBlocks`], [`SplitKind::Views`] and [`SplitKind::AuCombinations`] therefore decide before frames are
//! chosen, and leave out what lies too close to what is held out. The other two do as the literature does.

use std::collections::{BTreeMap, BTreeSet};

use risorius_formats::Attribute;
use serde::{Deserialize, Serialize};

use crate::views;

/// A way to hold frames out.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SplitKind {
    /// Every 20th chosen frame, as the Nerfies family does; the others on both sides of it stay for fitting.
    #[default]
    Periodic,
    /// The paper's interpolation test: every second chosen frame that has a neighbour on both sides.
    EveryOther,
    /// Stretches of about a second, with a guard on both sides that is in neither part.
    TimeBlocks,
    /// Cells of camera directions; their rims are in neither part.
    Views,
    /// Combinations of raised AUs, each of which is still seen in other company.
    AuCombinations,
    /// Nothing.
    None,
}

impl SplitKind {
    /// Whether candidates are sorted before frames are chosen.
    pub fn comes_first(self) -> bool {
        matches!(self, Self::TimeBlocks | Self::Views | Self::AuCombinations)
    }

    /// The name that the command line uses.
    pub fn name(self) -> &'static str {
        match self {
            Self::Periodic => "periodic",
            Self::EveryOther => "every-other",
            Self::TimeBlocks => "time-blocks",
            Self::Views => "views",
            Self::AuCombinations => "au-combinations",
            Self::None => "none",
        }
    }
}

/// How to hold frames out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SplitOptions {
    /// The way.
    pub kind: SplitKind,
    /// The share of the candidates that is held out, about.
    pub val_share: f64,
    /// Frames this close in time to a held-out stretch are in neither part, seconds.
    pub guard_secs: f64,
}

/// What a frame is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// For fitting.
    Train,
    /// Held out.
    Val,
    /// Too close to a held-out frame for either.
    Neither,
}

/// What a split looks at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Facts {
    /// Index of the take.
    pub take: usize,
    /// When, seconds from the take's start.
    pub secs: f64,
    /// Yaw and pitch of the camera, degrees.
    pub view: [f64; 2],
    /// A bit per raised AU; see [`RAISED`].
    pub combination: u64,
}

/// An AU counts as raised from this attribute up: the middle of its range.
pub const RAISED: Attribute = Attribute(0.0);
/// Every so many chosen frames one is held out by [`SplitKind::Periodic`].
pub const VAL_INTERVAL: usize = 20;
/// Which of each [`VAL_INTERVAL`] frames it is: one in the middle, so that it has neighbours on both sides.
pub const VAL_FIRST: usize = 10;
/// Held-out stretches are about this long, seconds.
const BLOCK_SECS: f64 = 1.0;
/// Frames this close to the rim of a held-out cell are in neither part, degrees.
const RIM_DEG: f64 = 1.5;

/// What each candidate is for; in the order of takes and frames. All are for fitting where the split comes later.
pub fn roles(facts: &[Facts], options: SplitOptions) -> Vec<Role> {
    match options.kind {
        SplitKind::TimeBlocks => time_blocks(facts, options),
        SplitKind::Views => held_out_views(facts, options),
        SplitKind::AuCombinations => combinations(facts, options),
        SplitKind::Periodic | SplitKind::EveryOther | SplitKind::None => vec![Role::Train; facts.len()],
    }
}

/// Whether the chosen frame at `place` of `count` is held out, for the splits that come after the choice.
pub fn is_held_out(kind: SplitKind, place: usize, count: usize) -> bool {
    match kind {
        SplitKind::Periodic => place % VAL_INTERVAL == VAL_FIRST,
        SplitKind::EveryOther => place % 2 == 1 && place + 1 < count,
        _ => false,
    }
}

fn time_blocks(facts: &[Facts], options: SplitOptions) -> Vec<Role> {
    let mut spans: BTreeMap<usize, [f64; 2]> = BTreeMap::new();
    for f in facts {
        let span = spans.entry(f.take).or_insert([f.secs, f.secs]);
        *span = [span[0].min(f.secs), span[1].max(f.secs)];
    }
    let role = |f: &Facts| {
        let [start, end] = spans[&f.take];
        let length = end - start;
        let blocks = (length * options.val_share / BLOCK_SECS).round().max(1.0);
        let half = 0.5 * length * options.val_share / blocks;
        // Block k lies around the middle of the k-th of as many equal parts.
        let part = length / blocks;
        let from_middle = if part > 0.0 { ((f.secs - start).rem_euclid(part) - 0.5 * part).abs() } else { 0.0 };
        if from_middle <= half {
            Role::Val
        } else if from_middle <= half + options.guard_secs {
            Role::Neither
        } else {
            Role::Train
        }
    };
    facts.iter().map(role).collect()
}

fn held_out_views(facts: &[Facts], options: SplitOptions) -> Vec<Role> {
    let mut cells: BTreeMap<[i32; 2], usize> = BTreeMap::new();
    for f in facts {
        *cells.entry(views::cell(f.view)).or_default() += 1;
    }
    // Evenly through the cells in order, until enough frames are held out; the cell with most frames stays.
    let largest = cells.iter().max_by_key(|(_, n)| **n).map(|(c, _)| *c);
    let order: Vec<_> = cells.iter().filter(|(c, _)| Some(**c) != largest).collect();
    let wanted = (facts.len() as f64 * options.val_share).ceil() as usize;
    let step = (1.0 / options.val_share).round().max(1.0) as usize;
    let mut held = BTreeSet::new();
    let mut taken = 0;
    for offset in 0..step {
        for (cell, count) in order.iter().skip((step / 2 + offset) % step).step_by(step) {
            if taken < wanted {
                held.insert(**cell);
                taken += **count;
            }
        }
    }
    let role = |f: &Facts| {
        let cell = views::cell(f.view);
        if !held.contains(&cell) {
            return Role::Train;
        }
        let from_rim = |axis: usize| {
            let middle = f64::from(cell[axis]) * views::CELL_DEG;
            0.5 * views::CELL_DEG - (f.view[axis] - middle).abs()
        };
        if from_rim(0).min(from_rim(1)) >= RIM_DEG { Role::Val } else { Role::Neither }
    };
    facts.iter().map(role).collect()
}

fn combinations(facts: &[Facts], options: SplitOptions) -> Vec<Role> {
    let mut sizes: BTreeMap<u64, usize> = BTreeMap::new();
    for f in facts {
        *sizes.entry(f.combination).or_default() += 1;
    }
    let mut raised = [0usize; 64];
    let each = |combination: u64| (0..64).filter(move |b| combination >> b & 1 == 1);
    for (&combination, &n) in &sizes {
        each(combination).for_each(|b| raised[b] += n);
    }
    let wanted = (facts.len() as f64 * options.val_share).ceil() as usize;
    let mut held = BTreeSet::new();
    let mut taken = 0;
    // Small combinations first: many of them say more than one large one. Ties by the combination itself.
    let mut order: Vec<_> = sizes.iter().filter(|(c, _)| c.count_ones() >= 2).map(|(c, n)| (*n, *c)).collect();
    order.sort_unstable();
    for (n, combination) in order {
        // At least half of an AU's raised frames stay for fitting, in other company.
        let stays = each(combination).all(|b| (raised[b] - n) * 2 >= facts_with(&sizes, b));
        if taken + n <= wanted && stays {
            held.insert(combination);
            taken += n;
            each(combination).for_each(|b| raised[b] -= n);
        }
    }
    let is_held: Vec<bool> = facts.iter().map(|f| held.contains(&f.combination)).collect();
    let near = near_in_time(facts, &is_held, options.guard_secs);
    (0..facts.len())
        .map(|i| match (is_held[i], near[i]) {
            (true, _) => Role::Val,
            (false, true) => Role::Neither,
            (false, false) => Role::Train,
        })
        .collect()
}

fn facts_with(sizes: &BTreeMap<u64, usize>, bit: usize) -> usize {
    sizes.iter().filter(|(c, _)| *c >> bit & 1 == 1).map(|(_, n)| n).sum()
}

/// Whether a marked frame of the same take lies within `secs`; frames stand in the order of time, take after take.
fn near_in_time(facts: &[Facts], marked: &[bool], secs: f64) -> Vec<bool> {
    let mut near = vec![false; facts.len()];
    let mut sweep = |order: &mut dyn Iterator<Item = usize>| {
        let mut last: Option<usize> = None;
        for i in order {
            if marked[i] {
                last = Some(i);
            }
            near[i] |=
                last.is_some_and(|l| facts[l].take == facts[i].take && (facts[l].secs - facts[i].secs).abs() <= secs);
        }
    };
    sweep(&mut (0..facts.len()));
    sweep(&mut (0..facts.len()).rev());
    near
}

#[cfg(test)]
#[path = "split_tests.rs"]
mod tests;
