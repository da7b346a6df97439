//! Which frame of a take each image of a foreign COLMAP model is.
//!
//! For an image folder, pictures are matched by file name. Elsewhere only numbers tell, and those are ambiguous: counted from
//! 0 or 1, from the counter of a camera, every n-th frame, one of several folders. Each way is tried, and the landmarks
//! decide: the way whose mean face fits is taken, the usual one where several fit alike. What was taken is said.

mod names;
mod rule;
mod score;
mod search;

use std::collections::BTreeMap;

use risorius_formats::{Camera, Track};

pub use self::rule::Numbering;
pub(crate) use self::rule::{Rule, Way};
use self::score::Evidence;

/// Frames that a score is made of in the end, and while many ways are tried.
const EXACT: usize = 1200;
const QUICK: usize = 60;
/// The usual way counts as long as no other fits by more than this share (and this many pixels) better.
const CLEARLY: f64 = 1.04;
const CLEARLY_PX: f64 = 0.02;
/// Names of files say more than numbers.
const CLEARLY_AGAINST_NAMES: f64 = 1.5;
/// A mean face farther than this share of the distance between the outer eye corners sets off the wide search.
const DOUBTFUL: f64 = 0.03;
/// Offsets to either side that are tried for pictures several frames apart.
const MOST_OFFSETS: i32 = 60;
/// What the wide search finds has to fit so many times better.
const FOUND: f64 = 2.0;

/// What is known of the take.
pub(crate) struct Subject<'a> {
    /// Number of frames.
    pub(crate) frames: u32,
    /// Frames per second.
    pub(crate) fps: f64,
    /// The names of the pictures of an image folder, frame by frame.
    pub(crate) pictures: Option<&'a [String]>,
    /// The landmarks, where there are any.
    pub(crate) track: Option<&'a Track>,
    /// Rows below this confidence are lost.
    pub(crate) min_confidence: f32,
}

/// What was decided.
#[derive(Clone, Debug)]
pub(crate) struct Matched {
    /// Image by frame.
    pub(crate) frames: BTreeMap<u32, u32>,
    /// How frames were found.
    pub(crate) rule: Rule,
    /// Distance of the mean face from the landmarks, pixels, where it could be told.
    pub(crate) error_px: Option<f64>,
    /// The way that would have been usual, and its distance, where another was taken.
    pub(crate) instead_of: Option<(Rule, f64)>,
    /// A way that fits clearly better than what the user stated.
    pub(crate) better: Option<(Rule, f64)>,
}

/// Matches the images of a model (id, name, camera at the take's size) to the frames of the take; `None` where nothing fits.
pub(crate) fn decide(
    images: &BTreeMap<u32, String>,
    cameras: &BTreeMap<u32, Camera>,
    subject: &Subject<'_>,
    numbering: &Numbering,
) -> Option<Matched> {
    let mut groups = names::by_folder(images.iter().map(|(id, name)| (*id, name.as_str())));
    if let Some(folder) = &numbering.folder {
        groups.retain(|name, _| is_folder(name, folder));
    }
    let ways = rule::ways(&groups, subject);
    let evidence = subject.track.map(|track| Evidence::new(track, subject.min_confidence, cameras));
    let usual = best(candidates(&ways, subject, numbering), evidence.as_ref());
    let Some(evidence) = evidence else { return usual };
    let doubtful = evidence.eye_distance_px().map_or(f64::INFINITY, |eyes| DOUBTFUL * eyes);
    let error = usual.as_ref().and_then(|m| m.error_px);
    if numbering.is_stated() {
        // The user knows best, and is told where the landmarks disagree.
        let free = Numbering { folder: numbering.folder.clone(), ..Numbering::default() };
        let other = best(candidates(&ways, subject, &free), Some(&evidence));
        return usual.map(|stated| {
            let better = other.and_then(|o| Some((o.rule, o.error_px?)));
            let better = better.filter(|(_, px)| stated.error_px.is_some_and(|e| e > CLEARLY_AGAINST_NAMES * px));
            Matched { better, ..stated }
        });
    }
    if error.is_some_and(|e| e <= doubtful) {
        return usual.map(|matched| with_best_offset(matched, &ways, subject, &evidence));
    }
    let found = search::wide(&ways, subject, &evidence);
    match (found, usual) {
        (Some((rule, frames, px)), usual) if error.is_none_or(|e| e > FOUND * px) && px <= doubtful => {
            let instead_of = usual.and_then(|u| Some((u.rule, u.error_px?)));
            Some(Matched { frames, rule, error_px: Some(px), instead_of, better: None })
        }
        (_, usual) => usual,
    }
}

