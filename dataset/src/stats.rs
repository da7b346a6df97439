//! The numbers of a build: what was lost, what was chosen, how even the AU intensities are (fact sheet §7.2).

use std::collections::BTreeMap;

use risorius_formats::pose_report::PoseMethod;
use risorius_formats::{ActionUnit, AttributeTable};
use serde::{Deserialize, Serialize};

use crate::align::TakeInput;
use crate::balance;
use crate::options::{BuildOptions, Sampling};
use crate::regions::Rejection;
use crate::signals::{Signals, TrackCounts};

/// `report/stats.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// The takes.
    pub takes: Vec<TakeReport>,
    /// How frames were chosen.
    pub sampling: Sampling,
    /// Frames that could be chosen: trusted, posed, not repeated.
    pub candidates: usize,
    /// How many candidates have no region masks, by reason.
    pub rejected_masks: BTreeMap<String, usize>,
    /// Frames that were chosen.
    pub chosen: usize,
    /// How many of them have no region masks.
    pub chosen_without_masks: usize,
    /// Intensity levels per AU.
    pub levels: usize,
    /// How even the (AU, level) blocks of all candidates are.
    pub evenness_before: Evenness,
    /// The same after choosing as many frames evenly over time.
    pub evenness_uniform: Evenness,
    /// The same after the choice.
    pub evenness_after: Evenness,
    /// Per attribute.
    pub attributes: Vec<AttributeReport>,
}

/// One take.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TakeReport {
    /// The folder's name.
    pub name: String,
    /// Frames per second.
    pub fps: f64,
    /// What became of its frames.
    #[serde(flatten)]
    pub counts: TrackCounts,
    /// The smoothing window, frames.
    pub smoothing_window: usize,
    /// Frames with a camera.
    pub posed: usize,
    /// How the cameras were found.
    pub pose_method: PoseMethod,
    /// Mean reprojection error of its poses, pixels.
    pub reprojection_error_px: Option<f64>,
}

/// How even a histogram over (AU, level) blocks is; inactive AUs and blocks that are empty before the choice are out.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Evenness {
    /// Standard deviation over mean of the block sizes; 0 is perfectly even.
    pub coefficient_of_variation: f64,
    /// Mean over the AUs of the entropy over their levels, as a share of the largest possible; 1 is perfectly even.
    pub entropy: f64,
    /// The first number over the blocks above level 0 only: the face at rest fills the others whatever is chosen.
    pub raised_variation: f64,
    /// Blocks without a frame.
    pub empty_blocks: usize,
}

/// One attribute.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AttributeReport {
    /// The action unit.
    pub unit: ActionUnit,
    /// Its FACS name.
    pub name: String,
    /// The name of its region.
    pub region: String,
    /// Whether it moves enough to be learned.
    pub active: bool,
    /// Smallest smoothed intensity.
    pub au_min: f32,
    /// Largest smoothed intensity.
    pub au_max: f32,
    /// The intensity of the neutral face.
    pub neutral: f32,
    /// Candidates per level.
    pub histogram_before: Vec<usize>,
    /// The same after choosing evenly over time.
    pub histogram_uniform: Vec<usize>,
    /// The same after the choice.
    pub histogram_after: Vec<usize>,
}

/// What [`collect`] looks at.
pub(crate) struct Material<'a> {
    pub(crate) inputs: &'a [TakeInput],
    pub(crate) signals: &'a [Signals],
    pub(crate) table: &'a AttributeTable,
    pub(crate) options: &'a BuildOptions,
    /// Per candidate and attribute.
    pub(crate) levels: &'a [Vec<usize>],
    /// Per candidate: why it has no masks.
    pub(crate) rejections: &'a [Option<Rejection>],
    /// Chosen candidates.
    pub(crate) chosen: &'a [usize],
}

