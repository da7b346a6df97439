//! Key frames made exact: every point is found again by its own patch, then poses, points and lens are adjusted together.
//!
//! A feature detector places the same point in two pictures with half a pixel of scatter. Here one view of each point,
//! the middle one, says what the point looks like; in all others its patch is found by comparing grey values, which
//! scatters by less than a tenth. Pictures that the matcher did not compare are searched too where the cameras stand
//! close, so that few pairs are enough.

use std::collections::BTreeMap;

use glam::{DMat2, DVec2, DVec3};
use rayon::prelude::*;
use risorius_formats::colmap::{Point2d, Point3d};
use risorius_formats::{Intrinsics, Isometry};

use super::adjust::{LENS, LensPrior, Observation, Outcome, Scene};
use super::model::TakeModel;
use super::patch::{SAME, Template};
use super::picture::Picture;

/// Points are looked for in cameras that see them from at most this far away in direction, though no match says so: radians.
const NEAR_RAD: f64 = 0.15;
/// Matched views are searched up to this far, radians.
const FAR_RAD: f64 = 0.80;
/// Views of a point at most.
const MOST_VIEWS: usize = 32;
/// Points at most: the most seen ones are taken.
const MOST_POINTS: usize = 4000;
/// Views that a point needs.
const LEAST_VIEWS: usize = 3;
/// Points that a model needs, or it is left as it is.
pub(crate) const LEAST_POINTS: usize = 40;
/// How far from the prediction a patch may be found, pixels: in the first and the second round.
pub(crate) const REACH_PX: [f64; 2] = [5.0, 2.5];
/// Where a lens number was let go, patches are looked for again so many times.
const AGAIN: usize = 1;
/// A lens number is let go when it moves by this many deviations. Lenses are off by about 1 % of the side, rendered ones
/// not at all: with deviations of half a pixel, 2.4 of them tell the two apart, with larger ones fewer.
const SIGNIFICANT: f64 = 2.2;
/// Distortions of phones and webcams: deviation of k1 and k2.
const K1_SIGMA: f64 = 0.2;
/// Errors that patches have in common make the noise's deviations too small by about this.
pub(crate) const COMMON: f64 = 4.0;

/// What was done to the lens and the key frames.
#[derive(Clone, Debug)]
pub(crate) struct Sharpened {
    /// Median distance of a point from where it was found, pixels.
    pub(crate) median_error_px: f64,
    /// Points and views used.
    pub(crate) points: usize,
    pub(crate) views: usize,
    /// Deviation of the focal length over itself.
    pub(crate) focal_share: f64,
    /// Deviations of the lens numbers, with what patches have in common.
    pub(crate) lens_sigma: [f64; LENS],
    /// What the pictures told of the lens.
    pub(crate) freed: Freed,
    /// What to know.
    pub(crate) notes: Vec<String>,
}

/// Where a point is expected in another camera, and what offsets around it become there.
///
/// The point's surface is taken to face the first camera.
pub(crate) fn expected(
    lens: &Intrinsics,
    from: &Isometry,
    to: &Isometry,
    pixel: DVec2,
    point: DVec3,
) -> Option<(DVec2, DMat2)> {
    const H: f64 = 4.0;
    let depth = from.transform_point(point).z;
    let at = to.transform_point(point);
    if depth <= 1e-9 || at.z <= 1e-9 {
        return None;
    }
    let to_from = to.compose(&from.inverse());
    let middle = lens.project(at);
    let there = |offset: DVec2| {
        let ray = lens.unproject(pixel + offset)?;
        let p = to_from.transform_point(ray.extend(1.0) * depth);
        (p.z > 1e-9).then(|| lens.project(p))
    };
    let across = |axis: DVec2| Some((there(axis * H)? - there(axis * -H)?) / (2.0 * H));
    let warp = DMat2::from_cols(across(DVec2::X)?, across(DVec2::Y)?);
    let inside =
        middle.x >= 0.0 && middle.y >= 0.0 && middle.x < f64::from(lens.width) && middle.y < f64::from(lens.height);
    (inside && warp.is_finite() && (0.25..4.0).contains(&warp.determinant())).then_some((middle, warp))
}

