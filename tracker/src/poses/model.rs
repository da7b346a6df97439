//! An existing COLMAP model as the cameras of a take.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use glam::{DVec2, DVec3};
use risorius_formats::colmap::{self, Model, ModelCamera, ModelImage, Point2d, Point3d};
use risorius_formats::take::SourceKind;
use risorius_formats::{Camera, FormatError, FrameIndex, Intrinsics, Isometry, Reporter, Take, Track, Warning};

use super::matching::{self, Matched, Numbering, Subject};
use crate::error::{Result, TrackerError};

/// The cameras of a take's frames, and the 3-D points that they see.
#[derive(Clone, Debug, Default)]
pub struct TakeModel {
    /// The lens of each camera at the take's full size.
    pub lenses: BTreeMap<u32, Intrinsics>,
    /// Placed frames.
    pub frames: BTreeMap<u32, PlacedFrame>,
    /// 3-D points by id; tracks name frames, see [`PlacedFrame::points`].
    pub points: BTreeMap<u64, Point3d>,
}

/// A frame with a camera.
#[derive(Clone, Debug)]
pub struct PlacedFrame {
    /// Key into [`TakeModel::lenses`].
    pub lens: u32,
    /// Its pose.
    pub camera_from_world: Isometry,
    /// Its features in full-size pixels; empty for interpolated frames.
    pub points: Vec<Point2d>,
}

impl TakeModel {
    /// The posed camera of a frame.
    pub fn camera(&self, frame: u32) -> Option<Camera> {
        let placed = self.frames.get(&frame)?;
        let intrinsics = *self.lenses.get(&placed.lens)?;
        Some(Camera { intrinsics, camera_from_world: placed.camera_from_world })
    }

    /// The poses alone.
    pub fn poses(&self) -> BTreeMap<u32, Isometry> {
        self.frames.iter().map(|(&f, p)| (f, p.camera_from_world)).collect()
    }

    /// Mean reprojection error of the points over all their observations, pixels; `None` without points.
    pub fn reprojection_error_px(&self) -> Option<f64> {
        let (mut sum, mut count) = (0.0, 0u64);
        for (&frame, placed) in &self.frames {
            let Some(camera) = self.camera(frame) else { continue };
            for point in &placed.points {
                let Some(solid) = point.point3d.and_then(|id| self.points.get(&id)) else { continue };
                let error = (camera.project(solid.position) - DVec2::from(point.position_px)).length();
                if error.is_finite() {
                    sum += error;
                    count += 1;
                }
            }
        }
        (count > 0).then(|| sum / count as f64)
    }

    /// Depths of the points in the frames that see them.
    pub fn point_depths(&self) -> Vec<f64> {
        let depth = |placed: &PlacedFrame, point: &Point2d| {
            let solid: DVec3 = self.points.get(&point.point3d?)?.position;
            Some(placed.camera_from_world.transform_point(solid).z).filter(|z| *z > 0.0)
        };
        self.frames.values().flat_map(|f| f.points.iter().filter_map(move |p| depth(f, p))).collect()
    }

    /// The model in COLMAP's terms: image ids are frame + 1, names `%06d.png`.
    pub fn to_colmap(&self) -> Model {
        let cameras = self.lenses.iter().map(|(&id, lens)| (id, ModelCamera::from_intrinsics(lens))).collect();
        let image = |(&frame, placed): (&u32, &PlacedFrame)| {
            let image = ModelImage {
                camera_from_world: placed.camera_from_world,
                camera_id: placed.lens,
                name: FrameIndex(frame).image_name(),
                points: placed.points.clone(),
            };
            (frame + 1, image)
        };
        Model { cameras, images: self.frames.iter().map(image).collect(), points: self.points.clone() }
    }
}

/// What was taken from where.
#[derive(Clone, Debug)]
pub struct Found {
    /// The model for the take.
    pub model: TakeModel,
    /// The folder it came from.
    pub dir: PathBuf,
    /// How many sub-models there were.
    pub candidates: usize,
    /// Images that belong to no frame of the take.
    pub foreign_images: usize,
    /// How images were matched to frames, and what else to know.
    pub notes: Vec<String>,
}

