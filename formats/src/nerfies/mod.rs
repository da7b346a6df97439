//! The dataset folder of Nerfies, HyperNeRF and CoNeRF, and what this project adds (fact sheet §3).
//!
//! ```text
//! DIR/dataset.json  metadata.json  scene.json     ids and splits, indices per frame, centre and scale
//! DIR/camera/<id>.json                            one per frame, in pixels of the 1x image
//! DIR/rgb/<s>x/<id>.png                           s of 1, 2, 4, 8
//! DIR/annotations.yml  mapping.yml                attribute values and names             (may be absent)
//! DIR/annotations/<id>.json                       LabelMe polygons, pixels of the 1x image (may be absent)
//! DIR/regions/<s>x/<id>.png                       ours: label image, 0 = rest, 1..N      (may be absent)
//! DIR/valid/<s>x/<id>.png                         ours: where the pixels may be fitted   (may be absent)
//! DIR/head/<s>x/<id>.png                          ours: what is head and what background (may be absent)
//! ```

mod camera;
mod files;
mod labelme;
mod raster;
mod yaml;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::pose_report::PoseMethod;
use crate::{Camera, Result, SceneBounds};

pub use camera::{parse_camera, read_camera, write_camera};
pub use files::check_id;
pub use labelme::{Polygon, Polygons};
pub use raster::fill_polygon;
pub use yaml::{parse_annotations, parse_mapping};

/// Indices of one frame in `metadata.json`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct FrameMetadata {
    /// Index of the deformation code.
    pub warp_id: u32,
    /// Index of the appearance code.
    #[serde(default)]
    pub appearance_id: u32,
    /// Index of the camera.
    #[serde(default)]
    pub camera_id: u32,
    /// Source frame number.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time_id: Option<u32>,
}

/// One entry of `annotations.yml`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Annotation {
    /// Index of the attribute.
    pub class: usize,
    /// The frame's id as a number.
    pub frame: u32,
    /// The attribute, −1..1.
    pub value: f32,
}

/// What this project knows beyond the Nerfies family; the key `risorius` of `dataset.json`, which loaders ignore.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Extras {
    /// Version of the layout.
    pub version: u32,
    /// The image scale that fitting uses unless told otherwise.
    pub default_scale: u32,
    /// How the cameras were found.
    pub method: PoseMethod,
    /// The middle of the face, world units.
    pub head_center: DVec3,
    /// Distance of the farthest face landmark from it, world units.
    pub head_radius: f64,
    /// Corners of the convex hull of the head; only with the head route, where `valid/` masks exist.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub head_hull_in_world: Option<Vec<DVec3>>,
    /// World units per metre, where known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub units_per_metre: Option<f64>,
    /// Names of the takes.
    pub takes: Vec<String>,
    /// Ids of frames without region masks.
    #[serde(default)]
    pub ids_without_masks: Vec<String>,
    /// The frame for fitting that shows a resting face best: AUs near their neutral values, and symmetric.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub neutral_id: Option<String>,
    /// The program that wrote this, with its version.
    pub written_by: String,
}

/// A whole dataset without its pixels.
#[derive(Clone, Debug, PartialEq)]
pub struct Dataset {
    /// All ids, in the order of the file; ours are sorted.
    pub ids: Vec<String>,
    /// Ids for fitting.
    pub train_ids: Vec<String>,
    /// Ids held out.
    pub val_ids: Vec<String>,
    /// Per id.
    pub metadata: BTreeMap<String, FrameMetadata>,
    /// Centre, scale, near, far.
    pub scene: SceneBounds,
    /// Per id, for the full-size (1x) image.
    pub cameras: BTreeMap<String, Camera>,
    /// Attribute names in class order (`mapping.yml`); empty where the folder has none.
    pub mapping: Vec<String>,
    /// `annotations.yml`; empty where the folder has none.
    pub annotations: Vec<Annotation>,
    /// Our additions; `None` for folders of other tools.
    pub extras: Option<Extras>,
}

impl Dataset {
    /// Reads the folder's JSON and YAML files. `annotations.yml` and `mapping.yml` may be absent.
    pub fn read(dir: impl AsRef<Path>) -> Result<Self> {
        files::read(dir.as_ref())
    }

    /// Writes them into `dir`, each whole or not at all; empty annotations and mappings leave no file.
    pub fn write(&self, dir: impl AsRef<Path>) -> Result<()> {
        files::write(self, dir.as_ref())
    }

    /// The number of the source frame that `id` shows: its `time_id`, else the id as a number, else its `warp_id`.
    pub fn source_frame(&self, id: &str) -> Option<u32> {
        let metadata = self.metadata.get(id);
        metadata.and_then(|m| m.time_id).or_else(|| id.parse().ok()).or_else(|| metadata.map(|m| m.warp_id))
    }
}

/// `DIR/camera/<id>.json`.
pub fn camera_path(dir: impl AsRef<Path>, id: &str) -> PathBuf {
    dir.as_ref().join("camera").join(format!("{id}.json"))
}

/// `DIR/annotations/<id>.json`: LabelMe polygons.
pub fn polygons_path(dir: impl AsRef<Path>, id: &str) -> PathBuf {
    dir.as_ref().join("annotations").join(format!("{id}.json"))
}

/// `DIR/rgb/<s>x/<id>.png`.
pub fn rgb_path(dir: impl AsRef<Path>, scale: u32, id: &str) -> PathBuf {
    dir.as_ref().join("rgb").join(format!("{scale}x")).join(format!("{id}.png"))
}

/// `DIR/regions/<s>x/<id>.png`: label image, 0 = rest, 1..N = regions.
pub fn region_path(dir: impl AsRef<Path>, scale: u32, id: &str) -> PathBuf {
    dir.as_ref().join("regions").join(format!("{scale}x")).join(format!("{id}.png"))
}

/// `DIR/valid/<s>x/<id>.png`: 255 where the pixel may be fitted, 0 where not; absent when every pixel may.
pub fn valid_path(dir: impl AsRef<Path>, scale: u32, id: &str) -> PathBuf {
    dir.as_ref().join("valid").join(format!("{scale}x")).join(format!("{id}.png"))
}

/// `DIR/head/<s>x/<id>.png`: 255 on the head, 0 on what lies behind it; absent where nobody knows.
pub fn head_path(dir: impl AsRef<Path>, scale: u32, id: &str) -> PathBuf {
    dir.as_ref().join("head").join(format!("{scale}x")).join(format!("{id}.png"))
}

#[cfg(test)]
#[path = "nerfies_tests.rs"]
mod tests;
