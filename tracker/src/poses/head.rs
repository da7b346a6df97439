//! A still camera and a moving head: the head is taken for the world, and its pose for the camera.
//!
//! The world is the head frame in metres (x to the image's right, y down, z away from the camera, for a face that looks
//! into it). A tracker's pose is that of a generic face; here the person's own rigid points (nose, eye corners) and all
//! poses are adjusted together, then every frame's pose is refined by itself and smoothed over a few frames.

use std::collections::BTreeMap;

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use risorius_formats::head_hull::head_hull;
use risorius_formats::{Camera, Intrinsics, Isometry, Reporter, Take, Track, TrackRow};

use super::depths::Head;
use super::focal::table_camera;
use super::model::{PlacedFrame, TakeModel};
use super::picture::Picture;
use super::refine::{Bundle, FrameView, RigidPoint, refine_pose};
use super::skin;
use super::smooth::smooth;
use super::triangulate::{View, median, triangulate};
use crate::error::{Result, TrackerError};

/// Focal length in longer sides of the picture, where nothing is known.
const DEFAULT_FOCAL: f64 = 1.2;
/// Frames that the joint adjustment uses at most.
const MOST_ADJUSTED: usize = 1500;
/// How far the shape may stray from the tracker's, metres.
const SHAPE_SIGMA_M: f64 = 0.005;
/// Poses from the skin are less noisy: their window is so much smaller.
const SKIN_SMOOTH: f64 = 0.5;
/// Half the window of the temporal smoothing, seconds.
pub const SMOOTH_SECS: f64 = 0.06;

/// Landmarks that hardly move against the skull, with factors on their noise: what moves with the expression may help,
/// but not decide. The ends of the jaw line lie far behind the nose: without them nodding and a raised nose look alike.
const RIGID: [(usize, f64); 15] = [
    (27, 1.0),
    (28, 1.0),
    (29, 1.0),
    (30, 1.0),
    (36, 1.0),
    (39, 1.0),
    (42, 1.0),
    (45, 1.0),
    (0, 1.5),
    (16, 1.5),
    (1, 2.0),
    (15, 2.0),
    (2, 3.0),
    (14, 3.0),
    (33, 2.0),
];

/// How the head route works.
#[derive(Clone, Copy, Debug)]
pub struct HeadOptions {
    /// Focal length, pixels; `None` takes the table's, or 1.2 × the longer side.
    pub focal_px: Option<f64>,
    /// Half the window of the temporal smoothing, seconds; 0 is off.
    pub smooth_secs: f64,
    /// Whether poses and shape are refined; the table's own poses are taken otherwise.
    pub refine: bool,
    /// Rows below this confidence are lost.
    pub min_confidence: f32,
}

/// What the head route found.
#[derive(Clone, Debug)]
pub struct HeadRoute {
    /// One lens, and a pose for every frame with a valid row.
    pub model: TakeModel,
    /// The mean face.
    pub head: Head,
    /// Corners of the body around the head.
    pub hull: Vec<DVec3>,
    /// What to know.
    pub notes: Vec<String>,
}