/// A point of the model with the views that the matcher found.
pub(crate) struct Known {
    pub(crate) id: u64,
    pub(crate) position: DVec3,
    pub(crate) views: Vec<(usize, DVec2)>,
    /// Further frames that should see it, in order.
    pub(crate) also: Vec<usize>,
}

/// Where a point is looked for.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Search {
    /// In all cameras that see it from at most this far away in direction, radians …
    pub(crate) near_rad: f64,
    /// … and in those that the matcher found up to this far.
    pub(crate) far_rad: f64,
    /// At most this far from where it is expected, pixels.
    pub(crate) reach_px: f64,
    /// Levels that are searched before the finest, coarse to fine.
    pub(crate) coarse: &'static [usize],
    /// Views of a point at most.
    pub(crate) most_views: usize,
}

/// Numbers of the lens that the pictures told, besides focal length and k1.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Freed {
    pub(crate) centre: bool,
    pub(crate) k2: bool,
}

/// Refines the model by the pictures of its frames; `None` where there is too little to hold on to.
pub(crate) fn sharpen(model: &mut TakeModel, pictures: &BTreeMap<u32, Picture>) -> Option<Sharpened> {
    // One lens only: a take has one camera.
    if model.lenses.len() != 1 {
        return None;
    }
    let (&lens_id, lens) = model.lenses.first_key_value()?;
    let frames: Vec<u32> = model.frames.keys().copied().filter(|f| pictures.contains_key(f)).collect();
    let known = known_points(model, &frames);
    if known.len() < LEAST_POINTS || frames.len() < 3 {
        return None;
    }
    let pictures: Vec<&Picture> = frames.iter().map(|f| &pictures[f]).collect();
    let mut scene = Scene {
        lens: *lens,
        poses: frames.iter().map(|f| model.frames[f].camera_from_world).collect(),
        points: known.iter().map(|k| k.position).collect(),
        observations: Vec::new(),
    };
    let look = |scene: &mut Scene, reach: f64| {
        scene.observations = find_views(scene, &known, &pictures, search(reach, MOST_VIEWS));
        usable(scene) >= LEAST_POINTS
    };
    if !look(&mut scene, REACH_PX[0]) {
        return None;
    }
    scene.adjust(prior(&scene.lens, Freed::default()), 0.5, 15);
    if !look(&mut scene, REACH_PX[1]) {
        return None;
    }
    let (mut outcome, mut freed) = settle(&mut scene, Freed::default());
    for _ in 0..AGAIN {
        // Where the lens was held wrong, views near the border were not found or left as wild: they tell the most.
        if freed == Freed::default() || !look(&mut scene, REACH_PX[1]) {
            break;
        }
        (outcome, freed) = settle(&mut scene, freed);
    }
    let notes = vec![lens_note(&scene.lens, &outcome, freed)];
    let sharpened = Sharpened {
        median_error_px: outcome.median_error_px,
        points: usable(&scene),
        views: scene.observations.len(),
        focal_share: COMMON * outcome.lens_sigma[0] / scene.lens.fx,
        lens_sigma: outcome.lens_sigma.map(|s| COMMON * s),
        freed,
        notes,
    };
    write_back(model, lens_id, &frames, &known, &scene);
    Some(sharpened)
}

pub(crate) fn known_points(model: &TakeModel, frames: &[u32]) -> Vec<Known> {
    let mut views: BTreeMap<u64, Vec<(usize, DVec2)>> = BTreeMap::new();
    for (i, frame) in frames.iter().enumerate() {
        for p in &model.frames[frame].points {
            if let Some(id) = p.point3d {
                let list = views.entry(id).or_default();
                // A point that is seen twice in one picture is seen wrongly at least once.
                if list.last().is_none_or(|v| v.0 != i) {
                    list.push((i, DVec2::from(p.position_px)));
                }
            }
        }
    }
    let mut known: Vec<Known> = views
        .into_iter()
        .filter(|(_, v)| v.len() >= 2)
        .filter_map(|(id, views)| {
            Some(Known { id, position: model.points.get(&id)?.position, views, also: Vec::new() })
        })
        .collect();
    if known.len() > MOST_POINTS {
        known.sort_by_key(|k| (std::cmp::Reverse(k.views.len()), k.id));
        known.truncate(MOST_POINTS);
    }
    known.sort_by_key(|k| k.id);
    known
}

