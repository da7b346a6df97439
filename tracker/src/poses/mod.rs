//! The cameras of a take: by COLMAP, from a finished COLMAP model, or from the head's own motion.
//!
//! Whatever the way, the result is the same: `poses/sparse/` (a COLMAP text model at full size, images `%06d.png`) and
//! `poses/report.json` with the head's place, near and far. Frames between placed ones are interpolated.

mod adjust;
mod between;
mod child;
pub mod colmap;
pub mod depths;
pub mod flags;
pub mod focal;
mod follow;
pub mod head;
pub mod interpolate;
mod join;
pub mod keyframes;
pub mod mask;
pub mod model;
mod patch;
mod picture;
mod refine;
mod sharpen;
pub mod smooth;
pub mod triangulate;
pub mod work;

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use glam::{DVec2, DVec3};
use risorius_formats::atomic::AtomicDir;
use risorius_formats::openface::{self, ReadOptions};
use risorius_formats::polygon::hull_contains;
use risorius_formats::pose_report::{PoseMethod, PoseReport};
use risorius_formats::{Reporter, Silent, Take, Track, TrackRow, Warning, colmap as colmap_format};

use self::between::Between;
use self::colmap::ColmapOptions;
use self::depths::Head;
use self::follow::Follow;
use self::head::HeadOptions;
use self::model::{PlacedFrame, TakeModel};
use self::picture::Picture;
use self::triangulate::median;
use self::work::WORK_DIR;
use crate::error::{Result, TrackerError};

/// With the head route sampling starts this much before the body around the head and ends as much behind it.
const HULL_MARGIN: f64 = 0.1;

/// Where the cameras come from.
#[derive(Clone, Debug)]
pub enum Source {
    /// COLMAP is run.
    Colmap(ColmapOptions),
    /// A finished model.
    Model {
        /// Its folder, or one above it.
        dir: PathBuf,
        /// The number of the take's first frame in its image names.
        first: u32,
    },
    /// A still camera; the head moves.
    Head(HeadOptions),
}

/// How to find the cameras.
#[derive(Clone, Debug)]
pub struct PosesOptions {
    /// Where they come from.
    pub source: Source,
    /// Rows below this confidence are lost.
    pub min_confidence: f32,
    /// Longest gap between placed frames that is interpolated, seconds.
    pub max_gap_secs: f64,
    /// Whether key frames are made exact by their patches and the frames between them placed by those.
    pub follow: bool,
    /// Whether the landmarks correct the interpolated poses (not with the head route, where they made the poses).
    pub correct_by_landmarks: bool,
}

/// The take's track; an error with advice when there is none.
pub fn read_track(take: &Take) -> Result<Track> {
    let path = take.openface_path();
    if !path.is_file() {
        return Err(TrackerError::NoTrack { path });
    }
    // Our own file: its peculiarities were reported when it was imported.
    Ok(openface::read(path, &ReadOptions::default(), &Silent)?)
}

/// Finds the cameras and writes `TAKE/poses/`.
pub fn find(take_dir: impl AsRef<Path>, options: &PosesOptions, reporter: &dyn Reporter) -> Result<PoseReport> {
    let started = Instant::now();
    let take = Take::open(take_dir)?;
    let track = read_track(&take)?;
    if !track.rows.iter().any(|r| r.is_valid(options.min_confidence)) {
        let (path, min_confidence) = (take.openface_path(), options.min_confidence);
        return Err(TrackerError::NoValidFrame { path, min_confidence });
    }
    let folder = AtomicDir::create(take.dir.join("poses"))?;
    let result = place(&take, &track, options, folder.path(), reporter);
    let mut placed = match result {
        Ok(placed) => placed,
        Err(error) => {
            keep_log(&take, folder.path());
            return Err(error);
        }
    };
    reporter.stage("write the poses", None);
    let (head, hull) = match placed.head.take() {
        Some((head, hull)) => (head, Some(hull)),
        None => (depths::find_head(&placed.model, &track, options.min_confidence)?, None),
    };
    let correct = options.correct_by_landmarks && hull.is_none();
    interpolate_between(&mut placed, &take, correct.then_some((&track, &head)), options, reporter);
    let report = report(&placed, head, hull, &take, started)?;
    colmap_format::write_text(folder.path().join("sparse"), &placed.model.to_colmap())?;
    report.write(folder.path().join("report.json"))?;
    folder.commit()?;
    Ok(report)
}

