//! `dataset verify` for the layouts of other programs: every file opened, every picture decoded, every camera looked at.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path};

use rayon::prelude::*;
use risorius_formats::{Camera, package};

use crate::export::{FRAMES_FILE, IMAGES_DIR, SPARSE_DIR, TRANSFORMS_FILE};
use crate::import::{Layout, Transforms, layout_cameras, read_transforms};
use crate::table_file::TableFile;
use crate::verify::{Verdict, check_picture};

/// Above this deviation of `RᵀR` from the identity a matrix is no rotation.
const MAX_SKEWNESS: f64 = 1e-3;

/// Checks a folder of `layout`, which is not of the Nerfies family.
pub(crate) fn check(dir: &Path, layout: Layout, verdict: &mut Verdict) {
    let cameras = match layout_cameras(dir, layout) {
        Ok(cameras) => cameras,
        Err(error) => {
            verdict.add_failure(dir, &error);
            return;
        }
    };
    verdict.frames = cameras.len();
    let main = dir.join(match layout {
        Layout::Transforms => TRANSFORMS_FILE,
        Layout::Colmap => SPARSE_DIR,
        Layout::Parquet | Layout::Nerfies => FRAMES_FILE,
    });
    if cameras.is_empty() {
        verdict.add(&main, "names no pictures");
    }
    for (id, camera) in &cameras {
        let pose = &camera.camera_from_world;
        // Written so that a NaN is no rotation.
        let rigid = pose.orthonormality_error() < MAX_SKEWNESS && pose.rotation.determinant() > 0.0;
        if !(rigid && pose.translation.is_finite()) {
            verdict.add(&main, format!("`{id}`: its pose is not a rotation and a translation"));
        }
        let k = camera.intrinsics;
        if k.width == 0 || k.height == 0 || !(k.fx > 0.0 && k.fy > 0.0) {
            verdict.add(&main, format!("`{id}`: its lens makes no sense"));
        }
    }
    let paths = match layout {
        Layout::Transforms => transforms_paths(dir, verdict),
        _ => cameras.keys().map(|id| (id.clone(), format!("{IMAGES_DIR}/{id}.png"))).collect(),
    };
    check_pictures(dir, &cameras, &paths, verdict);
    if layout == Layout::Parquet {
        check_splits(&main, verdict);
    }
}

/// The pictures that `transforms.json` names; its splits may name no others.
fn transforms_paths(dir: &Path, verdict: &mut Verdict) -> BTreeMap<String, String> {
    let path = dir.join(TRANSFORMS_FILE);
    let Ok(Transforms { pictures, train, val, test }) = read_transforms(&path) else { return BTreeMap::new() };
    let named: BTreeSet<&String> = pictures.iter().map(|p| &p.path).collect();
    if named.len() < pictures.len() {
        verdict.add(&path, "a picture stands there twice");
    }
    for (key, list) in [("train_filenames", &train), ("val_filenames", &val), ("test_filenames", &test)] {
        if let Some(stranger) = list.iter().find(|name| !named.contains(name)) {
            verdict.add(&path, format!("`{key}` names `{stranger}`, which is not among `frames`"));
        }
    }
    let train: BTreeSet<&String> = train.iter().collect();
    if let Some(both) = val.iter().find(|name| train.contains(name)) {
        verdict.add(&path, format!("`{both}` is for fitting and held out"));
    }
    pictures.into_iter().map(|p| (p.id, p.file.to_string_lossy().into_owned())).collect()
}

fn check_pictures(
    dir: &Path,
    cameras: &BTreeMap<String, Camera>,
    paths: &BTreeMap<String, String>,
    verdict: &mut Verdict,
) {
    let work: Vec<(&Camera, &String)> = paths.iter().filter_map(|(id, p)| Some((cameras.get(id)?, p))).collect();
    let found: Vec<Verdict> = work
        .par_iter()
        .map(|(camera, path)| {
            let mut own = Verdict::default();
            let relative = Path::new(path.as_str());
            // A package must stay in its folder: other machines have other folders.
            if relative.components().any(|c| !matches!(c, Component::Normal(_) | Component::CurDir)) {
                own.add(dir.join(TRANSFORMS_FILE), format!("`{path}` leads out of the folder"));
                return own;
            }
            if let Err(error) = package::check_file(dir, dir.join(relative)) {
                own.add_error(dir, &error);
                return own;
            }
            let size = (camera.intrinsics.width, camera.intrinsics.height);
            own.pictures += usize::from(check_picture(&dir.join(relative), size, &mut own));
            own
        })
        .collect();
    for own in found {
        verdict.pictures += own.pictures;
        verdict.problems.extend(own.problems);
    }
}

/// Ids stand there once, splits and attributes are what they may be.
fn check_splits(path: &Path, verdict: &mut Verdict) {
    let mut problems = Vec::new();
    let outcome = TableFile::open(path).and_then(|file| {
        let ids = file.texts("id")?;
        let distinct: BTreeSet<_> = ids.iter().flatten().collect();
        if distinct.len() < ids.len() {
            problems.push("an id is missing or stands there twice".to_owned());
        }
        let known = |s: &Option<String>| matches!(s.as_deref(), Some("train" | "val" | "none"));
        if let Some(row) = file.texts("split")?.iter().position(|s| !known(s)) {
            problems.push(format!("row {}: `split` is neither `train`, `val` nor `none`", row + 1));
        }
        let attributes: Vec<String> = file.names().into_iter().filter(|n| n.ends_with("_attribute")).collect();
        for name in &attributes {
            let values = file.f32s(name)?;
            if let Some(row) = values.iter().position(|v| v.is_some_and(|v| !(-1.0..=1.0).contains(&v))) {
                problems.push(format!("row {}: `{name}` is out of −1 to 1", row + 1));
            }
        }
        Ok(attributes.len())
    });
    match outcome {
        Ok(attributes) => verdict.attributes = attributes,
        Err(error) => verdict.add_failure(path, &error),
    }
    for problem in problems {
        verdict.add(path, problem);
    }
}
