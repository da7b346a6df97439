//! The cameras of a take: by COLMAP, from a finished COLMAP model, or from the head's own motion.
//!
//! Whatever the way, the result is the same: `poses/sparse/` (a COLMAP text model at full size, images `%06d.png`) and
//! `poses/report.json` with the head's place, near and far. Frames between placed ones are interpolated.

mod adjust;
mod auto;
mod between;
mod child;
pub mod colmap;
pub mod depths;
mod fill;
pub mod flags;
pub mod focal;
mod follow;
pub mod head;
pub mod interpolate;
mod join;
mod joint;
pub mod keyframes;
pub mod keys;
pub mod mask;
mod matching;
pub mod model;
mod patch;
mod picture;
mod program;
mod quality;
mod refine;
mod replace;
mod sharpen;
mod sketch;
mod skin;
pub mod smooth;
pub mod triangulate;
mod variety;
pub mod work;

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use glam::DVec3;
use risorius_formats::atomic::AtomicDir;
use risorius_formats::openface::{self, ReadOptions};
use risorius_formats::pose_report::{PoseMethod, PoseReport};
use risorius_formats::{Reporter, Silent, Take, Track, Warning, atomic, colmap as colmap_format};

use self::auto::Choice;
use self::colmap::ColmapOptions;
use self::depths::Head;
use self::head::HeadOptions;
use self::keys::Keys;
pub use self::matching::Numbering;
use self::model::TakeModel;
use self::picture::Picture;
use self::sketch::Shown;
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
        /// What is known of the numbers in its image names.
        numbering: Numbering,
    },
    /// A still camera; the head moves.
    Head(HeadOptions),
    /// One of the two, as the video is.
    Auto(ColmapOptions, HeadOptions),
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
    /// Take cameras of low quality too.
    pub accept_poor: bool,
    /// The person's distance between the pupils, millimetres: the world becomes metres.
    pub eye_distance_mm: Option<f64>,
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
    let (mut head, mut hull) = match placed.head.take() {
        Some((head, hull)) => (head, Some(hull)),
        None => (depths::find_head(&placed.model, &track, options.min_confidence)?, None),
    };
    let correct = options.correct_by_landmarks && hull.is_none();
    fill::interpolate_between(&mut placed, &take, correct.then_some((&track, &head)), options, reporter);
    let mut metric = hull.is_some();
    if let Some(distance) = options.eye_distance_mm {
        scale_to_metres(&mut placed, &mut head, hull.as_mut(), distance);
        metric = true;
    }
    let mut report = report(&placed, head, hull, metric, &take, started)?;
    let sizes = quality::Sizes::of(&take, &track, options.min_confidence);
    let problems = quality::problems(&report, sizes, placed.focal_share);
    report.problems = problems.iter().map(|p| p.what.clone()).collect();
    if !problems.is_empty() {
        if !options.accept_poor {
            keep_log(&take, folder.path());
            return Err(TrackerError::PoorPoses {
                problems: report.problems.join("; "),
                advice: problems.iter().map(|p| p.advice).collect::<Vec<_>>().join("; "),
            });
        }
        for problem in &report.problems {
            reporter.warn(Warning::new("poor-poses", problem.clone()));
        }
    }
    replace::check(&take, &report, options.accept_poor, reporter)?;
    colmap_format::write_text(folder.path().join("sparse"), &placed.model.to_colmap())?;
    if let Some(svg) = picture_of(&report, &placed.model, &track, &take) {
        atomic::write_file(folder.path().join("report.svg"), svg.as_bytes())?;
    }
    report.seconds = started.elapsed().as_secs_f64();
    report.write(folder.path().join("report.json"))?;
    folder.commit()?;
    if let Some(work) = &placed.work {
        work::remove(work)?;
    }
    Ok(report)
}

/// Makes the distance between the middles of the eyes what it is in the person.
fn scale_to_metres(placed: &mut Placed, head: &mut Head, hull: Option<&mut Vec<DVec3>>, eye_distance_mm: f64) {
    let eye = |first: usize| head.landmarks[first..first + 6].iter().sum::<DVec3>() / 6.0;
    let scale = eye_distance_mm * 1e-3 / eye(36).distance(eye(42));
    if !(scale.is_finite() && scale > 0.0) {
        return;
    }
    placed.notes.push(format!("scaled by {scale:.6} to metres: {eye_distance_mm:.1} mm between the pupils"));
    for frame in placed.model.frames.values_mut() {
        frame.camera_from_world.translation *= scale;
    }
    for point in placed.model.points.values_mut() {
        point.position *= scale;
    }
    head.center *= scale;
    head.radius *= scale;
    for p in head.landmarks.iter_mut().chain(hull.into_iter().flatten()) {
        *p *= scale;
    }
}

/// The drawing for `report.svg`, with a frame in the first part of the video if it can be read.
fn picture_of(report: &PoseReport, model: &TakeModel, track: &Track, take: &Take) -> Option<String> {
    // An early frame with features: later ones cost the decoding of all before.
    let shown =
        model.frames.iter().find(|(_, f)| !f.points.is_empty()).or(model.frames.iter().next()).map(|(f, _)| *f)?;
    let mut picture = None;
    // The drawing is an extra: it must not fail the work.
    let _ = risorius_video::read_take_frames(take, &[shown], |_, image| -> Result<()> {
        picture = Some(image);
        Ok(())
    });
    let row = track.rows.iter().find(|r| r.frame.0 == shown && r.success);
    let landmarks = row.and_then(|r| r.landmarks.as_deref()).map(|l| &l.points_px);
    let shown = picture.as_ref().map(|picture| Shown { frame: shown, picture, landmarks });
    sketch::draw(report, model, shown.as_ref())
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
    /// Deviation of the focal length over itself, where it was adjusted.
    focal_share: Option<f64>,
    /// Files of the run that are not needed once all is written.
    work: Option<PathBuf>,
    notes: Vec<String>,
}

