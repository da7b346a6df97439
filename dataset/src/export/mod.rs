//! `dataset export`: the dataset for other people's programs.
//!
//! What a layout cannot express goes into a folder `risorius/` beside it, which other programs pass by and
//! [`import`](crate::import) reads: every export that is imported again is the same dataset.

mod card;
mod colmap;
mod parquet;
mod sidecar;
mod transforms;

use std::collections::BTreeMap;
use std::path::Path;

use risorius_formats::atomic::{self, AtomicDir};
use risorius_formats::nerfies::{self, Dataset};
use risorius_formats::{ErrorKind, FormatError, Reporter};
use serde::Serialize;

use crate::SCALES;
use crate::build::DATASET_FILE;
use crate::error::{DatasetError, Result};

pub use colmap::{IMAGES_DIR, SPARSE_DIR};
pub use parquet::FRAMES_FILE;
pub(crate) use parquet::copy_tables;
pub use sidecar::SIDECAR_DIR;
pub use transforms::{TRANSFORMS_FILE, opengl_world_from_camera};

pub(crate) use transforms::FLIP;

/// A layout to export to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// The folder of the Nerfies family without our additions.
    ///
    /// Nerfies and HyperNeRF open it as it is. The released CoNeRF and CoNFies loaders also want
    /// `rgb/<s>x/<id>_depth.npy`; there is no measured depth, and none is made up.
    Nerfies,
    /// `transforms.json` as nerfstudio and instant-ngp read it, with OpenGL axes, and the pictures beside it.
    Transforms,
    /// `sparse/0` as a COLMAP text model, and the pictures in `images/`.
    Colmap,
    /// `frames.parquet`: a row per frame with its split, AUs and camera; the pictures, the tables and a dataset card.
    Parquet,
}

/// How to export.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ExportOptions {
    /// Whether the folder `risorius/` is left out; what the layout cannot express is then lost.
    pub plain: bool,
}

/// What was written.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Exported {
    /// Frames.
    pub frames: usize,
    /// Files.
    pub files: usize,
}

/// Exports the dataset in `dir` to the folder `out`, whole or not at all.
pub fn export(dir: &Path, target: Target, out: &Path, reporter: &dyn Reporter) -> Result<Exported> {
    export_with(dir, target, out, ExportOptions::default(), reporter)
}

/// The same as [`export`], with options.
pub fn export_with(
    dir: &Path,
    target: Target,
    out: &Path,
    options: ExportOptions,
    reporter: &dyn Reporter,
) -> Result<Exported> {
    let dataset = Dataset::read(dir)?;
    if is_within(out, dir) {
        return Err(DatasetError::Option {
            message: format!("{}: lies in the dataset itself, or is it", out.display()),
            hint: "export to a folder of its own".to_owned(),
        });
    }
    let marks = [DATASET_FILE, TRANSFORMS_FILE, FRAMES_FILE, "sparse/0/cameras.txt"];
    atomic::check_replaceable(out, "an export", &marks)?;
    let staging = AtomicDir::create(out)?;
    match target {
        Target::Nerfies => to_nerfies(&dataset, dir, staging.path(), reporter)?,
        Target::Transforms => transforms::write(&dataset, dir, staging.path(), reporter)?,
        Target::Colmap => colmap::write(&dataset, dir, staging.path(), reporter)?,
        Target::Parquet => parquet::write(&dataset, dir, staging.path(), reporter)?,
    }
    if !options.plain {
        let scales = if target == Target::Nerfies { scales_in(dir) } else { vec![scale_of(&dataset, dir)?] };
        sidecar::write(&dataset, dir, &scales, staging.path())?;
    }
    if reporter.cancelled() {
        return Err(DatasetError::Cancelled);
    }
    let files = count_files(staging.path())?;
    staging.commit()?;
    Ok(Exported { frames: dataset.ids.len(), files })
}

/// Files below `dir`.
fn count_files(dir: &Path) -> Result<usize> {
    let mut count = 0;
    for entry in std::fs::read_dir(dir).map_err(|e| FormatError::io(dir, "list", &e))? {
        let path = entry.map_err(|e| FormatError::io(dir, "list", &e))?.path();
        count += if path.is_dir() { count_files(&path)? } else { 1 };
    }
    Ok(count)
}

