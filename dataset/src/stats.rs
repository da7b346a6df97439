//! The numbers of a dataset: what was lost, what was chosen, how even the AU intensities are (fact sheet §7.2), which AUs
//! come together, which views are covered, how far the held-out frames are from the others, and what to worry about.

use std::collections::BTreeMap;

use risorius_formats::pose_report::PoseMethod;
use risorius_formats::{ActionUnit, Intensity};
use serde::{Deserialize, Serialize};

use crate::align::TakeInput;
use crate::entropy::{self, Seen};
use crate::flags::{self, Flag};
use crate::options::{BuildOptions, Sampling};
use crate::rows::{Rows, UsableRow};
use crate::signals::{Signals, TrackCounts};
use crate::split_report::{self, SplitReport};
use crate::views::{self, Coverage};
use crate::{balance, choose};

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
    /// How the chosen frames cover the candidates' views.
    #[serde(default)]
    pub coverage: Coverage,
    /// The same after choosing as many frames evenly over time.
    #[serde(default)]
    pub coverage_uniform: Coverage,
    /// Mean sharpness rank of the chosen frames within their takes: 0.5 is as sharp as the take, 1 the sharpest.
    #[serde(default)]
    pub sharpness_rank: f64,
    /// Which AUs are raised together.
    #[serde(default)]
    pub together: Together,
    /// The held-out frames.
    #[serde(default)]
    pub split: SplitReport,
    /// What to worry about.
    #[serde(default)]
    pub flags: Vec<Flag>,
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
    /// Entropy of the block sizes as one distribution, as a share of the largest possible; 1 is perfectly even.
    #[serde(default)]
    pub block_entropy: f64,
    /// Mean over the AUs of the entropy over their levels, as a share of the largest possible; 1 is perfectly even.
    pub entropy: f64,
    /// The first number over the blocks above level 0 only: the face at rest fills the others whatever is chosen.
    pub raised_variation: f64,
    /// Blocks without a frame.
    pub empty_blocks: usize,
}

/// Which AUs are raised together (attribute of 0 or more), in numbers of frames; the diagonal counts each AU.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Together {
    /// Over the candidates.
    pub before: Vec<Vec<usize>>,
    /// Over the chosen frames.
    pub after: Vec<Vec<usize>>,
    /// Mean absolute correlation of the attributes of two active AUs, over the candidates: 0 is independent.
    pub correlation_before: f64,
    /// The same over the chosen frames.
    pub correlation_after: f64,
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

/// What the rows do not know of a take.
pub(crate) fn about_take(input: &TakeInput, signals: &Signals) -> TakeReport {
    TakeReport {
        name: input.name.clone(),
        fps: input.take.fps(),
        counts: signals.counts,
        smoothing_window: signals.window,
        posed: input.cameras.len(),
        pose_method: input.report.method,
        reprojection_error_px: input.report.reprojection_error_px,
    }
}

/// The numbers of a dataset whose rows say which frames were chosen.
pub(crate) fn collect(rows: &Rows, takes: Vec<TakeReport>, options: &BuildOptions) -> Report {
    let usable = rows.usable();
    let levels = rows.levels(&usable, options.levels, options.bins);
    let chosen: Vec<usize> = (0..usable.len()).filter(|&c| usable[c].row.id.is_some()).collect();
    let uniform = balance::select_uniform(usable.len(), chosen.len());
    let everything: Vec<usize> = (0..usable.len()).collect();
    let units = rows.table.attributes.len();
    let [before, even, after] =
        [&everything, &uniform, &chosen].map(|frames| histograms(&levels, frames, units, options.levels));
    let active = rows.active();
    let evenness_of = |h: &[Vec<usize>]| evenness(h, &before, &active);
    let mut rejected_masks = BTreeMap::new();
    for reason in usable.iter().filter_map(|u| u.row.masks.as_deref()).filter(|m| *m != "ok") {
        *rejected_masks.entry(reason.to_owned()).or_insert(0) += 1;
    }
    let attribute = |(k, a): (usize, &risorius_formats::AttributeSpec)| AttributeReport {
        unit: a.unit,
        name: a.unit.facs_name().to_owned(),
        region: rows.table.regions[a.region].clone(),
        active: a.active,
        au_min: a.au_min,
        au_max: a.au_max,
        neutral: a.neutral,
        histogram_before: before[k].clone(),
        histogram_uniform: even[k].clone(),
        histogram_after: after[k].clone(),
    };
    let views: Vec<[f64; 2]> = usable.iter().map(|u| u.view).collect();
    let mut report = Report {
        takes,
        sampling: options.sampling,
        candidates: usable.len(),
        rejected_masks,
        // Frames of other programs may be chosen without any attribute.
        chosen: rows.takes.iter().flat_map(|t| &t.frames).filter(|f| f.id.is_some()).count(),
        chosen_without_masks: chosen.iter().filter(|&&c| usable[c].row.masks.as_deref() != Some("ok")).count(),
        levels: options.levels,
        evenness_before: evenness_of(&before),
        evenness_uniform: evenness_of(&even),
        evenness_after: evenness_of(&after),
        coverage: views::coverage(&views, &chosen),
        coverage_uniform: views::coverage(&views, &uniform),
        sharpness_rank: sharpness_rank(&usable, &chosen),
        together: Together {
            before: together(rows, &usable, &everything),
            after: together(rows, &usable, &chosen),
            correlation_before: correlation(rows, &usable, &everything),
            correlation_after: correlation(rows, &usable, &chosen),
        },
        split: split_report::collect(&choose::facts(rows, &usable), &usable, options.split().kind),
        flags: Vec::new(),
        attributes: rows.table.attributes.iter().enumerate().map(attribute).collect(),
    };
    report.flags = flags::collect(&report, &usable, &chosen);
    report
}