pub(crate) fn collect(m: &Material) -> Report {
    let count = m.options.levels;
    let units = m.table.attributes.len();
    let everything: Vec<usize> = (0..m.levels.len()).collect();
    let uniform = balance::select_uniform(m.levels.len(), m.chosen.len());
    let [before, even, after] =
        [&everything[..], &uniform, m.chosen].map(|frames| histograms(m.levels, frames, units, count));
    let active: Vec<bool> = m.table.attributes.iter().map(|a| a.active).collect();
    let evenness_of = |h: &[Vec<usize>]| evenness(h, &before, &active);
    let mut rejected_masks = BTreeMap::new();
    for rejection in m.rejections.iter().flatten() {
        *rejected_masks.entry(rejection.name().to_owned()).or_insert(0) += 1;
    }
    let take = |(input, signals): (&TakeInput, &Signals)| TakeReport {
        name: input.name.clone(),
        fps: input.take.fps(),
        counts: signals.counts,
        smoothing_window: signals.window,
        posed: input.cameras.len(),
        pose_method: input.report.method,
        reprojection_error_px: input.report.reprojection_error_px,
    };
    let attribute = |(k, a): (usize, &risorius_formats::AttributeSpec)| AttributeReport {
        unit: a.unit,
        name: a.unit.facs_name().to_owned(),
        region: m.table.regions[a.region].clone(),
        active: a.active,
        au_min: a.au_min,
        au_max: a.au_max,
        neutral: a.neutral,
        histogram_before: before[k].clone(),
        histogram_uniform: even[k].clone(),
        histogram_after: after[k].clone(),
    };
    Report {
        takes: m.inputs.iter().zip(m.signals).map(take).collect(),
        sampling: m.options.sampling,
        candidates: m.levels.len(),
        rejected_masks,
        chosen: m.chosen.len(),
        chosen_without_masks: m.chosen.iter().filter(|&&c| m.rejections[c].is_some()).count(),
        levels: count,
        evenness_before: evenness_of(&before),
        evenness_uniform: evenness_of(&even),
        evenness_after: evenness_of(&after),
        attributes: m.table.attributes.iter().enumerate().map(attribute).collect(),
    }
}

/// Per attribute the number of `frames` at each level.
fn histograms(levels: &[Vec<usize>], frames: &[usize], units: usize, count: usize) -> Vec<Vec<usize>> {
    let mut result = vec![vec![0; count]; units];
    for &frame in frames {
        for (histogram, &level) in result.iter_mut().zip(&levels[frame]) {
            histogram[level] += 1;
        }
    }
    result
}

/// How even `histograms` are over the blocks that `reference` fills.
pub fn evenness(histograms: &[Vec<usize>], reference: &[Vec<usize>], active: &[bool]) -> Evenness {
    let (mut sizes, mut raised) = (Vec::new(), Vec::new());
    let mut entropies = Vec::new();
    for ((histogram, filled), _) in histograms.iter().zip(reference).zip(active).filter(|(_, active)| **active) {
        let blocks = histogram.iter().zip(filled).enumerate().filter(|(_, (_, f))| **f > 0);
        let counts: Vec<(usize, f64)> = blocks.map(|(level, (&c, _))| (level, c as f64)).collect();
        let total: f64 = counts.iter().map(|c| c.1).sum();
        if counts.len() > 1 && total > 0.0 {
            let entropy: f64 = counts.iter().filter(|c| c.1 > 0.0).map(|c| -c.1 / total * (c.1 / total).ln()).sum();
            entropies.push(entropy / (counts.len() as f64).ln());
        }
        sizes.extend(counts.iter().map(|c| c.1));
        raised.extend(counts.iter().filter(|c| c.0 > 0).map(|c| c.1));
    }
    Evenness {
        coefficient_of_variation: variation(&sizes),
        entropy: if entropies.is_empty() { 1.0 } else { entropies.iter().sum::<f64>() / entropies.len() as f64 },
        raised_variation: variation(&raised),
        empty_blocks: sizes.iter().filter(|&&s| s == 0.0).count(),
    }
}

/// Standard deviation over mean; 0 where there is nothing.
fn variation(sizes: &[f64]) -> f64 {
    let n = sizes.len().max(1) as f64;
    let mean = sizes.iter().sum::<f64>() / n;
    let variance = sizes.iter().map(|s| (s - mean).powi(2)).sum::<f64>() / n;
    if mean > 0.0 { variance.sqrt() / mean } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn evenness_of_known_histograms() {
        let reference = vec![vec![10, 10, 0], vec![5, 5, 5]];
        let even = evenness(&[vec![4, 4, 0], vec![4, 4, 4]], &reference, &[true, true]);
        assert_eq!((even.coefficient_of_variation, even.empty_blocks), (0.0, 0));
        assert!((even.entropy - 1.0).abs() < 1e-12);
        // Sizes 3, 1: mean 2, deviation 1. The inactive unit and the block that nothing could fill are out.
        let uneven = evenness(&[vec![3, 1, 0], vec![9, 0, 0]], &reference, &[true, false]);
        assert!((uneven.coefficient_of_variation - 0.5).abs() < 1e-12);
        let entropy = -(0.75f64.ln() * 0.75 + 0.25f64.ln() * 0.25) / 2f64.ln();
        assert!((uneven.entropy - entropy).abs() < 1e-12);
        // Above level 0: only one block, of one size.
        assert_eq!(uneven.raised_variation, 0.0);
        let raised = evenness(&[vec![99, 1, 0], vec![50, 1, 4]], &reference, &[true, true]).raised_variation;
        assert!((raised - 2f64.sqrt() / 2.0).abs() < 1e-12, "{raised}");
        assert_eq!(evenness(&[vec![9, 0, 0]], &reference[..1], &[true]).empty_blocks, 1);
    }
}
