//! The head's pose from its skin: places with texture on the face are found again in other key frames, adjusted together
//! with the poses, and then place every frame, as the background does for a moving camera.
//!
//! Landmarks of a network scatter by a pixel or two and lean with the view; skin found by its grey values does neither.
//! What moves with the expression is an outlier to the rest of the face: mouth and eyes are left out from the start.

use std::collections::{BTreeMap, BTreeSet};

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use risorius_formats::polygon::{convex_hull, hull_contains};
use risorius_formats::{Intrinsics, Isometry, Landmarks68, Reporter, Take};

use super::adjust::{LENS, LensPrior, Scene};
use super::follow::{Follow, Followed};
use super::model::{PlacedFrame, TakeModel};
use super::patch::Template;
use super::picture::Picture;
use super::sharpen::{Known, Search, drop_beyond, find_views, usable, write_back};
use crate::error::Result;

/// Distance of the places that are tried, in widths of the face.
const GRID: f64 = 1.0 / 28.0;
/// Places that a key frame gives.
const PLACES: usize = 70;
/// Least strength of a place: grey values × 16 per pixel, squared. Skin is soft.
const STRONG: f32 = 60.0;
/// Points that are needed.
const LEAST_POINTS: usize = 40;
/// Rounds: the first look far, since the landmarks' poses are a degree or two off.
const ROUNDS: [Search; 3] = [
    Search { near_rad: 0.35, far_rad: 0.35, reach_px: 14.0, coarse: &[2, 1], most_views: 32 },
    Search { near_rad: 0.5, far_rad: 0.5, reach_px: 6.0, coarse: &[1], most_views: 32 },
    Search { near_rad: 0.6, far_rad: 0.6, reach_px: 3.0, coarse: &[], most_views: 32 },
];

/// What the skin said.
pub(crate) struct Skin {
    /// Poses of key frames and of those placed by them.
    pub(crate) poses: BTreeMap<u32, Isometry>,
    /// Points and their views.
    pub(crate) points: usize,
    pub(crate) views: usize,
    /// Median distance of the points from where they were found, pixels.
    pub(crate) error_px: f64,
    /// Key frames and their points.
    pub(crate) model: TakeModel,
}

/// Head poses by the skin; `None` where it shows too little.
///
/// `poses` are `camera_from_head`, `face` the 68 points of the mean face in the head frame.
pub(crate) fn refine(
    take: &Take,
    lens: &Intrinsics,
    poses: &BTreeMap<u32, Isometry>,
    landmarks: &BTreeMap<u32, &Landmarks68>,
    face: &[DVec3],
    pictures: &BTreeMap<u32, Picture>,
    reporter: &dyn Reporter,
) -> Result<Option<Skin>> {
    let frames: Vec<u32> =
        pictures.keys().copied().filter(|f| poses.contains_key(f) && landmarks.contains_key(f)).collect();
    if frames.len() < 5 {
        return Ok(None);
    }
    reporter.stage("follow the skin", None);
    let pictures_of: Vec<&Picture> = frames.iter().map(|f| &pictures[f]).collect();
    let places: Vec<Vec<(DVec2, DVec3)>> =
        frames.par_iter().map(|f| skin_places(lens, &poses[f], landmarks[f], face, &pictures[f])).collect();
    let mut known = Vec::new();
    for (i, places) in places.iter().enumerate() {
        for &(pixel, position) in places {
            known.push(Known { id: known.len() as u64 + 1, position, views: vec![(i, pixel)], also: Vec::new() });
        }
    }
    let mut scene = Scene {
        lens: *lens,
        poses: frames.iter().map(|f| poses[f]).collect(),
        points: known.iter().map(|k| k.position).collect(),
        observations: Vec::new(),
    };
    let mut error_px = 0.0;
    for search in ROUNDS {
        scene.observations = find_views(&scene, &known, &pictures_of, search);
        if usable(&scene) < LEAST_POINTS {
            return Ok(None);
        }
        // The lens is held: a face alone does not tell it.
        let held = LensPrior([0.0; LENS]);
        let first = scene.adjust(held, 1.0, 15);
        drop_beyond(&mut scene, (5.0 * first.median_error_px).max(1.0));
        if usable(&scene) < LEAST_POINTS {
            return Ok(None);
        }
        error_px = scene.adjust(held, (first.median_error_px / 1.18).max(0.1), 15).median_error_px;
    }
    let (points, views) = (usable(&scene), scene.observations.len());
    let placed = |f: &u32| (*f, PlacedFrame { lens: 1, camera_from_world: poses[f], points: Vec::new() });
    let mut model = TakeModel {
        lenses: BTreeMap::from([(1, *lens)]),
        frames: frames.iter().map(placed).collect(),
        points: BTreeMap::new(),
    };
    write_back(&mut model, 1, &frames, &known, &scene);
    let Some(follow) = Follow::new(&model, pictures, &take.frames, |_, _| false) else { return Ok(None) };
    let Followed { poses: mut found, .. } = follow.run(&model.poses(), take, &BTreeSet::new(), reporter)?;
    // Where the tracker saw no face there is none.
    found.retain(|f, _| poses.contains_key(f));
    found.extend(model.poses());
    Ok(Some(Skin { poses: found, points, views, error_px, model }))
}