/// Folders below `dir` that hold a model, `dir` itself first.
pub(crate) fn model_dirs(dir: &Path) -> Vec<PathBuf> {
    let is_model = |d: &Path| {
        ["txt", "bin"]
            .iter()
            .any(|e| d.join(format!("cameras.{e}")).is_file() && d.join(format!("images.{e}")).is_file())
    };
    let mut candidates = vec![dir.to_owned(), dir.join("sparse")];
    for base in [dir.to_owned(), dir.join("sparse")] {
        let mut numbered: Vec<(u32, PathBuf)> = std::fs::read_dir(base)
            .into_iter()
            .flatten()
            .flatten()
            .filter_map(|e| Some((e.file_name().to_str()?.parse().ok()?, e.path())))
            .collect();
        numbered.sort();
        candidates.extend(numbered.into_iter().map(|(_, path)| path));
    }
    candidates.retain(|d| is_model(d));
    candidates
}

/// Reads the model in `dir` (or the largest of its sub-models) and fits it to the take.
///
/// Images are matched to frames by the last run of digits in their names, of which `first` is the take's first frame. For
/// models that this program wrote; what frame an image of a foreign model is, [`load_foreign`] decides.
pub fn load(dir: impl AsRef<Path>, take: &Take, first: u32, reporter: &dyn Reporter) -> Result<Found> {
    let (model, dir, candidates) = largest(dir.as_ref(), reporter)?;
    let (lenses, scales) = fit_lenses(&model, &dir, take)?;
    let frames = take.frames.len();
    let mut image_of: BTreeMap<u32, u32> = BTreeMap::new();
    let mut duplicates = 0usize;
    for (&id, image) in &model.images {
        let frame = FrameIndex::from_image_name(&image.name, first).filter(|f| (f.0 as usize) < frames);
        let Some(FrameIndex(frame)) = frame.filter(|_| lenses.contains_key(&image.camera_id)) else { continue };
        match image_of.entry(frame) {
            Entry::Occupied(_) => duplicates += 1,
            Entry::Vacant(place) => {
                place.insert(id);
            }
        }
    }
    if image_of.is_empty() {
        return Err(TrackerError::NoModelFrame { dir, images: model.images.len(), frames });
    }
    warn_about_duplicates(&dir, duplicates, reporter);
    let foreign_images = model.images.len() - image_of.len() - duplicates;
    let model = adopt(model, &image_of, lenses, &scales, reporter);
    Ok(Found { model, dir, candidates, foreign_images, notes: Vec::new() })
}

/// Reads a model that other software made, and decides by names, numbers and landmarks which frames its images are.
pub(crate) fn load_foreign(
    dir: impl AsRef<Path>,
    take: &Take,
    track: Option<(&Track, f32)>,
    numbering: &Numbering,
    reporter: &dyn Reporter,
) -> Result<Found> {
    let (model, dir, candidates) = largest(dir.as_ref(), reporter)?;
    let (lenses, scales) = fit_lenses(&model, &dir, take)?;
    let camera = |image: &ModelImage| {
        let intrinsics = *lenses.get(&image.camera_id)?;
        Some(Camera { intrinsics, camera_from_world: image.camera_from_world })
    };
    let cameras: BTreeMap<u32, Camera> = model.images.iter().filter_map(|(id, i)| Some((*id, camera(i)?))).collect();
    let names: BTreeMap<u32, String> = cameras.keys().map(|id| (*id, model.images[id].name.clone())).collect();
    let pictures = picture_names(take);
    let subject = Subject {
        frames: take.frames.len() as u32,
        fps: take.fps(),
        pictures: pictures.as_deref(),
        track: track.map(|t| t.0),
        min_confidence: track.map_or(0.0, |t| t.1),
    };
    let Some(matched) = matching::decide(&names, &cameras, &subject, numbering) else {
        if let Some(folder) = &numbering.folder {
            return Err(no_folder(&dir, folder, &model));
        }
        return Err(TrackerError::NoModelFrame { dir, images: model.images.len(), frames: take.frames.len() });
    };
    let notes = say(&matched, reporter);
    let foreign_images = model.images.len() - matched.frames.len();
    let model = adopt(model, &matched.frames, lenses, &scales, reporter);
    Ok(Found { model, dir, candidates, foreign_images, notes })
}

