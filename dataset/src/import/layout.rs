//! Which layout a folder has, its cameras and its pictures.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use risorius_formats::nerfies::{self, Dataset};
use risorius_formats::{Camera, ErrorKind, FormatError, colmap};

use super::{Picture, read_transforms, refused};
use crate::error::Result;
use crate::export::{FRAMES_FILE, IMAGES_DIR, SPARSE_DIR, TRANSFORMS_FILE, scales_in};
use crate::table_file::TableFile;

/// A layout that can be opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Layout {
    /// Nerfies, HyperNeRF, CoNeRF, CoNFies, and our own datasets.
    Nerfies,
    /// nerfstudio and instant-ngp.
    Transforms,
    /// A COLMAP model with its pictures.
    Colmap,
    /// Parquet and pictures.
    Parquet,
}

/// The layout of the folder `dir`.
pub fn layout_of(dir: &Path) -> Result<Layout> {
    if !dir.is_dir() {
        let message = if dir.exists() { "is not a folder" } else { "does not exist" };
        return Err(FormatError::new(ErrorKind::Missing, message)
            .in_file(dir)
            .with_hint("name the folder of a dataset")
            .into());
    }
    let has = |name: &str| dir.join(name).is_file();
    if has("dataset.json") {
        Ok(Layout::Nerfies)
    } else if has(TRANSFORMS_FILE) {
        Ok(Layout::Transforms)
    } else if has(FRAMES_FILE) {
        Ok(Layout::Parquet)
    } else if has("sparse/0/cameras.txt") || has("sparse/0/cameras.bin") {
        Ok(Layout::Colmap)
    } else {
        Err(refused(
            dir,
            "is no dataset: it has neither `dataset.json`, `transforms.json`, `frames.parquet` nor `sparse/0`",
            "Nerfies, CoNeRF, nerfstudio, COLMAP and Parquet folders can be opened",
        ))
    }
}

/// The cameras that the layout's own files state, by id, at the pictures' size. Not for the Nerfies family.
pub(crate) fn cameras(dir: &Path, layout: Layout) -> Result<BTreeMap<String, Camera>> {
    match layout {
        Layout::Nerfies => Ok(BTreeMap::new()),
        Layout::Transforms => transforms_cameras(dir),
        Layout::Colmap => colmap_cameras(dir),
        Layout::Parquet => {
            let file = TableFile::open(&dir.join(FRAMES_FILE))?;
            let ids = file.texts("id")?;
            let scales = file.u32s("image_scale")?;
            let mut cameras = BTreeMap::new();
            for ((id, scale), camera) in ids.into_iter().zip(scales).zip(file.cameras()?) {
                let id = id.ok_or_else(|| file.bad("a row has no id"))?;
                nerfies::check_id(&id).map_err(|e| e.in_file(dir.join(FRAMES_FILE)))?;
                cameras.insert(id, camera.reduced(scale.unwrap_or(1).max(1)));
            }
            Ok(cameras)
        }
    }
}

/// The id of a picture's path: its name without folder and ending.
pub(crate) fn id_of(path: &str) -> Option<String> {
    let stem = Path::new(path).file_stem()?.to_str()?.to_owned();
    nerfies::check_id(&stem).is_ok().then_some(stem)
}

fn transforms_cameras(dir: &Path) -> Result<BTreeMap<String, Camera>> {
    let pictures = read_transforms(&dir.join(TRANSFORMS_FILE))?.pictures;
    Ok(pictures.into_iter().map(|p| (p.id, p.camera)).collect())
}

fn colmap_cameras(dir: &Path) -> Result<BTreeMap<String, Camera>> {
    let model = colmap::read_model(dir.join(SPARSE_DIR))?;
    let mut cameras = BTreeMap::new();
    for image in model.images.values() {
        let bad = |message: String| {
            FormatError::new(ErrorKind::Inconsistent, message).in_file(dir.join(SPARSE_DIR).join("images.txt"))
        };
        let id = id_of(&image.name).ok_or_else(|| bad(format!("the image name `{}` is no file name", image.name)))?;
        let lens = model
            .cameras
            .get(&image.camera_id)
            .ok_or_else(|| bad(format!("image `{}` has a camera that is not there", image.name)))?;
        cameras.insert(id, Camera { intrinsics: lens.intrinsics()?, camera_from_world: image.camera_from_world });
    }
    Ok(cameras)
}