/// Finds every point's patch in the views that should show it.
pub(crate) fn find_views(scene: &Scene, known: &[Known], pictures: &[&Picture], search: Search) -> Vec<Observation> {
    let centres: Vec<DVec3> = scene.poses.iter().map(Isometry::camera_center).collect();
    let of_point = |(index, k): (usize, &Known)| -> Vec<Observation> {
        let point = scene.points[index];
        let direction = |frame: usize| (centres[frame] - point).normalize_or_zero();
        let mean = k.views.iter().map(|v| direction(v.0)).sum::<DVec3>().normalize_or_zero();
        let Some(&(reference, pixel)) =
            k.views.iter().max_by(|a, b| direction(a.0).dot(mean).total_cmp(&direction(b.0).dot(mean)))
        else {
            return Vec::new();
        };
        let Some(template) = Template::cut(pictures[reference], 0, pixel, true) else { return Vec::new() };
        let coarse: Vec<Template> =
            search.coarse.iter().filter_map(|&l| Template::cut(pictures[reference], l, pixel, false)).collect();
        let from = &scene.poses[reference];
        let facing = direction(reference);
        let mut views: Vec<(f64, usize)> = (0..scene.poses.len())
            .filter(|&f| f != reference)
            .map(|f| (direction(f).dot(facing).clamp(-1.0, 1.0).acos(), f))
            .filter(|&(angle, f)| {
                let matched = || k.views.binary_search_by_key(&f, |v| v.0).is_ok() || k.also.binary_search(&f).is_ok();
                angle < search.near_rad || (angle < search.far_rad && matched())
            })
            .collect();
        let most = search.most_views;
        if views.len() > most {
            // Evenly from the nearest to the farthest: depth needs the far ones.
            views.sort_by(|a, b| a.0.total_cmp(&b.0));
            views = (0..most).map(|i| views[i * (views.len() - 1) / (most - 1)]).collect();
            views.dedup();
        }
        let mut found: Vec<Observation> = views
            .iter()
            .filter_map(|&(_, f)| {
                let (at, warp) = expected(&scene.lens, from, &scene.poses[f], pixel, point)?;
                let start =
                    coarse.iter().fold(at, |start, t| t.find(pictures[f], start, warp).map_or(start, |m| m.centre));
                let m = template.find_affine(pictures[f], start, warp)?;
                (m.similarity >= SAME && m.centre.distance(at) <= search.reach_px).then_some(Observation {
                    frame: f,
                    point: index,
                    pixel: m.centre,
                })
            })
            .collect();
        found.push(Observation { frame: reference, point: index, pixel });
        if found.len() < LEAST_VIEWS {
            return Vec::new();
        }
        found.sort_by_key(|o| o.frame);
        found
    };
    known.par_iter().enumerate().map(of_point).collect::<Vec<_>>().concat()
}

pub(crate) fn usable(scene: &Scene) -> usize {
    scene.observations.chunk_by(|a, b| a.point == b.point).count()
}

pub(crate) fn search(reach_px: f64, most_views: usize) -> Search {
    Search { near_rad: NEAR_RAD, far_rad: FAR_RAD, reach_px, coarse: &[], most_views }
}

pub(crate) fn prior(lens: &Intrinsics, freed: Freed) -> LensPrior {
    let side = f64::from(lens.width.max(lens.height));
    let centre = if freed.centre { 0.03 * side } else { 0.0 };
    LensPrior([0.5 * lens.fx, centre, centre, K1_SIGMA, if freed.k2 { K1_SIGMA } else { 0.0 }])
}

