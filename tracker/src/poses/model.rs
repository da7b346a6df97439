//! An existing COLMAP model as the cameras of a take.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::path::{Path, PathBuf};

use glam::{DVec2, DVec3};
use risorius_formats::colmap::{self, Model, ModelCamera, ModelImage, Point2d, Point3d};
use risorius_formats::{Camera, FormatError, FrameIndex, Intrinsics, Isometry, Reporter, Take, Warning};

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
/// Images are matched to frames by the last run of digits in their names, of which `first` is the take's first frame.
pub fn load(dir: impl AsRef<Path>, take: &Take, first: u32, reporter: &dyn Reporter) -> Result<Found> {
    let dir = dir.as_ref();
    if !dir.exists() {
        return Err(FormatError::io(dir, "read", &std::io::ErrorKind::NotFound.into()).into());
    }
    let dirs = model_dirs(dir);
    let candidates = dirs.len();
    let mut best: Option<(PathBuf, Model)> = None;
    for candidate in dirs {
        let model = colmap::read_model(&candidate)?;
        // The first of equals: COLMAP numbers its models by their order of appearance.
        if best.as_ref().is_none_or(|(_, b)| model.images.len() > b.images.len()) {
            best = Some((candidate, model));
        }
    }
    let Some((dir, model)) = best else { return Err(TrackerError::NoModel { dir: dir.to_owned() }) };
    let (model, foreign_images) = fit_to_take(model, &dir, take, first, reporter)?;
    Ok(Found { model, dir, candidates, foreign_images })
}

fn fit_to_take(
    model: Model,
    dir: &Path,
    take: &Take,
    first: u32,
    reporter: &dyn Reporter,
) -> Result<(TakeModel, usize)> {
    let images = model.images.len();
    let mut frame_of_image: BTreeMap<u32, u32> = BTreeMap::new();
    let mut result = TakeModel::default();
    let mut scales: BTreeMap<u32, DVec2> = BTreeMap::new();
    let mut duplicates = 0usize;
    for (id, image) in model.images {
        let frame = FrameIndex::from_image_name(&image.name, first).filter(|f| (f.0 as usize) < take.frames.len());
        let Some(FrameIndex(frame)) = frame else { continue };
        if result.frames.contains_key(&frame) {
            duplicates += 1;
            continue;
        }
        let scale = match scales.entry(image.camera_id) {
            Entry::Occupied(known) => *known.get(),
            Entry::Vacant(slot) => {
                let Some(camera) = model.cameras.get(&image.camera_id) else { continue };
                let (lens, scale) = fit_camera(camera, image.camera_id, dir, take, reporter)?;
                result.lenses.insert(image.camera_id, lens);
                *slot.insert(scale)
            }
        };
        let mut points = image.points;
        for p in &mut points {
            p.position_px = [p.position_px[0] * scale.x, p.position_px[1] * scale.y];
        }
        frame_of_image.insert(id, frame);
        result
            .frames
            .insert(frame, PlacedFrame { lens: image.camera_id, camera_from_world: image.camera_from_world, points });
    }
    if result.frames.is_empty() {
        return Err(TrackerError::NoModelFrame { dir: dir.to_owned(), images, frames: take.frames.len() });
    }
    if duplicates > 0 {
        reporter.warn(Warning::new(
            "duplicate-image",
            format!(
                "{}: {duplicates} images name a frame that another image has already; the first one counts",
                dir.display()
            ),
        ));
    }
    result.points = model.points;
    adopt_points(&mut result, &frame_of_image, &scales);
    Ok((result, images - frame_of_image.len() - duplicates))
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
fn fit_camera(
    camera: &ModelCamera,
    id: u32,
    dir: &Path,
    take: &Take,
    reporter: &dyn Reporter,
) -> Result<(Intrinsics, DVec2)> {
    let (width, height) = (take.manifest.width, take.manifest.height);
    let lens = camera.intrinsics().map_err(|e| e.in_file(dir))?;
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
    reporter.warn(Warning::new(
        "model-scaled",
        format!(
            "the model was made at {}×{}; its camera {id} was scaled to the take's {width}×{height}",
            camera.width, camera.height
        ),
    ));
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