/// Cameras as they come from their source.
struct Placed {
    method: PoseMethod,
    model: TakeModel,
    frames_tried: usize,
    frames_registered: usize,
    frames_followed: usize,
    head: Option<(Head, Vec<DVec3>)>,
    interpolated_runs: Vec<[u32; 2]>,
    notes: Vec<String>,
}

fn place(take: &Take, track: &Track, options: &PosesOptions, folder: &Path, reporter: &dyn Reporter) -> Result<Placed> {
    match &options.source {
        Source::Model { dir, first } => {
            reporter.stage("read the model", None);
            let found = model::load(dir, take, *first, reporter)?;
            let mut notes = vec![format!("took {} of {} sub-models", found.dir.display(), found.candidates)];
            if found.foreign_images > 0 {
                let message = format!(
                    "{} images of the model belong to no frame of the take and were left out",
                    found.foreign_images
                );
                reporter.warn(Warning::new("foreign-images", message.clone()));
                notes.push(message);
            }
            let registered = found.model.frames.len();
            Ok(Placed {
                method: PoseMethod::ColmapModel,
                frames_tried: registered + found.foreign_images,
                frames_registered: registered,
                frames_followed: 0,
                model: found.model,
                head: None,
                interpolated_runs: Vec::new(),
                notes,
            })
        }
        Source::Colmap(colmap_options) => {
            let work = take.dir.join(WORK_DIR);
            let final_log = take.dir.join("poses").join("colmap.log");
            let run =
                colmap::run(take, track, colmap_options, &work, &folder.join("colmap.log"), &final_log, reporter)?;
            if !colmap_options.keep_work {
                work::remove(&work)?;
            }
            let mut placed = Placed {
                method: PoseMethod::Colmap,
                frames_tried: run.keyframes.len(),
                frames_registered: run.found.model.frames.len(),
                frames_followed: 0,
                model: run.found.model,
                head: None,
                interpolated_runs: Vec::new(),
                notes: run.notes,
            };
            if options.follow {
                follow_frames(&mut placed, take, &run.pictures, &run.face, reporter)?;
            }
            Ok(placed)
        }
        Source::Head(head_options) => {
            let route = head::find(take, track, head_options, reporter)?;
            let registered = route.model.frames.len();
            Ok(Placed {
                method: PoseMethod::Head,
                frames_tried: take.frames.len(),
                frames_registered: registered,
                frames_followed: 0,
                model: route.model,
                head: Some((route.head, route.hull)),
                interpolated_runs: Vec::new(),
                notes: route.notes,
            })
        }
    }
}

/// Makes the key frames exact and places the frames between them by patches.
fn follow_frames(
    placed: &mut Placed,
    take: &Take,
    pictures: &BTreeMap<u32, Picture>,
    face: &BTreeMap<u32, Vec<DVec2>>,
    reporter: &dyn Reporter,
) -> Result<()> {
    reporter.stage("refine the key frames", None);
    if let Some(done) = sharpen::sharpen(&mut placed.model, pictures) {
        placed.notes.push(format!(
            "key frames refined on {} points in {} views: median error {:.2} px",
            done.points, done.views, done.median_error_px
        ));
        placed.notes.extend(done.notes);
    } else {
        placed.notes.push("key frames as COLMAP left them: too few points whose patches are found again".to_owned());
    }
    let avoid = |frame: u32, pixel: DVec2| face.get(&frame).is_some_and(|hull| hull_contains(hull, pixel));
    let Some(follow) = Follow::new(&placed.model, pictures, &take.frames, avoid) else {
        placed.notes.push("too few patches to place the frames between key frames; they are interpolated".to_owned());
        return Ok(());
    };
    let followed = follow.run(&placed.model.poses(), &take.media_path(), reporter)?;
    let mut errors: Vec<f64> = followed.errors_px.values().copied().collect();
    placed.notes.push(format!(
        "{} frames placed by patches of the nearest key frames: median error {:.2} px; {} not found, {} stood out",
        followed.poses.len(),
        median(&mut errors).unwrap_or(0.0),
        followed.lost.len(),
        followed.dropped.len()
    ));
    placed.frames_followed = followed.poses.len();
    for (frame, camera_from_world) in followed.poses {
        let lens = placed.model.frames.range(..frame).next_back().map_or(1, |(_, f)| f.lens);
        placed.model.frames.insert(frame, PlacedFrame { lens, camera_from_world, points: Vec::new() });
    }
    Ok(())
}