/// The last adjustment: wild views leave, and the lens gets the numbers that the pictures can tell, besides those that
/// they told before.
pub(crate) fn settle(scene: &mut Scene, freed: Freed) -> (Outcome, Freed) {
    let mut freed = freed;
    let first = scene.adjust(prior(&scene.lens, freed), 0.3, 15);
    let limit = (6.0 * first.median_error_px).max(0.5);
    drop_beyond(scene, limit);
    // The median length of a 2-D normal deviate is 1.18 σ.
    let sigma = (first.median_error_px / 1.18).max(0.03);
    let mut best = scene.adjust(prior(&scene.lens, freed), sigma, 15);
    for what in [Freed { centre: true, k2: false }, Freed { centre: false, k2: true }] {
        let trial_freed = Freed { centre: freed.centre || what.centre, k2: freed.k2 || what.k2 };
        if trial_freed == freed {
            continue;
        }
        let mut trial = scene.clone();
        let outcome = trial.adjust(prior(&scene.lens, trial_freed), sigma, 20);
        let (now, was) = (numbers(&trial.lens), numbers(&scene.lens));
        let moved = |k: usize| (now[k] - was[k]).abs() / (COMMON * outcome.lens_sigma[k]);
        let moved = if what.centre { moved(1).max(moved(2)) } else { moved(4) };
        if moved > SIGNIFICANT && outcome.loss < best.loss {
            *scene = trial;
            best = outcome;
            freed = trial_freed;
        }
    }
    (best, freed)
}

pub(crate) fn numbers(lens: &Intrinsics) -> [f64; LENS] {
    [lens.fx, lens.cx, lens.cy, lens.distortion.radial[0], lens.distortion.radial[1]]
}

pub(crate) fn lens_note(lens: &Intrinsics, outcome: &Outcome, freed: Freed) -> String {
    let [focal, cx, cy, k1, second] = numbers(lens);
    let sigma = outcome.lens_sigma.map(|s| COMMON * s);
    let centre = if freed.centre {
        format!("principal point ({cx:.1} ± {:.1}, {cy:.1} ± {:.1}) from the pictures", sigma[1], sigma[2])
    } else {
        "principal point in the middle: the pictures do not contradict".to_owned()
    };
    let second = if freed.k2 { format!(", k2 {second:.4}") } else { String::new() };
    format!("focal length {focal:.1} ± {:.1} px, {centre}, k1 {k1:.4} ± {:.4}{second}", sigma[0], sigma[3])
}

pub(crate) fn drop_beyond(scene: &mut Scene, limit_px: f64) {
    let errors = scene.errors_px();
    let mut kept: Vec<Observation> =
        scene.observations.iter().zip(&errors).filter(|(_, e)| **e <= limit_px).map(|(o, _)| *o).collect();
    kept = kept.chunk_by(|a, b| a.point == b.point).filter(|g| g.len() >= LEAST_VIEWS).flatten().copied().collect();
    scene.observations = kept;
}

pub(crate) fn write_back(model: &mut TakeModel, lens_id: u32, frames: &[u32], known: &[Known], scene: &Scene) {
    model.lenses.insert(lens_id, scene.lens);
    let mut points: Vec<Vec<Point2d>> = vec![Vec::new(); frames.len()];
    let mut solid: BTreeMap<u64, Point3d> = BTreeMap::new();
    let errors = scene.errors_px();
    let mut at = 0;
    for group in scene.observations.chunk_by(|a, b| a.point == b.point) {
        let k = &known[group[0].point];
        let mut track = Vec::with_capacity(group.len());
        for o in group {
            // Image ids are frame + 1.
            track.push((frames[o.frame] + 1, points[o.frame].len() as u32));
            points[o.frame].push(Point2d { position_px: o.pixel.to_array(), point3d: Some(k.id) });
        }
        let error_px = errors[at..at + group.len()].iter().sum::<f64>() / group.len() as f64;
        at += group.len();
        let rgb = model.points.get(&k.id).map_or([128; 3], |p| p.rgb);
        solid.insert(k.id, Point3d { position: scene.points[group[0].point], rgb, error_px, track });
    }
    model.points = solid;
    for ((frame, pose), points) in frames.iter().zip(&scene.poses).zip(points) {
        if let Some(placed) = model.frames.get_mut(frame) {
            placed.camera_from_world = *pose;
            placed.points = points;
        }
    }
    // Frames without a picture keep their poses but not features of points that are gone.
    for placed in model.frames.values_mut() {
        for p in &mut placed.points {
            p.point3d = p.point3d.filter(|id| model.points.contains_key(id));
        }
    }
}