/// Whether `inner` is `outer` or lies in it.
pub(crate) fn is_within(inner: &Path, outer: &Path) -> bool {
    let Ok(outer) = outer.canonicalize() else { return false };
    let Ok(inner) = std::path::absolute(inner) else { return false };
    // What does not exist yet lies where its nearest existing folder lies.
    let existing = inner.ancestors().find_map(|p| p.canonicalize().ok());
    existing.is_some_and(|p| p.starts_with(&outer))
}

/// Copies a file; the folder that it goes to is there.
pub(crate) fn copy(from: &Path, to: &Path) -> Result<()> {
    std::fs::copy(from, to).map_err(|e| match e.kind() {
        std::io::ErrorKind::StorageFull | std::io::ErrorKind::QuotaExceeded => FormatError::io(to, "write", &e),
        _ => FormatError::io(from, "copy", &e),
    })?;
    Ok(())
}

pub(crate) fn make(dir: &Path) -> Result<()> {
    Ok(std::fs::create_dir_all(dir).map_err(|e| FormatError::io(dir, "create the folder", &e))?)
}

/// The scales of which the dataset has pictures.
pub(crate) fn scales_in(dir: &Path) -> Vec<u32> {
    SCALES.into_iter().filter(|s| dir.join("rgb").join(format!("{s}x")).is_dir()).collect()
}

/// The one scale of layouts that have only one: the dataset's own, else the finest.
fn scale_of(dataset: &Dataset, dir: &Path) -> Result<u32> {
    let scales = scales_in(dir);
    let wanted = dataset.extras.as_ref().map(|e| e.default_scale).filter(|s| scales.contains(s));
    wanted
        .or(scales.first().copied())
        .ok_or_else(|| FormatError::new(ErrorKind::Missing, "has no pictures").in_file(dir.join("rgb")).into())
}

/// Copies the pictures of one scale to `images/<id>.png` and returns the scale.
fn copy_images(dataset: &Dataset, dir: &Path, out: &Path, reporter: &dyn Reporter) -> Result<u32> {
    let scale = scale_of(dataset, dir)?;
    make(&out.join(IMAGES_DIR))?;
    reporter.stage("copy pictures", Some(dataset.ids.len() as u64));
    for id in &dataset.ids {
        copy(&nerfies::rgb_path(dir, scale, id), &out.join(image_name(id)))?;
        reporter.advance(1);
    }
    Ok(scale)
}

/// `images/<id>.png`.
fn image_name(id: &str) -> String {
    format!("{IMAGES_DIR}/{id}.png")
}

/// Brings the camera files over as they are: a position that is read and written again may lose its last bit.
fn copy_cameras(dataset: &Dataset, dir: &Path, out: &Path) -> Result<()> {
    dataset.ids.iter().try_for_each(|id| copy(&nerfies::camera_path(dir, id), &nerfies::camera_path(out, id)))
}

fn to_nerfies(dataset: &Dataset, dir: &Path, out: &Path, reporter: &dyn Reporter) -> Result<()> {
    let plain = Dataset { extras: None, ..dataset.clone() };
    plain.write(out)?;
    copy_cameras(dataset, dir, out)?;
    let scales = scales_in(dir);
    reporter.stage("copy pictures", Some((scales.len() * dataset.ids.len()) as u64));
    for scale in scales {
        make(&out.join("rgb").join(format!("{scale}x")))?;
        for id in &dataset.ids {
            copy(&nerfies::rgb_path(dir, scale, id), &nerfies::rgb_path(out, scale, id))?;
            reporter.advance(1);
        }
    }
    make(&out.join("annotations"))?;
    for id in &dataset.ids {
        let from = nerfies::polygons_path(dir, id);
        if from.exists() {
            copy(&from, &nerfies::polygons_path(out, id))?;
        }
    }
    Ok(())
}

/// The attribute values of each frame, by the frame's number.
pub(crate) fn attributes_of(dataset: &Dataset) -> BTreeMap<u32, BTreeMap<usize, f32>> {
    let mut result: BTreeMap<u32, BTreeMap<usize, f32>> = BTreeMap::new();
    for a in &dataset.annotations {
        result.entry(a.frame).or_default().insert(a.class, a.value);
    }
    result
}