/// Textured places on the rigid part of the face, with their places in the head.
fn skin_places(
    lens: &Intrinsics,
    pose: &Isometry,
    landmarks: &Landmarks68,
    face: &[DVec3],
    picture: &Picture,
) -> Vec<(DVec2, DVec3)> {
    let at = |i: usize| DVec2::new(f64::from(landmarks.points_px[i][0]), f64::from(landmarks.points_px[i][1]));
    let grown = |range: std::ops::Range<usize>, by: f64| {
        let points: Vec<DVec2> = range.map(at).collect();
        let middle = points.iter().sum::<DVec2>() / points.len() as f64;
        let points: Vec<DVec2> = points.into_iter().map(|p| middle + (p - middle) * by).collect();
        convex_hull(&points)
    };
    // Upwards from the nose to the brows and as far again: the forehead.
    let up = (at(27) - at(33)) * 0.9;
    let region: Vec<DVec2> =
        (1..4).chain(13..16).chain(17..27).chain(31..36).map(at).chain((17..27).map(|i| at(i) + up)).collect();
    let region = convex_hull(&region);
    let holes = [grown(36..42, 1.8), grown(42..48, 1.8), grown(48..60, 1.3)];
    let width = at(1).distance(at(15)).max(20.0);
    let step = (GRID * width).max(4.0);
    let (mut lo, mut hi) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    for p in &region {
        lo = lo.min(*p);
        hi = hi.max(*p);
    }
    let projected: Vec<(DVec2, f64)> =
        face.iter().map(|p| pose.transform_point(*p)).map(|p| (lens.project(p), p.z)).collect();
    let mut found: Vec<(f32, DVec2)> = Vec::new();
    let mut y = lo.y;
    while y <= hi.y {
        let mut x = lo.x;
        while x <= hi.x {
            let p = DVec2::new(x, y);
            if hull_contains(&region, p) && !holes.iter().any(|h| hull_contains(h, p)) {
                let template = Template::cut(picture, 0, p, true).filter(|t| t.strength >= STRONG);
                found.extend(template.map(|t| (t.strength, p)));
            }
            x += step;
        }
        y += step;
    }
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    found.truncate(PLACES);
    found
        .into_iter()
        .filter_map(|(_, p)| {
            // Depth of the face there, from the landmarks around it.
            let (mut sum, mut weight) = (0.0, 0.0);
            for (q, z) in &projected {
                let w = 1.0 / (p.distance_squared(*q) + (0.05 * width).powi(2)).powi(2);
                sum += w * z;
                weight += w;
            }
            let ray = lens.unproject(p)?.extend(1.0);
            let place = pose.inverse().transform_point(ray * (sum / weight));
            place.is_finite().then_some((p, place))
        })
        .collect()
}