/// Finds the poses of all frames with a valid row.
///
/// With pictures of key frames the skin refines what the landmarks say.
pub(crate) fn find(
    take: &Take,
    track: &Track,
    options: &HeadOptions,
    pictures: Option<&BTreeMap<u32, Picture>>,
    reporter: &dyn Reporter,
) -> Result<HeadRoute> {
    let lacks =
        |missing: &str, hint| TrackerError::TrackLacks { path: take.openface_path(), missing: missing.into(), hint };
    let rows: Vec<&TrackRow> = track
        .rows
        .iter()
        .filter(|r| r.is_valid(options.min_confidence) && r.landmarks.is_some() && r.head_pose.is_some())
        .collect();
    if rows.len() < 10 {
        let missing = if track.rows.iter().all(|r| r.landmarks.is_none()) {
            "has no landmarks (`x_0` … `y_67`)"
        } else if track.rows.iter().all(|r| r.head_pose.is_none()) {
            "has no head pose (`pose_Tx` … `pose_Rz`)"
        } else {
            "has fewer than 10 valid frames with landmarks and head pose"
        };
        return Err(lacks(missing, "the head route needs both; import a table that holds them"));
    }
    let mut notes = Vec::new();
    let lens = find_lens(take, &rows, options, &mut notes);
    let mut poses: Vec<Isometry> =
        rows.iter().filter_map(|r| r.head_pose).map(|p| in_metres(&p.camera_from_head())).collect();
    let before = face_of(&lens, &poses, &rows).ok_or(TrackerError::TooLittleParallax { good: 0 })?;
    if options.refine {
        reporter.stage("refine head poses", None);
        refine(&lens, &rows, &before, &mut poses, reporter)?;
    }
    let frames: Vec<u32> = rows.iter().map(|r| r.frame.0).collect();
    let secs: Vec<f64> = frames.iter().map(|&f| take.frames[f as usize].timestamp_nanos as f64 * 1e-9).collect();
    if options.smooth_secs > 0.0 {
        poses = smooth(&poses, &secs, options.smooth_secs);
    }
    let mut skin_model = None;
    if options.refine
        && let Some(pictures) = pictures
    {
        let face = face_of(&lens, &poses, &rows).ok_or(TrackerError::TooLittleParallax { good: 0 })?;
        let by_frame = frames.iter().copied().zip(poses.iter().copied()).collect();
        let landmarks = rows.iter().filter_map(|r| Some((r.frame.0, r.landmarks.as_deref()?))).collect();
        match skin::refine(take, &lens, &by_frame, &landmarks, &face.landmarks, pictures, reporter)? {
            Some(skin) => {
                let replaced = replace(&frames, &mut poses, &skin.poses);
                notes.push(format!(
                    "{replaced} of {} poses from {} places on the skin in {} views: median error {:.2} px",
                    frames.len(),
                    skin.points,
                    skin.views,
                    skin.error_px
                ));
                if options.smooth_secs > 0.0 {
                    poses = smooth(&poses, &secs, options.smooth_secs * SKIN_SMOOTH);
                }
                skin_model = Some(skin.model);
            }
            None => notes.push("poses from the landmarks alone: too little of the skin is found again".to_owned()),
        }
    }
    let after = face_of(&lens, &poses, &rows).ok_or(TrackerError::TooLittleParallax { good: 0 })?;
    notes.push(format!(
        "median distance of the landmarks from the reprojected mean face: {:.2} px with the table's poses, {:.2} px with these; rigid points {:.2} and {:.2} px",
        before.error_px, after.error_px, before.rigid_error_px, after.rigid_error_px
    ));
    let chin_drop = chin_drop(&lens, &poses, &rows, &after.landmarks);
    let hull = head_hull(&after.landmarks, chin_drop);
    let placed = frames
        .iter()
        .zip(&poses)
        .map(|(&frame, &camera_from_world)| (frame, PlacedFrame { lens: 1, camera_from_world, points: Vec::new() }));
    let mut model =
        TakeModel { lenses: BTreeMap::from([(1, lens)]), frames: placed.collect(), points: BTreeMap::new() };
    if let Some(skin) = skin_model {
        model.points = skin.points;
        for (frame, key) in skin.frames {
            if let Some(placed) = model.frames.get_mut(&frame) {
                placed.points = key.points;
            }
        }
    }
    let center = after.landmarks.iter().sum::<DVec3>() / after.landmarks.len() as f64;
    let radius = after.landmarks.iter().map(|p| p.distance(center)).fold(0.0, f64::max);
    let head = Head { center, radius, landmark_error_px: after.error_px, landmarks: after.landmarks };
    Ok(HeadRoute { model, head, hull, notes })
}