/// The largest of the models in `dir` and below, where it lies, and how many there are.
fn largest(dir: &Path, reporter: &dyn Reporter) -> Result<(Model, PathBuf, usize)> {
    if !dir.exists() {
        return Err(FormatError::io(dir, "read", &std::io::ErrorKind::NotFound.into()).into());
    }
    let dirs = model_dirs(dir);
    let candidates = dirs.len();
    let mut best: Option<(PathBuf, Model)> = None;
    for candidate in dirs {
        let model = colmap::read_model_reporting(&candidate, reporter)?;
        // The first of equals: COLMAP numbers its models by their order of appearance.
        if best.as_ref().is_none_or(|(_, b)| model.images.len() > b.images.len()) {
            best = Some((candidate, model));
        }
    }
    let Some((dir, model)) = best else { return Err(TrackerError::NoModel { dir: dir.to_owned() }) };
    Ok((model, dir, candidates))
}

/// The names of the pictures of an image folder, frame by frame; `None` for videos, and where the folder is gone.
fn picture_names(take: &Take) -> Option<Vec<String>> {
    if take.manifest.source != SourceKind::Images {
        return None;
    }
    let reader = risorius_video::Reader::open(take.media_path()).ok()?;
    let name = |path: &PathBuf| Some(path.file_name()?.to_string_lossy().into_owned());
    let names: Vec<String> = reader.image_files().iter().filter_map(name).collect();
    (names.len() == take.frames.len()).then_some(names)
}

/// What a user should know of how images were matched; the notes for the report.
fn say(matched: &Matched, reporter: &dyn Reporter) -> Vec<String> {
    let mut notes = Vec::new();
    let px = matched.error_px.map_or(String::new(), |px| format!(": mean face {px:.2} px from steady landmarks"));
    let mut text = format!("images are matched to frames {}{px}", matched.rule);
    if let Some((usual, px)) = &matched.instead_of {
        text = format!("{text} ({px:.2} px {usual})");
        reporter.warn(Warning::new("matched-by-landmarks", text.clone()));
    }
    if !matched.rule.is_plain() || matched.instead_of.is_some() {
        notes.push(text);
    }
    if let (Some((better, px)), Some(stated)) = (&matched.better, matched.error_px) {
        let text = format!(
            "the mean face is {stated:.2} px from steady landmarks as stated, but {px:.2} px if images are matched {better}"
        );
        reporter.warn(Warning::new("other-numbers-fit", text.clone()));
        notes.push(text);
    }
    notes
}

fn no_folder(dir: &Path, folder: &str, model: &Model) -> TrackerError {
    let folders: BTreeSet<&str> = model.images.values().map(|i| matching::folder_of(&i.name)).collect();
    let folders = folders.into_iter().map(|f| format!("`{f}`")).take(8).collect::<Vec<_>>().join(", ");
    TrackerError::NoModelFolder { dir: dir.to_owned(), folder: folder.to_owned(), folders }
}

fn warn_about_duplicates(dir: &Path, duplicates: usize, reporter: &dyn Reporter) {
    if duplicates > 0 {
        reporter.warn(Warning::new(
            "duplicate-image",
            format!(
                "{}: {duplicates} images name a frame that another image has already; the first one counts",
                dir.display()
            ),
        ));
    }
}

/// The lenses at the take's size, and how much larger that is than the model's.
type Lenses = (BTreeMap<u32, Intrinsics>, BTreeMap<u32, DVec2>);

/// Fits every lens of the model to the take. Lenses that do not fit are left out, unless none does.
fn fit_lenses(model: &Model, dir: &Path, take: &Take) -> Result<Lenses> {
    let (mut lenses, mut scales) = Lenses::default();
    let mut failure = None;
    for (&id, camera) in &model.cameras {
        match fit_camera(camera, id, dir, take) {
            Ok((lens, scale)) => {
                lenses.insert(id, lens);
                scales.insert(id, scale);
            }
            Err(error) if model.images.values().any(|i| i.camera_id == id) => {
                failure.get_or_insert(error);
            }
            Err(_) => {}
        }
    }
    match failure {
        Some(error) if lenses.is_empty() => Err(error),
        _ => Ok((lenses, scales)),
    }
}

