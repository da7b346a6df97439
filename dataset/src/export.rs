//! `dataset export`: the dataset for other people's programs.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use glam::{DMat3, DVec3};
use risorius_formats::atomic::{self, AtomicDir};
use risorius_formats::nerfies::{self, Dataset};
use risorius_formats::pose_report::write_json;
use risorius_formats::{AttributeTable, Camera, ErrorKind, FormatError, Isometry, Reporter};
use serde::Serialize;

use crate::build::DATASET_FILE;
use crate::error::{DatasetError, Result};
use crate::tables::{camera_columns, column, write_table};
use crate::{SCALES, TAKE_OFFSET};

const TRANSFORMS_FILE: &str = "transforms.json";
const FRAMES_FILE: &str = "frames.parquet";

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
    /// `frames.parquet`: a row per frame with its split, AUs and camera.
    Parquet,
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
    let dataset = Dataset::read(dir)?;
    if is_within(out, dir) {
        return Err(DatasetError::Option {
            message: format!("{}: lies in the dataset itself, or is it", out.display()),
            hint: "export to a folder of its own".to_owned(),
        });
    }
    atomic::check_replaceable(out, "an export", &[DATASET_FILE, TRANSFORMS_FILE, FRAMES_FILE])?;
    let staging = AtomicDir::create(out)?;
    let files = match target {
        Target::Nerfies => to_nerfies(&dataset, dir, staging.path(), reporter)?,
        Target::Transforms => to_transforms(&dataset, dir, staging.path(), reporter)?,
        Target::Parquet => to_parquet(&dataset, dir, staging.path())?,
    };
    if reporter.cancelled() {
        return Err(DatasetError::Cancelled);
    }
    staging.commit()?;
    Ok(Exported { frames: dataset.ids.len(), files })
}

/// Whether `inner` is `outer` or lies in it.
fn is_within(inner: &Path, outer: &Path) -> bool {
    let Ok(outer) = outer.canonicalize() else { return false };
    let Ok(inner) = std::path::absolute(inner) else { return false };
    // What does not exist yet lies where its nearest existing folder lies.
    let existing = inner.ancestors().find_map(|p| p.canonicalize().ok());
    existing.is_some_and(|p| p.starts_with(&outer))
}

fn copy(from: &Path, to: &Path) -> Result<()> {
    std::fs::copy(from, to).map_err(|e| FormatError::io(from, "copy", &e))?;
    Ok(())
}

fn make(dir: &Path) -> Result<()> {
    Ok(std::fs::create_dir_all(dir).map_err(|e| FormatError::io(dir, "create the folder", &e))?)
}

fn scales_in(dir: &Path) -> Vec<u32> {
    SCALES.into_iter().filter(|s| dir.join("rgb").join(format!("{s}x")).is_dir()).collect()
}

fn to_nerfies(dataset: &Dataset, dir: &Path, out: &Path, reporter: &dyn Reporter) -> Result<usize> {
    let plain = Dataset { extras: None, ..dataset.clone() };
    plain.write(out)?;
    let mut files = dataset.ids.len() + 5;
    let scales = scales_in(dir);
    reporter.stage("copy pictures", Some((scales.len() * dataset.ids.len()) as u64));
    for scale in scales {
        make(&out.join("rgb").join(format!("{scale}x")))?;
        for id in &dataset.ids {
            copy(&nerfies::rgb_path(dir, scale, id), &nerfies::rgb_path(out, scale, id))?;
            files += 1;
            reporter.advance(1);
        }
    }
    make(&out.join("annotations"))?;
    for id in &dataset.ids {
        let from = nerfies::polygons_path(dir, id);
        if from.exists() {
            copy(&from, &nerfies::polygons_path(out, id))?;
            files += 1;
        }
    }
    Ok(files)
}

#[derive(Serialize)]
struct TransformsFile {
    camera_model: &'static str,
    frames: Vec<TransformsFrame>,
    train_filenames: Vec<String>,
    val_filenames: Vec<String>,
    test_filenames: Vec<String>,
}

#[derive(Serialize)]
struct TransformsFrame {
    file_path: String,
    w: u32,
    h: u32,
    fl_x: f64,
    fl_y: f64,
    cx: f64,
    cy: f64,
    k1: f64,
    k2: f64,
    k3: f64,
    p1: f64,
    p2: f64,
    transform_matrix: [[f64; 4]; 4],
    time_id: Option<u32>,
    /// Attribute −1..1 by name; other programs pass it by.
    attributes: BTreeMap<String, f32>,
}

/// `world_from_camera` with OpenGL's camera axes: x right, y up, z backwards.
pub fn opengl_world_from_camera(camera: &Camera) -> [[f64; 4]; 4] {
    let flip = Isometry::new(DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)), DVec3::ZERO);
    let rows = camera.camera_from_world.inverse().compose(&flip).to_rows();
    [rows[0], rows[1], rows[2], [0.0, 0.0, 0.0, 1.0]]
}

/// The attribute values of each frame, by the frame's number.
fn attributes_of(dataset: &Dataset) -> BTreeMap<u32, BTreeMap<usize, f32>> {
    let mut result: BTreeMap<u32, BTreeMap<usize, f32>> = BTreeMap::new();
    for a in &dataset.annotations {
        result.entry(a.frame).or_default().insert(a.class, a.value);
    }
    result
}

