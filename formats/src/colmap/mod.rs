//! COLMAP models, text and binary: cameras, registered images with their features, and 3-D points.
//!
//! Poses are `camera_from_world` with OpenCV axes, and the centre of the first pixel is (0.5, 0.5), as everywhere here.
//! The rigs and frames files of newer COLMAP versions are tolerated and ignored: images carry their own poses.

mod binary;
mod camera_model;
mod text;

use std::collections::BTreeMap;
use std::fs::Metadata;
use std::path::Path;
use std::time::SystemTime;

use glam::DVec3;

use crate::{ErrorKind, FormatError, Isometry, Reporter, Result, Silent, Warning, atomic};

pub use binary::{
    cameras_to_binary, images_to_binary, parse_cameras_binary, parse_images_binary, parse_points_binary,
    points_to_binary,
};
pub use camera_model::{CAMERA_MODELS, CameraModel};
pub use text::{
    cameras_to_text, images_to_text, parse_cameras_text, parse_images_text, parse_points_text, points_to_text,
};

/// A camera of a model.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelCamera {
    /// COLMAP's name of the camera model, such as `OPENCV`.
    pub model: String,
    /// Image width, pixels.
    pub width: u64,
    /// Image height, pixels.
    pub height: u64,
    /// Parameters in COLMAP's order.
    pub params: Vec<f64>,
}

/// A feature in an image, pixels, and the 3-D point it sees.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point2d {
    /// x, y in pixels.
    pub position_px: [f64; 2],
    /// Id of the 3-D point.
    pub point3d: Option<u64>,
}

/// A registered image.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelImage {
    /// Its pose.
    pub camera_from_world: Isometry,
    /// Id of its camera.
    pub camera_id: u32,
    /// Its file name.
    pub name: String,
    /// Its features.
    pub points: Vec<Point2d>,
}

/// A 3-D point.
#[derive(Clone, Debug, PartialEq)]
pub struct Point3d {
    /// Where it is in the world.
    pub position: DVec3,
    /// Its colour.
    pub rgb: [u8; 3],
    /// Mean reprojection error, pixels.
    pub error_px: f64,
    /// (image id, index into that image's points) of each observation.
    pub track: Vec<(u32, u32)>,
}

/// A whole model. Ids are not contiguous.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Model {
    /// Cameras by id.
    pub cameras: BTreeMap<u32, ModelCamera>,
    /// Images by id.
    pub images: BTreeMap<u32, ModelImage>,
    /// Points by id.
    pub points: BTreeMap<u64, Point3d>,
}

impl Model {
    /// Checks that there are images and that their cameras exist.
    ///
    /// Observations of points or images that are not there are tolerated: tools that thin out a model leave them.
    pub fn check(&self) -> Result<()> {
        if self.images.is_empty() {
            return Err(FormatError::new(ErrorKind::Empty, "the model has no registered images")
                .with_hint("COLMAP could place no image; take more or sharper frames with more texture in view"));
        }
        match self.images.iter().find(|(_, image)| !self.cameras.contains_key(&image.camera_id)) {
            Some((id, image)) => Err(FormatError::new(
                ErrorKind::Inconsistent,
                format!(
                    "image {id} (`{}`) has camera `{}`, which the model does not hold",
                    image.name, image.camera_id
                ),
            )
            .with_hint(
                "cameras and images are of different models, or one of the files is cut off; export the model again",
            )),
            None => Ok(()),
        }
    }
}

fn parse_file<T>(path: &Path, parse: impl FnOnce(&[u8]) -> Result<T>) -> Result<T> {
    let bytes = std::fs::read(path).map_err(|e| {
        FormatError::io(path, "read", &e).with_hint("a model is three files of one kind: cameras, images and points3D")
    })?;
    parse(&bytes).map_err(|e| e.in_file(path))
}

/// Reads the model in `dir`, text or binary, whichever is there; of two the newer one.
pub fn read_model(dir: impl AsRef<Path>) -> Result<Model> {
    read_model_reporting(dir, &Silent)
}

/// As [`read_model`]; a warning says which of two models in one folder was read.
pub fn read_model_reporting(dir: impl AsRef<Path>, reporter: &dyn Reporter) -> Result<Model> {
    let dir = dir.as_ref();
    std::fs::read_dir(dir).map_err(|e| FormatError::io(dir, "open the folder", &e))?;
    let model = match (newest(dir, "txt"), newest(dir, "bin")) {
        (None, None) => return Err(no_model(dir)),
        (Some(_), None) => read_text(dir)?,
        (None, Some(_)) => read_binary(dir)?,
        (Some(text), Some(binary)) => {
            let (model, read, other) =
                if binary > text { (read_binary(dir)?, "bin", "txt") } else { (read_text(dir)?, "txt", "bin") };
            let age = if binary == text { "as old" } else { "older" };
            let message = format!(
                "{}: holds two models; read `images.{read}` with {} images, `images.{other}` is {age}",
                dir.display(),
                model.images.len()
            );
            reporter.warn(Warning::new("two-models", message));
            model
        }
    };
    model.check().map_err(|e| e.in_file(dir))?;
    Ok(model)
}