/// Puts the found poses in place; those between and beside that were not found move along with the nearest found ones.
fn replace(frames: &[u32], poses: &mut [Isometry], found: &BTreeMap<u32, Isometry>) -> usize {
    let moves: Vec<(u32, Isometry)> = frames
        .iter()
        .zip(poses.iter())
        .filter_map(|(f, old)| Some((*f, found.get(f)?.compose(&old.inverse()))))
        .collect();
    for (frame, pose) in frames.iter().zip(poses.iter_mut()) {
        if let Some((_, by)) = moves.iter().min_by_key(|(f, _)| f.abs_diff(*frame)) {
            *pose = by.compose(pose);
        }
    }
    moves.len()
}

fn in_metres(pose: &Isometry) -> Isometry {
    Isometry::new(pose.rotation, pose.translation * 1e-3)
}

fn find_lens(take: &Take, rows: &[&TrackRow], options: &HeadOptions, notes: &mut Vec<String>) -> Intrinsics {
    let (width, height) = (take.manifest.width, take.manifest.height);
    let table = table_camera(rows.iter().copied());
    let focal = match (options.focal_px, table) {
        (Some(focal), _) => {
            notes.push(format!("focal length {focal:.1} px as given"));
            focal
        }
        (None, Some(c)) => {
            notes.push(format!("focal length {:.1} px from the table's 2-D and 3-D landmarks", c.focal_px));
            c.focal_px
        }
        (None, None) => {
            let focal = DEFAULT_FOCAL * f64::from(width.max(height));
            notes.push(format!("focal length {focal:.1} px assumed (1.2 × the longer side); `--focal` sets it"));
            focal
        }
    };
    let mut lens = Intrinsics::pinhole(width, height, focal);
    // The middle of the picture is known better than a fit can tell, unless the table was made with another one.
    if let Some(c) = table
        && ((c.cx / lens.cx - 1.0).abs() > 0.02 || (c.cy / lens.cy - 1.0).abs() > 0.02)
    {
        notes.push(format!("principal point ({:.1}, {:.1}) from the table", c.cx, c.cy));
        (lens.cx, lens.cy) = (c.cx, c.cy);
    }
    lens
}

fn pixel(row: &TrackRow, landmark: usize) -> DVec2 {
    row.landmarks.as_ref().map_or(DVec2::NAN, |l| {
        let [x, y] = l.points_px[landmark];
        DVec2::new(f64::from(x), f64::from(y))
    })
}

/// The mean face under given poses.
struct Face {
    landmarks: Vec<DVec3>,
    errors_px: Vec<f64>,
    error_px: f64,
    rigid_error_px: f64,
}

fn face_of(lens: &Intrinsics, poses: &[Isometry], rows: &[&TrackRow]) -> Option<Face> {
    let found: Vec<_> = (0..68usize)
        .into_par_iter()
        .map(|i| {
            let view = |(pose, row): (&Isometry, &&TrackRow)| {
                View::new(&Camera { intrinsics: *lens, camera_from_world: *pose }, pixel(row, i))
            };
            triangulate(&poses.iter().zip(rows).filter_map(view).collect::<Vec<View>>())
        })
        .collect::<Option<Vec<_>>>()?;
    let errors_px: Vec<f64> = found.iter().map(|t| t.median_error_px).collect();
    let mut rigid: Vec<f64> = RIGID.iter().map(|&(i, _)| errors_px[i]).collect();
    Some(Face {
        landmarks: found.iter().map(|t| t.point).collect(),
        error_px: median(&mut errors_px.clone())?,
        rigid_error_px: median(&mut rigid)?,
        errors_px,
    })
}