fn to_transforms(dataset: &Dataset, dir: &Path, out: &Path, reporter: &dyn Reporter) -> Result<usize> {
    let scales = scales_in(dir);
    let wanted = dataset.extras.as_ref().map(|e| e.default_scale).filter(|s| scales.contains(s));
    let Some(scale) = wanted.or(scales.first().copied()) else {
        return Err(FormatError::new(ErrorKind::Missing, "has no pictures").in_file(dir.join("rgb")).into());
    };
    let values = attributes_of(dataset);
    make(&out.join("images"))?;
    reporter.stage("copy pictures", Some(dataset.ids.len() as u64));
    let name = |id: &String| format!("images/{id}.png");
    let mut frames = Vec::with_capacity(dataset.ids.len());
    for id in &dataset.ids {
        copy(&nerfies::rgb_path(dir, scale, id), &out.join(name(id)))?;
        let camera = dataset.cameras[id].reduced(scale);
        let k = camera.intrinsics;
        let own = id.parse().ok().and_then(|n: u32| values.get(&n));
        let attributes = own
            .into_iter()
            .flatten()
            .map(|(&c, &v)| (dataset.mapping.get(c).cloned().unwrap_or_else(|| c.to_string()), v));
        frames.push(TransformsFrame {
            file_path: name(id),
            w: k.width,
            h: k.height,
            fl_x: k.fx,
            fl_y: k.fy,
            cx: k.cx,
            cy: k.cy,
            k1: k.distortion.radial[0],
            k2: k.distortion.radial[1],
            k3: k.distortion.radial[2],
            p1: k.distortion.tangential[0],
            p2: k.distortion.tangential[1],
            transform_matrix: opengl_world_from_camera(&camera),
            time_id: dataset.source_frame(id),
            attributes: attributes.collect(),
        });
        reporter.advance(1);
    }
    let file = TransformsFile {
        camera_model: "OPENCV",
        frames,
        train_filenames: dataset.train_ids.iter().map(name).collect(),
        val_filenames: dataset.val_ids.iter().map(name).collect(),
        test_filenames: dataset.val_ids.iter().map(name).collect(),
    };
    write_json(out.join(TRANSFORMS_FILE), &file)?;
    Ok(dataset.ids.len() + 1)
}

/// A row per frame. `AUxx_attribute` is −1..1; `AUxx_intensity` is its inverse by eq. 1, 0–5, which tops out at 0.8 of
/// the capture's largest value; null where the AU is inactive or the folder has no `attributes.toml`.
fn to_parquet(dataset: &Dataset, dir: &Path, out: &Path) -> Result<usize> {
    let path = out.join(FRAMES_FILE);
    let table = if dir.join("attributes.toml").exists() {
        Some(AttributeTable::read(dir.join("attributes.toml"))?)
    } else {
        None
    };
    let values = attributes_of(dataset);
    let ids = &dataset.ids;
    let val: BTreeSet<_> = dataset.val_ids.iter().collect();
    let train: BTreeSet<_> = dataset.train_ids.iter().collect();
    let split = |id: &String| {
        if val.contains(id) {
            "val"
        } else if train.contains(id) {
            "train"
        } else {
            "none"
        }
    };
    let takes = dataset.extras.as_ref().map(|e| e.takes.clone()).unwrap_or_default();
    let number = |id: &String| dataset.source_frame(id);
    let take_of = |id: &String| -> Option<String> {
        let index = if takes.len() > 1 { number(id)? / TAKE_OFFSET } else { 0 };
        takes.get(index as usize).cloned()
    };
    let frame_of = |id: &String| number(id).map(|n| if takes.len() > 1 { n % TAKE_OFFSET } else { n });
    let mut columns = vec![
        column("id", ids.clone()),
        column("take", ids.iter().map(take_of).collect::<Vec<_>>()),
        column("frame", ids.iter().map(frame_of).collect::<Vec<_>>()),
        column("split", ids.iter().map(split).collect::<Vec<_>>()),
    ];
    let without: BTreeSet<_> = dataset.extras.iter().flat_map(|e| &e.ids_without_masks).collect();
    columns.push(column("has_masks", ids.iter().map(|id| !without.contains(id)).collect::<Vec<_>>()));
    for (class, name) in dataset.mapping.iter().enumerate() {
        let value =
            |id: &String| id.parse().ok().and_then(|n: u32| values.get(&n)).and_then(|v| v.get(&class)).copied();
        let spec = table.as_ref().and_then(|t| t.attributes.get(class)).filter(|s| s.active);
        columns.push(column(&format!("{name}_attribute"), ids.iter().map(value).collect::<Vec<_>>()));
        let intensity = |id| Some(spec?.intensity_from_attribute(value(id)?));
        columns.push(column(&format!("{name}_intensity"), ids.iter().map(intensity).collect::<Vec<_>>()));
    }
    columns.extend(camera_columns(&ids.iter().map(|id| &dataset.cameras[id]).collect::<Vec<_>>()));
    write_table(&path, columns)?;
    Ok(1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use risorius_formats::Intrinsics;

    #[test]
    fn opengl_cameras_look_along_minus_z_with_y_up() {
        let pose = Isometry::from_wxyz([0.9, 0.1, -0.3, 0.2], DVec3::new(0.3, -0.2, 4.0));
        let camera = Camera { intrinsics: Intrinsics::pinhole(64, 48, 50.0), camera_from_world: pose };
        let m = opengl_world_from_camera(&camera);
        let column = |j: usize| DVec3::new(m[0][j], m[1][j], m[2][j]);
        let forward = camera.ray_direction(glam::DVec2::new(32.0, 24.0)).unwrap();
        assert!((column(2) + forward).length() < 1e-12 && (column(3) - camera.center()).length() < 1e-12);
        // A point above the optical axis (OpenGL: +y) lands in the upper half of the picture.
        let above = camera.center() + forward * 2.0 + column(1) * 0.3;
        assert!(camera.project(above).y < 24.0);
        assert!((column(0).cross(column(1)) - column(2)).length() < 1e-12 && m[3] == [0.0, 0.0, 0.0, 1.0]);
    }
}