impl Placed {
    fn new(method: PoseMethod, model: TakeModel) -> Self {
        Self {
            method,
            frames_tried: model.frames.len(),
            frames_registered: model.frames.len(),
            frames_followed: 0,
            model,
            head: None,
            interpolated_runs: Vec::new(),
            focal_share: None,
            work: None,
            notes: Vec::new(),
        }
    }
}

fn place(take: &Take, track: &Track, options: &PosesOptions, folder: &Path, reporter: &dyn Reporter) -> Result<Placed> {
    match &options.source {
        Source::Model { dir, numbering } => {
            reporter.stage("read the model", None);
            let track = Some((track, options.min_confidence));
            let found = model::load_foreign(dir, take, track, numbering, reporter)?;
            let mut notes = vec![format!("took {} of {} sub-models", found.dir.display(), found.candidates)];
            notes.extend(found.notes);
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
                frames_tried: registered + found.foreign_images,
                notes,
                ..Placed::new(PoseMethod::ColmapModel, found.model)
            })
        }
        Source::Colmap(colmap_options) => {
            let final_log = take.dir.join("poses").join("colmap.log");
            colmap::look_for(colmap_options, &folder.join("colmap.log"), &final_log, reporter)?;
            let keys = keys::read(take, track, colmap_options, reporter)?;
            place_by_colmap(take, options, colmap_options, keys, folder, reporter)
        }
        Source::Auto(colmap_options, head_options) => {
            let keys = keys::read(take, track, colmap_options, reporter)?;
            let (choice, why) = auto::decide(&keys.pictures, &keys.outlines);
            reporter.note(&why);
            let mut placed = match choice {
                Choice::Colmap => place_by_colmap(take, options, colmap_options, keys, folder, reporter)?,
                Choice::Head => place_by_head(take, track, head_options, Some(&keys.pictures), reporter)?,
            };
            placed.notes.insert(0, why);
            Ok(placed)
        }
        Source::Head(head_options) => {
            // A take whose video is gone, or of a few frames, still has its landmarks.
            let keys = keys::read(take, track, &ColmapOptions::default(), reporter);
            let pictures = match keys {
                Err(TrackerError::Cancelled { doing }) => return Err(TrackerError::Cancelled { doing }),
                keys => keys.ok().map(|k| k.pictures),
            };
            place_by_head(take, track, head_options, pictures.as_ref(), reporter)
        }
    }
}

fn place_by_colmap(
    take: &Take,
    options: &PosesOptions,
    colmap_options: &ColmapOptions,
    keys: Keys,
    folder: &Path,
    reporter: &dyn Reporter,
) -> Result<Placed> {
    let work = take.dir.join(WORK_DIR);
    let final_log = take.dir.join("poses").join("colmap.log");
    let run = colmap::run(take, colmap_options, keys, &work, &folder.join("colmap.log"), &final_log, reporter)?;
    let mut placed = Placed {
        frames_tried: run.keyframes.len(),
        notes: run.notes,
        work: (!colmap_options.keep_work).then_some(work),
        ..Placed::new(PoseMethod::Colmap, run.found.model)
    };
    if options.follow {
        fill::follow_frames(&mut placed, take, &run.pictures, &run.face, reporter)?;
    }
    Ok(placed)
}

fn place_by_head(
    take: &Take,
    track: &Track,
    options: &HeadOptions,
    pictures: Option<&BTreeMap<u32, Picture>>,
    reporter: &dyn Reporter,
) -> Result<Placed> {
    let route = head::find(take, track, options, pictures, reporter)?;
    Ok(Placed {
        frames_tried: take.frames.len(),
        head: Some((route.head, route.hull)),
        notes: route.notes,
        ..Placed::new(PoseMethod::Head, route.model)
    })
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

fn report(
    placed: &Placed,
    head: Head,
    hull: Option<Vec<DVec3>>,
    metric: bool,
    take: &Take,
    started: Instant,
) -> Result<PoseReport> {
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
        units_per_metre: metric.then_some(1.0),
        head_box: Some(head_box(&head)),
        problems: Vec::new(),
        landmarks_in_world: head.landmarks,
        head_hull_in_world: hull,
        interpolated_runs: placed.interpolated_runs.clone(),
        seconds: started.elapsed().as_secs_f64(),
        notes: placed.notes.clone(),
    })
}

/// A box along the world's axes around the landmarks, with room for the head behind and above the face.
fn head_box(head: &Head) -> [DVec3; 2] {
    let (mut lo, mut hi) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for p in &head.landmarks {
        lo = lo.min(*p);
        hi = hi.max(*p);
    }
    [lo - DVec3::splat(head.radius), hi + DVec3::splat(head.radius)]
}

#[cfg(test)]
#[path = "poses_tests.rs"]
mod tests;