/// What COLMAP said is worth keeping when it failed; older poses stay.
fn keep_log(take: &Take, staging: &Path) {
    let log = staging.join("colmap.log");
    if log.is_file() {
        let poses = take.dir.join("poses");
        // A log that cannot be kept must not hide the error that it would explain.
        let _ = fs::create_dir_all(&poses).and_then(|()| fs::copy(&log, poses.join("colmap.log")).map(|_| ()));
    }
}

fn interpolate_between(
    placed: &mut Placed,
    take: &Take,
    landmarks: Option<(&Track, &Head)>,
    options: &PosesOptions,
    reporter: &dyn Reporter,
) {
    let max_gap_secs = options.max_gap_secs;
    let mut result = interpolate::interpolate(&placed.model.poses(), &take.frames, max_gap_secs);
    if let Some((track, head)) = landmarks
        && !result.poses.is_empty()
    {
        let usable = |r: &&TrackRow| r.is_valid(options.min_confidence) && r.landmarks.is_some();
        let rows = track.rows.iter().filter(usable).map(|r| (r.frame.0, r)).collect();
        let between =
            Between { placed: &placed.model, frames: &take.frames, rows: &rows, face: &head.landmarks, max_gap_secs };
        placed.notes.push(match between.correct(&mut result) {
            Some(count) => format!("{count} interpolated poses were corrected by the landmarks"),
            None => "too few placed frames to correct the interpolated poses by the landmarks".to_owned(),
        });
    }
    for (&frame, &camera_from_world) in &result.poses {
        // The lens of the frame before: a take has one camera, foreign models may have several.
        let lens = placed.model.frames.range(..frame).next_back().map_or(1, |(_, f)| f.lens);
        placed.model.frames.insert(frame, PlacedFrame { lens, camera_from_world, points: Vec::new() });
    }
    let left: u32 = result.gaps.iter().map(|r| r[1] - r[0] + 1).sum();
    if left > 0 {
        let message = format!(
            "{left} frames lie in {} gaps longer than {max_gap_secs} s between placed frames and got no pose",
            result.gaps.len()
        );
        reporter.warn(Warning::new("pose-gap", message.clone()));
        placed.notes.push(message);
    }
    placed.interpolated_runs = result.runs;
}

fn report(placed: &Placed, head: Head, hull: Option<Vec<DVec3>>, take: &Take, started: Instant) -> Result<PoseReport> {
    let interpolated: u32 = placed.interpolated_runs.iter().map(|r| r[1] - r[0] + 1).sum();
    let poses = placed.model.poses();
    let behind = TrackerError::TooLittleParallax { good: 0 };
    let head_depth = Head::depths(&head.landmarks, poses.values()).ok_or(behind)?;
    let range = depths::range(head_depth, head.radius, placed.model.point_depths());
    let (near, far) = match &hull {
        None => (range.near, range.far),
        Some(hull) => {
            let [lo, hi] = Head::depths(hull, poses.values()).unwrap_or(head_depth);
            (lo * (1.0 - HULL_MARGIN), hi * (1.0 + HULL_MARGIN))
        }
    };
    Ok(PoseReport {
        method: placed.method,
        frames: take.frames.len() as u32,
        frames_tried: placed.frames_tried as u32,
        frames_registered: placed.frames_registered as u32,
        frames_followed: placed.frames_followed as u32,
        frames_interpolated: interpolated,
        registered_share: placed.frames_registered as f64 / placed.frames_tried.max(1) as f64,
        reprojection_error_px: placed.model.reprojection_error_px(),
        landmark_error_px: Some(head.landmark_error_px),
        head_center: head.center,
        head_radius: head.radius,
        head_depth,
        near,
        far,
        background_depth: range.background,
        units_per_metre: hull.is_some().then_some(1.0),
        landmarks_in_world: head.landmarks,
        head_hull_in_world: hull,
        interpolated_runs: placed.interpolated_runs.clone(),
        seconds: started.elapsed().as_secs_f64(),
        notes: placed.notes.clone(),
    })
}

#[cfg(test)]
#[path = "poses_tests.rs"]
mod tests;