/// Adjusts the shape of the rigid points with the poses of a spread of frames, then every pose alone.
fn refine(
    lens: &Intrinsics,
    rows: &[&TrackRow],
    before: &Face,
    poses: &mut [Isometry],
    reporter: &dyn Reporter,
) -> Result<()> {
    let mut shape: Vec<DVec3> = initial_shape(rows, before);
    let mut errors = before.errors_px.clone();
    let step = rows.len().div_ceil(MOST_ADJUSTED);
    // Twice: the first round's residuals tell how noisy each point is.
    for _ in 0..2 {
        if reporter.cancelled() {
            return Err(TrackerError::Cancelled { doing: "refining head poses".into() });
        }
        let points = rigid_points(&errors);
        let view = |row: &&TrackRow| FrameView { pixels: points.iter().map(|p| pixel(row, p.landmark)).collect() };
        let views: Vec<FrameView> = rows.iter().map(view).collect();
        let chosen: Vec<usize> = (0..rows.len()).step_by(step).collect();
        let mut some_poses: Vec<Isometry> =
            chosen.par_iter().map(|&i| refine_pose(lens, poses[i], &shape, &points, &views[i], None)).collect();
        let some_views: Vec<FrameView> = chosen.iter().map(|&i| views[i].clone()).collect();
        let bundle = Bundle { lens, points: &points, views: &some_views, shape_sigma: SHAPE_SIGMA_M };
        bundle.adjust(&mut some_poses, &mut shape, 25);
        poses.par_iter_mut().zip(&views).for_each(|(pose, view)| {
            *pose = refine_pose(lens, *pose, &shape, &points, view, None);
        });
        if let Some(face) = face_of(lens, poses, rows) {
            errors = face.errors_px;
        }
    }
    Ok(())
}

fn rigid_points(errors_px: &[f64]) -> Vec<RigidPoint> {
    // The median length of a 2-D normal deviate is 1.18 σ; below a third of a pixel is luck.
    RIGID
        .iter()
        .map(|&(landmark, factor)| RigidPoint { landmark, sigma_px: (errors_px[landmark] / 1.18).max(0.33) * factor })
        .collect()
}

/// The rigid points in the head frame: the tracker's own 3-D landmarks where it wrote them, else triangulated ones.
fn initial_shape(rows: &[&TrackRow], before: &Face) -> Vec<DVec3> {
    RIGID
        .iter()
        .map(|&(landmark, _)| {
            let own: Vec<DVec3> = rows
                .iter()
                .filter_map(|r| {
                    let solid = r.landmarks_in_camera_mm.as_ref()?[landmark].map(f64::from);
                    let solid = DVec3::from(solid);
                    (solid.z > 0.0).then_some(r.head_pose?.camera_from_head().inverse().transform_point(solid) * 1e-3)
                })
                .collect();
            let middle = |f: fn(&DVec3) -> f64| median(&mut own.iter().map(f).collect::<Vec<_>>());
            match (middle(|p| p.x), middle(|p| p.y), middle(|p| p.z)) {
                (Some(x), Some(y), Some(z)) if own.len() * 2 > rows.len() => DVec3::new(x, y, z),
                _ => before.landmarks[landmark],
            }
        })
        .collect()
}

/// How far below its mean place the chin is seen: 99 % of the frames show less, world units.
fn chin_drop(lens: &Intrinsics, poses: &[Isometry], rows: &[&TrackRow], landmarks: &[DVec3]) -> f64 {
    let chin = landmarks[8];
    let mut drops: Vec<f64> = poses
        .iter()
        .zip(rows)
        .filter_map(|(pose, row)| {
            // Along the head's own downward axis: the chin swings back too, which is left out.
            let seen = lens.unproject(pixel(row, 8))?;
            let (a, d) = (pose.transform_point(chin), pose.rotation * DVec3::Y);
            // (a + s d) projects to the seen height: a.y + s d.y = v (a.z + s d.z).
            let slope = d.y - seen.y * d.z;
            (slope.abs() > 0.2).then(|| (seen.y * a.z - a.y) / slope)
        })
        .collect();
    drops.sort_unstable_by(f64::total_cmp);
    let at = (drops.len().saturating_sub(1) as f64 * 0.99).round() as usize;
    drops.get(at).copied().unwrap_or(0.0).max(0.0)
}

#[cfg(test)]
#[path = "head_tests.rs"]
mod tests;
