//! How far the held-out frames are from those for fitting: a small distance means that the split leaks.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use crate::rows::UsableRow;
use crate::split::{Facts, SplitKind};
use crate::views::direction_of;

/// The split of the chosen frames and its leakage; medians are over the held-out frames.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SplitReport {
    /// The way.
    pub kind: SplitKind,
    /// Frames for fitting.
    pub train: usize,
    /// Frames held out.
    pub val: usize,
    /// Time to the nearest frame for fitting of the same take, median and smallest, milliseconds.
    pub nearest_ms: Option<[f64; 2]>,
    /// Angle to the nearest view for fitting, median and smallest, degrees.
    pub nearest_view_deg: Option<[f64; 2]>,
    /// Share of the held-out frames whose combination of raised AUs occurs in fitting.
    pub known_combinations: Option<f64>,
}

pub(crate) fn collect(facts: &[Facts], usable: &[UsableRow<'_>], kind: SplitKind) -> SplitReport {
    let of = |split: &str| -> Vec<usize> { (0..facts.len()).filter(|&c| usable[c].row.split == Some(split)).collect() };
    let (train, val) = (of("train"), of("val"));
    let mut report = SplitReport { kind, train: train.len(), val: val.len(), ..SplitReport::default() };
    if train.is_empty() || val.is_empty() {
        return report;
    }
    let mut times: BTreeMap<usize, Vec<f64>> = BTreeMap::new();
    for &t in &train {
        times.entry(facts[t].take).or_default().push(facts[t].secs);
    }
    let directions: Vec<_> = train.iter().map(|&t| direction_of(facts[t].view)).collect();
    let known: BTreeSet<u64> = train.iter().map(|&t| facts[t].combination).collect();
    let nearest_time = |v: &usize| {
        let own = times.get(&facts[*v].take).map_or(&[][..], Vec::as_slice);
        1e3 * own.iter().map(|t| (t - facts[*v].secs).abs()).fold(f64::INFINITY, f64::min)
    };
    let nearest_view = |v: &usize| {
        let own = direction_of(facts[*v].view);
        let chord = directions.iter().map(|d| d.distance(own)).fold(f64::INFINITY, f64::min);
        2.0 * (chord / 2.0).clamp(0.0, 1.0).asin().to_degrees()
    };
    report.nearest_ms = median_and_least(val.iter().map(nearest_time).collect());
    report.nearest_view_deg = median_and_least(val.iter().map(nearest_view).collect());
    let seen = val.iter().filter(|&&v| known.contains(&facts[v].combination)).count();
    report.known_combinations = Some(seen as f64 / val.len() as f64);
    report
}

fn median_and_least(mut values: Vec<f64>) -> Option<[f64; 2]> {
    values.retain(|v| v.is_finite());
    values.sort_unstable_by(f64::total_cmp);
    Some([*values.get(values.len() / 2)?, *values.first()?])
}