/// The images that are frames of the take, in its terms and at its size.
fn adopt(
    model: Model,
    image_of: &BTreeMap<u32, u32>,
    lenses: BTreeMap<u32, Intrinsics>,
    scales: &BTreeMap<u32, DVec2>,
    reporter: &dyn Reporter,
) -> TakeModel {
    let frame_of: BTreeMap<u32, u32> = image_of.iter().map(|(&frame, &image)| (image, frame)).collect();
    let mut result = TakeModel { points: model.points, ..TakeModel::default() };
    for (id, image) in model.images {
        let Some(&frame) = frame_of.get(&id) else { continue };
        let scale = scales.get(&image.camera_id).copied().unwrap_or(DVec2::ONE);
        let mut points = image.points;
        for p in &mut points {
            p.position_px = [p.position_px[0] * scale.x, p.position_px[1] * scale.y];
        }
        let placed = PlacedFrame { lens: image.camera_id, camera_from_world: image.camera_from_world, points };
        result.frames.insert(frame, placed);
    }
    let used: BTreeSet<u32> = result.frames.values().map(|f| f.lens).collect();
    result.lenses = lenses.into_iter().filter(|(id, _)| used.contains(id)).collect();
    for id in used.iter().filter(|id| scales.get(id).is_some_and(|s| *s != DVec2::ONE)) {
        let (camera, lens) = (&model.cameras[id], &result.lenses[id]);
        reporter.warn(Warning::new(
            "model-scaled",
            format!(
                "the model was made at {}×{}; its camera {id} was scaled to the take's {}×{}",
                camera.width, camera.height, lens.width, lens.height
            ),
        ));
    }
    let scales = scales.iter().filter(|(id, _)| used.contains(id)).map(|(&id, &scale)| (id, scale)).collect();
    adopt_points(&mut result, &frame_of, &scales);
    result
}

/// Rewrites the tracks in terms of frames; points that no frame sees any more go.
fn adopt_points(model: &mut TakeModel, frame_of_image: &BTreeMap<u32, u32>, scales: &BTreeMap<u32, DVec2>) {
    let scale = scales.values().map(|s| 0.5 * (s.x + s.y)).next().unwrap_or(1.0);
    for point in model.points.values_mut() {
        point.track = point
            .track
            .iter()
            .filter_map(|&(image, index)| frame_of_image.get(&image).map(|&frame| (frame + 1, index)))
            .collect();
        point.error_px *= scale;
    }
    model.points.retain(|_, p| !p.track.is_empty());
    for frame in model.frames.values_mut() {
        for p in &mut frame.points {
            p.point3d = p.point3d.filter(|id| model.points.contains_key(id));
        }
    }
}

/// The lens at the take's full size, and how much larger that is than the model's.
fn fit_camera(camera: &ModelCamera, id: u32, dir: &Path, take: &Take) -> Result<(Intrinsics, DVec2)> {
    let (width, height) = (take.manifest.width, take.manifest.height);
    let lens = camera.intrinsics().map_err(|e| e.in_file(dir))?;
    if lens.distortion.radial_denominator != [0.0; 3] {
        return Err(TrackerError::LensModel { dir: dir.to_owned(), camera: id, model: camera.model.clone() });
    }
    let scale =
        DVec2::new(f64::from(width) / camera.width.max(1) as f64, f64::from(height) / camera.height.max(1) as f64);
    if scale == DVec2::ONE {
        return Ok((lens, scale));
    }
    // Reduced pictures are rounded to whole pixels: half a pixel of the smaller picture may be missing.
    let slack = 1.0 / camera.width.min(camera.height).max(1) as f64;
    if (scale.x / scale.y - 1.0).abs() > slack {
        return Err(TrackerError::CameraSize {
            dir: dir.to_owned(),
            camera: id,
            width: camera.width,
            height: camera.height,
            take_width: width,
            take_height: height,
        });
    }
    let lens = Intrinsics {
        width,
        height,
        fx: lens.fx * scale.x,
        fy: lens.fy * scale.y,
        cx: lens.cx * scale.x,
        cy: lens.cy * scale.y,
        skew: lens.skew * scale.x,
        distortion: lens.distortion,
    };
    Ok((lens, scale))
}

#[cfg(test)]
#[path = "model_tests.rs"]
mod tests;
