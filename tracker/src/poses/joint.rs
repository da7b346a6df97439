//! The last adjustment: lens, points and key frames together with a spread of the frames between them.
//!
//! The lens of a smooth arc is told badly by few key frames: a centre that is a pixel off is almost a turn of all cameras.
//! Frames between are found again like key frames, from the same reference views, and adjusted with them, starting from
//! where all are. Then every frame is placed once more where its patches were found. The result is kept if the frames
//! that took no part in the adjustment do not fit worse, and if the lens stayed within its deviations.

use std::collections::{BTreeMap, BTreeSet};

use rayon::prelude::*;
use risorius_formats::Isometry;

use super::adjust::{LENS, Scene};
use super::follow::{Follow, Followed};
use super::model::TakeModel;
use super::picture::Picture;
use super::sharpen::{
    COMMON, LEAST_POINTS, REACH_PX, Sharpened, find_views, known_points, lens_note, numbers, search, settle, usable,
    write_back,
};
use super::triangulate::median;

/// Frames between key frames that are adjusted with them.
pub(crate) const SPREAD: usize = 100;
/// Views of a point at most.
const MOST_VIEWS: usize = 48;
/// The lens may move by so many deviations.
const WITHIN: f64 = 3.0;

/// The frames that took no part may fit this much worse. Their patches were cut where points had projected before, which
/// speaks for how things were.
const NOT_WORSE: f64 = 1.01;

/// Frames between the placed ones, spread evenly in time; half of them at most, as the others judge the result.
pub(crate) fn spread(frames: usize, placed: &BTreeMap<u32, Isometry>, count: usize) -> BTreeSet<u32> {
    let free: Vec<u32> = (0..frames as u32).filter(|f| !placed.contains_key(f)).collect();
    let count = count.min(free.len() / 2);
    (0..count).map(|i| free[(2 * i + 1) * free.len() / (2 * count)]).collect()
}

/// What came of the adjustment.
#[derive(Clone, Debug)]
pub(crate) struct Joint {
    /// Whether the model and the poses are the new ones.
    pub(crate) kept: bool,
    /// Deviation of the focal length over itself.
    pub(crate) focal_share: f64,
    /// What to know.
    pub(crate) notes: Vec<String>,
}

/// Adjusts `model` and the `followed` frames together, if that helps; `None` where there is too little.
pub(crate) fn refine(
    model: &mut TakeModel,
    key_pictures: &BTreeMap<u32, Picture>,
    sharpened: &Sharpened,
    follow: &Follow<'_>,
    followed: &mut Followed,
) -> Option<Joint> {
    let (&lens_id, lens) = model.lenses.first_key_value()?;
    let keys: Vec<u32> = model.frames.keys().copied().filter(|f| key_pictures.contains_key(f)).collect();
    let between: Vec<u32> = followed.pictures.keys().copied().filter(|f| followed.poses.contains_key(f)).collect();
    let mut known = known_points(model, &keys);
    if known.len() < LEAST_POINTS || between.is_empty() {
        return None;
    }
    // What the nearest key frames see is there too.
    for (i, frame) in between.iter().enumerate() {
        let near: Vec<usize> =
            follow.nearest_keys(&followed.poses[frame]).iter().filter_map(|key| keys.binary_search(key).ok()).collect();
        for k in &mut known {
            if near.iter().any(|key| k.views.binary_search_by_key(key, |v| v.0).is_ok()) {
                k.also.push(keys.len() + i);
            }
        }
    }
    let pictures: Vec<&Picture> =
        keys.iter().map(|f| &key_pictures[f]).chain(between.iter().map(|f| &followed.pictures[f])).collect();
    let mut scene = Scene {
        lens: *lens,
        poses: keys
            .iter()
            .map(|f| model.frames[f].camera_from_world)
            .chain(between.iter().map(|f| followed.poses[f]))
            .collect(),
        points: known.iter().map(|k| k.position).collect(),
        observations: Vec::new(),
    };
    scene.observations = find_views(&scene, &known, &pictures, search(REACH_PX[1], MOST_VIEWS));
    if usable(&scene) < LEAST_POINTS {
        return None;
    }
    let views = scene.observations.len();
    let (outcome, freed) = settle(&mut scene, sharpened.freed);
    let (was, now) = (numbers(lens), numbers(&scene.lens));
    let strayed = (0..LENS)
        .filter(|&k| sharpened.lens_sigma[k] > 0.0)
        .map(|k| (now[k] - was[k]).abs() / sharpened.lens_sigma[k])
        .fold(0.0, f64::max);
    let mut trial = model.clone();
    // Only key frames keep their features.
    let poses = scene.poses[..keys.len()].to_vec();
    let observations = scene.observations.iter().copied().filter(|o| o.frame < keys.len()).collect();
    let key_scene = Scene { lens: scene.lens, poses, points: scene.points, observations };
    write_back(&mut trial, lens_id, &keys, &known, &key_scene);
    let moved = follow.moved(&trial)?;
    let again: BTreeMap<u32, (Isometry, f64)> = followed
        .poses
        .par_iter()
        .filter_map(|(frame, pose)| Some((*frame, follow.again(&moved, pose, followed.sights.get(frame)?)?)))
        .collect();
    // Frames that took no part say whether it holds for them too.
    let apart = |frame: &u32| !followed.pictures.contains_key(frame);
    let errors = |new: bool| {
        let of = |(frame, (_, error)): (&u32, &(Isometry, f64))| {
            if new { *error } else { followed.errors_px.get(frame).copied().unwrap_or(*error) }
        };
        median(&mut again.iter().filter(|(f, _)| apart(f)).map(of).collect::<Vec<_>>()).unwrap_or(0.0)
    };
    let (before, after) = (errors(false), errors(true));
    let all = again.len() == followed.poses.len();
    let kept = all && after <= NOT_WORSE * before && strayed <= WITHIN;
    let note = format!(
        "key frames, points and lens adjusted with {} frames between in {views} views: median error of the others {before:.3} px before, {after:.3} px after, the lens moved by {strayed:.1} deviations{}",
        between.len(),
        if kept { "" } else { "; left as it was" }
    );
    let mut notes = vec![note];
    if kept {
        notes.push(lens_note(&key_scene.lens, &outcome, freed));
        *model = trial;
        for (frame, (pose, error)) in again {
            followed.poses.insert(frame, pose);
            followed.errors_px.insert(frame, error);
        }
    }
    Some(Joint { kept, focal_share: COMMON * outcome.lens_sigma[0] / key_scene.lens.fx, notes })
}

#[cfg(test)]
#[path = "joint_tests.rs"]
mod tests;
