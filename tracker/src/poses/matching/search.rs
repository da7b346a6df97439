//! Looks for a step and an offset where no usual rule fits: few images are tried with many, the best are refined.

use std::collections::BTreeMap;

use super::rule::{RATES, Rule, Way};
use super::score::Evidence;
use super::{EXACT, QUICK, Subject};

/// Rules that are tried at most.
const MOST_TRIED: usize = 6000;
/// Candidates that are refined.
const REFINED: usize = 6;
/// A first look takes offsets this far apart, seconds: a head turns little in that time.
const COARSE_SECS: f64 = 0.05;

/// Steps this close to a whole number are tried as one.
const NEARLY: f64 = 0.02;
/// A rule of whole frames is kept unless another has an error this many times smaller.
const CLEARLY: f64 = 1.1;

/// The best rule there is, its frames, and how far its mean face lies from the landmarks, pixels.
pub(super) fn wide(
    ways: &[Way],
    subject: &Subject<'_>,
    evidence: &Evidence<'_>,
) -> Option<(Rule, BTreeMap<u32, u32>, f64)> {
    let mut tried: Vec<(usize, f64, f64)> = Vec::new();
    let coarse = (COARSE_SECS * subject.fps).floor().max(1.0);
    for (index, way) in ways.iter().enumerate().filter(|(_, w)| !w.is_named()) {
        for step in steps(way, subject) {
            let free = f64::from(subject.frames) - 1.0 - step * way.span() as f64;
            // A few images may lie beyond either end.
            let slack = 2.0 * step.max(1.0);
            let count = ((free + 2.0 * slack) / coarse).ceil().max(0.0) as usize;
            tried.extend((0..=count).map(|i| (index, step, i as f64 * coarse - slack)));
        }
    }
    // Where there are too many, every n-th is tried; neighbours are looked at below.
    let every = tried.len().div_ceil(MOST_TRIED).max(1);
    let tried: Vec<_> = tried.into_iter().step_by(every).collect();
    let mut ranked = ranked(&tried, ways, subject, evidence);
    ranked.truncate(REFINED);
    for reach in [coarse * every as f64 / 2.0, 2.0, 1.0, 0.5] {
        let around: Vec<(usize, f64, f64)> = ranked
            .iter()
            .flat_map(|&((index, step, offset), _)| {
                let tilt = reach / (ways[index].span() as f64).max(1.0);
                let steps = if step.fract() == 0.0 { vec![step] } else { vec![step - tilt, step, step + tilt] };
                let offsets = [-reach, -0.5 * reach, 0.0, 0.5 * reach, reach];
                steps.into_iter().flat_map(move |s| offsets.map(|o| (index, s, snapped(s, offset + o))))
            })
            .collect();
        ranked = self::ranked(&around, ways, subject, evidence);
        ranked.truncate(REFINED);
    }
    let mut last: Vec<(usize, f64, f64)> = ranked.into_iter().map(|(tried, _)| tried).collect();
    for (index, step, offset) in last.clone() {
        if step.fract() != 0.0 && (step - step.round()).abs() < NEARLY && step.round() > 0.0 {
            last.extend([-1.0, 0.0, 1.0].map(|o| (index, step.round(), offset.round() + o)));
        }
    }
    let exact = last.into_iter().filter_map(|(index, step, offset)| {
        let rule = ways[index].rule(offset, step);
        let frames = ways[index].frames(&rule, subject);
        let score = evidence.score(&frames, EXACT)?;
        Some((rule, frames, score.error_px))
    });
    let exact: Vec<_> = exact.collect();
    let best = exact.iter().map(|e| e.2).fold(f64::INFINITY, f64::min);
    // Pictures are counted in whole frames unless something else fits clearly better.
    let chosen = |whole: bool| {
        let of_kind = exact.iter().filter(move |e| !whole || e.0.step.fract() == 0.0);
        of_kind.min_by(|a, b| a.2.total_cmp(&b.2)).filter(|e| e.2 <= CLEARLY * best)
    };
    chosen(true).or_else(|| chosen(false)).cloned()
}

/// Whole steps have whole offsets.
fn snapped(step: f64, offset: f64) -> f64 {
    if step.fract() == 0.0 { offset.round() } else { offset }
}

/// Steps that fit into the take.
fn steps(way: &Way, subject: &Subject<'_>) -> Vec<f64> {
    let span = way.span() as f64;
    let last = f64::from(subject.frames.saturating_sub(1));
    if span < 1.0 {
        return vec![1.0];
    }
    let most = (last / span).floor().clamp(1.0, 60.0) as u32;
    let mut steps: Vec<f64> = (1..=most).map(f64::from).collect();
    // Pictures a second, also where numbers are times in milliseconds, microseconds or nanoseconds.
    let by_rate = RATES.iter().map(|rate| subject.fps / rate).filter(|s| s.fract() > 1e-3);
    let by_time = [1.0, 1e3, 1e6, 1e9].map(|unit| subject.fps / unit);
    steps.extend(by_rate.chain(by_time).chain([last / span]));
    steps.retain(|s| (0.5..=last + 4.0 * s.max(1.0)).contains(&(s * span)));
    steps
}

type Ranked = Vec<((usize, f64, f64), f64)>;

fn ranked(tried: &[(usize, f64, f64)], ways: &[Way], subject: &Subject<'_>, evidence: &Evidence<'_>) -> Ranked {
    let frames: Vec<BTreeMap<u32, u32>> = tried
        .iter()
        .map(|&(index, step, offset)| {
            let way = &ways[index];
            let frames = way.frames(&way.rule(offset, step), subject);
            // Most images have to be frames of the take.
            if frames.len() * 5 >= way.images.min(subject.frames as usize) * 4 { frames } else { BTreeMap::new() }
        })
        .collect();
    let scores = evidence.scores(&frames, QUICK);
    let known = tried.iter().zip(scores).filter_map(|(&t, s)| Some((t, s?.error_px)));
    let mut ranked: Ranked = known.collect();
    ranked.sort_by(|a, b| a.1.total_cmp(&b.1));
    ranked
}