/// Where pictures lie several frames apart, names do not tell with which frame they begin: the offset that fits is taken.
fn with_best_offset(matched: Matched, ways: &[Way], subject: &Subject<'_>, evidence: &Evidence<'_>) -> Matched {
    let (rule, Some(px)) = (&matched.rule, matched.error_px) else { return matched };
    let Some(way) = ways.iter().find(|w| w.is_of(rule)).filter(|_| rule.step > 1.0) else { return matched };
    let reach = rule.step.ceil() as i32;
    let every = (reach / MOST_OFFSETS).max(1);
    let offsets = (-reach..=reach).step_by(every as usize).map(|o| rule.offset + f64::from(o)).filter(|o| *o >= 0.0);
    let of = |offset: f64| {
        let rule = way.rule(offset, rule.step);
        let frames = way.frames(&rule, subject);
        // As many images as before have to be frames of the take, but for one at either end.
        (frames.len() + 2 >= matched.frames.len())
            .then(|| Some((evidence.score(&frames, EXACT)?.error_px, rule, frames)))?
    };
    match offsets.filter_map(of).min_by(|a, b| a.0.total_cmp(&b.0)) {
        Some((better, rule, frames)) if CLEARLY * better + CLEARLY_PX < px => {
            Matched { frames, rule, error_px: Some(better), ..matched }
        }
        _ => matched,
    }
}

/// The folder in the name of a model's image.
pub(crate) fn folder_of(name: &str) -> &str {
    names::split(name).0
}

/// Whether `name`, a folder of the model, is what the user calls `folder`: the whole of it or its end.
fn is_folder(name: &str, folder: &str) -> bool {
    let folder = folder.trim_matches(['/', '\\']);
    name == folder || name.strip_suffix(folder).is_some_and(|rest| rest.ends_with(['/', '\\']))
}

/// The ways worth a first look, the most usual first.
fn candidates(ways: &[Way], subject: &Subject<'_>, numbering: &Numbering) -> Vec<(Rule, BTreeMap<u32, u32>)> {
    let mut all = Vec::new();
    for way in ways {
        for rule in rule::usual(way, subject, numbering) {
            let frames = way.frames(&rule, subject);
            if !frames.is_empty() && all.iter().all(|(_, known)| *known != frames) {
                all.push((rule, frames));
            }
        }
    }
    all
}

/// The candidate whose mean face fits; the first one unless another is clearly better.
fn best(candidates: Vec<(Rule, BTreeMap<u32, u32>)>, evidence: Option<&Evidence<'_>>) -> Option<Matched> {
    let frames: Vec<BTreeMap<u32, u32>> = candidates.iter().map(|c| c.1.clone()).collect();
    let taken = |(rule, frames): (Rule, BTreeMap<u32, u32>), error_px| Matched {
        frames,
        rule,
        error_px,
        instead_of: None,
        better: None,
    };
    let Some(evidence) = evidence else { return candidates.into_iter().next().map(|c| taken(c, None)) };
    let quick = evidence.scores(&frames, QUICK);
    let mut order: Vec<usize> = (0..frames.len()).filter(|&i| quick[i].is_some()).collect();
    let px = |scores: &[Option<score::Score>], i: usize| scores[i].map_or(f64::INFINITY, |s| s.error_px);
    order.sort_by(|&a, &b| px(&quick, a).total_cmp(&px(&quick, b)));
    // The best few and the usual one are looked at with all frames.
    let mut finalists: Vec<usize> = order.iter().copied().take(8).collect();
    let first = order.iter().copied().min();
    finalists.extend(first);
    finalists.sort_unstable();
    finalists.dedup();
    let exact: Vec<(usize, f64)> =
        finalists.into_iter().filter_map(|i| Some((i, evidence.score(&frames[i], EXACT)?.error_px))).collect();
    // A way that places half as many images as another has less to miss.
    let most = exact.iter().map(|(i, _)| share(&candidates[*i])).fold(0.0, f64::max);
    let whole: Vec<(usize, f64)> = exact.into_iter().filter(|(i, _)| share(&candidates[*i]) >= 0.8 * most).collect();
    let least = whole.iter().copied().min_by(|a, b| a.1.total_cmp(&b.1));
    let (Some((winner, px)), Some((usual, usual_px))) = (least, whole.first().copied()) else {
        // Nothing can be told: the usual way.
        return candidates.into_iter().next().map(|c| taken(c, None));
    };
    let clearly = if candidates[usual].0.by_name() { CLEARLY_AGAINST_NAMES } else { CLEARLY };
    let (index, error, instead) = if usual_px <= clearly * px + CLEARLY_PX {
        (usual, usual_px, None)
    } else {
        (winner, px, Some((candidates[usual].0.clone(), usual_px)))
    };
    candidates.into_iter().nth(index).map(|c| Matched { instead_of: instead, ..taken(c, Some(error)) })
}

/// The share of its images that a candidate places.
fn share((rule, frames): &(Rule, BTreeMap<u32, u32>)) -> f64 {
    frames.len() as f64 / rule.images.max(1) as f64
}

#[cfg(test)]
mod tests;