fn read_text(dir: &Path) -> Result<Model> {
    Ok(Model {
        cameras: parse_file(&dir.join("cameras.txt"), parse_cameras_text)?,
        images: parse_file(&dir.join("images.txt"), parse_images_text)?,
        points: parse_file(&dir.join("points3D.txt"), parse_points_text)?,
    })
}

fn read_binary(dir: &Path) -> Result<Model> {
    Ok(Model {
        cameras: parse_file(&dir.join("cameras.bin"), parse_cameras_binary)?,
        images: parse_file(&dir.join("images.bin"), parse_images_binary)?,
        points: parse_file(&dir.join("points3D.bin"), parse_points_binary)?,
    })
}

/// When cameras or images of a model with this ending were last written; `None` where either is missing and the model of
/// the other ending is not.
fn newest(dir: &Path, ending: &str) -> Option<SystemTime> {
    let time = |name: &str, ending: &str| {
        let file = std::fs::metadata(dir.join(format!("{name}.{ending}"))).ok().filter(Metadata::is_file)?;
        Some(file.modified().unwrap_or(SystemTime::UNIX_EPOCH))
    };
    let other = if ending == "txt" { "bin" } else { "txt" };
    let is_whole = |ending: &str| time("cameras", ending).is_some() && time("images", ending).is_some();
    let found = time("cameras", ending).max(time("images", ending));
    // A part of a model is only read where there is no whole one: then the error names what is missing.
    if is_whole(ending) || (!is_whole(other) && time("cameras", ending).is_some()) { found } else { None }
}

/// The error for a folder without a model; it points at the usual place of one further down.
fn no_model(dir: &Path) -> FormatError {
    let holds_model = |d: &Path| d.join("cameras.txt").exists() || d.join("cameras.bin").exists();
    let below = ["sparse/0", "sparse", "0", "dense/sparse"].map(|d| dir.join(d)).into_iter().find(|d| holds_model(d));
    let hint = match below {
        Some(d) => format!("there is a model in `{}`", d.display()),
        None => "give the folder that COLMAP's mapper wrote, usually `sparse/0`".to_owned(),
    };
    FormatError::new(ErrorKind::Missing, "holds no COLMAP model: neither `cameras.txt` nor `cameras.bin`")
        .in_file(dir)
        .with_hint(hint)
}

/// Writes a text model into `dir`, each file whole or not at all.
pub fn write_text(dir: impl AsRef<Path>, model: &Model) -> Result<()> {
    let dir = dir.as_ref();
    let images = images_to_text(&model.images).map_err(|e| e.in_file(dir.join("images.txt")))?;
    atomic::write_file(dir.join("cameras.txt"), &cameras_to_text(&model.cameras))?;
    atomic::write_file(dir.join("images.txt"), &images)?;
    atomic::write_file(dir.join("points3D.txt"), &points_to_text(&model.points))
}

/// Writes a binary model into `dir`, each file whole or not at all.
pub fn write_binary(dir: impl AsRef<Path>, model: &Model) -> Result<()> {
    let dir = dir.as_ref();
    let cameras = cameras_to_binary(&model.cameras).map_err(|e| e.in_file(dir.join("cameras.bin")))?;
    let images = images_to_binary(&model.images).map_err(|e| e.in_file(dir.join("images.bin")))?;
    atomic::write_file(dir.join("cameras.bin"), &cameras)?;
    atomic::write_file(dir.join("images.bin"), &images)?;
    atomic::write_file(dir.join("points3D.bin"), &points_to_binary(&model.points))
}

/// A pose from a file; a quaternion of no length or of no numbers is none.
fn pose(wxyz: [f64; 4], translation: [f64; 3]) -> Result<Isometry> {
    let norm = wxyz.iter().map(|v| v * v).sum::<f64>().sqrt();
    let usable = norm.is_finite() && norm > 1e-6 && translation.iter().all(|v| v.is_finite());
    if !usable {
        return Err(FormatError::syntax(format!("rotation `{wxyz:?}` and translation `{translation:?}` are no pose")));
    }
    Ok(Isometry::from_wxyz(wxyz, DVec3::from_array(translation)))
}

/// Adds an entry that must not be there yet.
fn insert_new<K: Ord + Copy + std::fmt::Display, V>(
    map: &mut BTreeMap<K, V>,
    what: &str,
    id: K,
    value: V,
) -> Result<()> {
    match map.insert(id, value) {
        None => Ok(()),
        Some(_) => Err(FormatError::new(ErrorKind::Inconsistent, format!("{what} `{id}` stands there twice"))),
    }
}

#[cfg(test)]
mod tests;