/// Cameras that differ by less than this are the same: quaternions of rounded rotations keep no more.
const SAME: f64 = 1e-5;

/// Compares the layout's cameras with those of our own folder beside it; where somebody changed one, theirs counts.
pub(crate) fn take_cameras(dir: &Path, layout: Layout, dataset: &mut Dataset) -> Result<()> {
    if layout == Layout::Nerfies {
        for (id, camera) in &mut dataset.cameras {
            *camera = nerfies::read_camera(nerfies::camera_path(dir, id))?;
        }
        return Ok(());
    }
    let theirs = cameras(dir, layout)?;
    for (id, own) in &mut dataset.cameras {
        let Some(their) = theirs.get(id) else {
            return Err(FormatError::new(
                ErrorKind::Missing,
                format!("the layout's own files have no camera for `{id}`"),
            )
            .in_file(dir)
            .into());
        };
        let scale = scale_between(own, their).ok_or_else(|| {
            FormatError::new(ErrorKind::Inconsistent, format!("the camera of `{id}` has another picture size"))
                .in_file(dir)
        })?;
        if !same(&own.reduced(scale), their) {
            *own = enlarged(their, scale);
        }
    }
    Ok(())
}

/// How many times smaller the pictures of `small` are: 1, 2, 4 or 8.
fn scale_between(full: &Camera, small: &Camera) -> Option<u32> {
    let size = |c: &Camera| (c.intrinsics.width, c.intrinsics.height);
    crate::SCALES.into_iter().find(|&s| size(&full.reduced(s)) == size(small))
}

fn same(a: &Camera, b: &Camera) -> bool {
    let (p, q) = (a.intrinsics, b.intrinsics);
    let lens = [(p.fx, q.fx), (p.fy, q.fy), (p.cx, q.cx), (p.cy, q.cy)];
    let close = |x: f64, y: f64| (x - y).abs() <= SAME * x.abs().max(1.0);
    let distortion = p
        .distortion
        .radial
        .iter()
        .zip(&q.distortion.radial)
        .chain(p.distortion.tangential.iter().zip(&q.distortion.tangential));
    let turn = a.camera_from_world.rotation - b.camera_from_world.rotation;
    let reach = a.center().length().max(1e-9);
    lens.iter().all(|&(x, y)| close(x, y))
        && distortion.into_iter().all(|(x, y)| close(*x, *y))
        && turn.to_cols_array().iter().all(|v| v.abs() <= SAME)
        && a.center().distance(b.center()) <= SAME * reach
}

/// The camera of a picture that is `scale` times larger.
fn enlarged(camera: &Camera, scale: u32) -> Camera {
    let mut result = *camera;
    let k = &mut result.intrinsics;
    (k.width, k.height) = (k.width * scale, k.height * scale);
    for v in [&mut k.fx, &mut k.fy, &mut k.cx, &mut k.cy, &mut k.skew] {
        *v *= f64::from(scale);
    }
    result
}

/// The pictures of the folder, each of which has to be there.
pub(crate) fn pictures(dir: &Path, layout: Layout, dataset: &Dataset) -> Result<Vec<Picture>> {
    let mut found = Vec::new();
    if layout == Layout::Nerfies {
        for scale in scales_in(dir) {
            let path = |id: &String| (nerfies::rgb_path(dir, scale, id), scale, id.clone());
            found.extend(dataset.ids.iter().map(path));
        }
        if found.is_empty() {
            return Err(refused(&dir.join("rgb"), "has no pictures at 1x, 2x, 4x or 8x", "copy the whole folder"));
        }
    } else {
        let theirs = cameras(dir, layout)?;
        for id in &dataset.ids {
            let scale = theirs.get(id).and_then(|c| scale_between(&dataset.cameras[id], c)).unwrap_or(1);
            found.push((dir.join(IMAGES_DIR).join(format!("{id}.png")), scale, id.clone()));
        }
    }
    match found.iter().find(|(path, ..)| !path.is_file()) {
        Some((path, ..)) => Err(missing_picture(path)),
        None => Ok(found),
    }
}

fn missing_picture(path: &PathBuf) -> crate::DatasetError {
    FormatError::new(ErrorKind::Missing, "the picture is not there")
        .in_file(path)
        .with_hint("copy the whole folder")
        .into()
}