/// Mean rank of `chosen` among the usable frames of their takes.
pub(crate) fn sharpness_rank(usable: &[UsableRow<'_>], chosen: &[usize]) -> f64 {
    let seen =
        |u: &UsableRow<'_>| Seen { levels: &[], cell: [0; 2], take: u.take, secs: 0.0, sharpness: u.row.sharpness };
    let ranks = entropy::sharpness_ranks(&usable.iter().map(seen).collect::<Vec<_>>());
    chosen.iter().map(|&c| ranks[c]).sum::<f64>() / chosen.len().max(1) as f64
}

fn together(rows: &Rows, usable: &[UsableRow<'_>], frames: &[usize]) -> Vec<Vec<usize>> {
    let specs = &rows.table.attributes;
    let mut counts = vec![vec![0; specs.len()]; specs.len()];
    for &f in frames {
        let raised = |k: &usize| {
            let scale = specs[*k].scale();
            scale.is_active() && scale.attribute(Intensity(usable[f].intensities[*k])) >= crate::split::RAISED
        };
        let up: Vec<usize> = (0..specs.len()).filter(raised).collect();
        for &a in &up {
            for &b in &up {
                counts[a][b] += 1;
            }
        }
    }
    counts
}

/// Mean absolute Pearson correlation of the intensities of two active AUs over `frames`; 0 without two that vary.
pub(crate) fn correlation(rows: &Rows, usable: &[UsableRow<'_>], frames: &[usize]) -> f64 {
    let units: Vec<usize> = (0..rows.table.attributes.len()).filter(|&k| rows.table.attributes[k].active).collect();
    let centred = |k: &usize| -> Vec<f64> {
        let values: Vec<f64> = frames.iter().map(|&f| f64::from(usable[f].intensities[*k])).collect();
        let mean = values.iter().sum::<f64>() / values.len().max(1) as f64;
        let norm = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>().sqrt();
        // A flat one correlates with nothing.
        values.iter().map(|v| if norm > 1e-9 { (v - mean) / norm } else { 0.0 }).collect()
    };
    let curves: Vec<Vec<f64>> = units.iter().map(centred).collect();
    let (mut sum, mut pairs) = (0.0, 0usize);
    for (i, a) in curves.iter().enumerate() {
        for b in &curves[..i] {
            sum += a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>().abs();
            pairs += 1;
        }
    }
    sum / pairs.max(1) as f64
}

/// Per attribute the number of `frames` at each level.
pub fn histograms(levels: &[Vec<usize>], frames: &[usize], units: usize, count: usize) -> Vec<Vec<usize>> {
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
        if let Some(entropy) = entropy_share(counts.iter().map(|c| c.1)) {
            entropies.push(entropy);
        }
        sizes.extend(counts.iter().map(|c| c.1));
        raised.extend(counts.iter().filter(|c| c.0 > 0).map(|c| c.1));
    }
    Evenness {
        coefficient_of_variation: variation(&sizes),
        block_entropy: entropy_share(sizes.iter().copied()).unwrap_or(1.0),
        entropy: if entropies.is_empty() { 1.0 } else { entropies.iter().sum::<f64>() / entropies.len() as f64 },
        raised_variation: variation(&raised),
        empty_blocks: sizes.iter().filter(|&&s| s == 0.0).count(),
    }
}

/// Entropy of a distribution given by `counts`, as a share of the largest possible; `None` where it says nothing.
fn entropy_share(counts: impl Iterator<Item = f64> + Clone) -> Option<f64> {
    let (bins, total) = (counts.clone().count(), counts.clone().sum::<f64>());
    if bins < 2 || total <= 0.0 {
        return None;
    }
    let entropy: f64 = counts.filter(|c| *c > 0.0).map(|c| -c / total * (c / total).ln()).sum();
    Some(entropy / (bins as f64).ln())
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
        assert!((even.entropy - 1.0).abs() < 1e-12 && (even.block_entropy - 1.0).abs() < 1e-12);
        // Sizes 3, 1: mean 2, deviation 1. The inactive unit and the block that nothing could fill are out.
        let uneven = evenness(&[vec![3, 1, 0], vec![9, 0, 0]], &reference, &[true, false]);
        assert!((uneven.coefficient_of_variation - 0.5).abs() < 1e-12);
        let entropy = -(0.75f64.ln() * 0.75 + 0.25f64.ln() * 0.25) / 2f64.ln();
        assert!((uneven.entropy - entropy).abs() < 1e-12 && (uneven.block_entropy - entropy).abs() < 1e-12);
        // Above level 0: only one block, of one size.
        assert_eq!(uneven.raised_variation, 0.0);
        let raised = evenness(&[vec![99, 1, 0], vec![50, 1, 4]], &reference, &[true, true]).raised_variation;
        assert!((raised - 2f64.sqrt() / 2.0).abs() < 1e-12, "{raised}");
        assert_eq!(evenness(&[vec![9, 0, 0]], &reference[..1], &[true]).empty_blocks, 1);
    }
}
