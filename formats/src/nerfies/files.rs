//! The JSON and YAML files of a dataset folder, read and written together.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use glam::DVec3;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::{Dataset, Extras, FrameMetadata, camera, camera_path, yaml};
use crate::pose_report::{json_error, write_json};
use crate::{ErrorKind, FormatError, Result, SceneBounds, atomic, package};

#[derive(Serialize, Deserialize)]
struct DatasetFile {
    #[serde(default)]
    count: u64,
    #[serde(default)]
    num_exemplars: u64,
    ids: Vec<String>,
    #[serde(default)]
    train_ids: Vec<String>,
    #[serde(default)]
    val_ids: Vec<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    risorius: Option<Extras>,
}

#[derive(Serialize, Deserialize)]
struct SceneFile {
    scale: f64,
    center: [f64; 3],
    near: f64,
    far: f64,
}

/// The longest name that every file system takes, less the suffixes that are put behind it.
const MAX_ID_BYTES: usize = 200;

/// What to do about a dataset whose own files do not hold what `dataset build` wrote.
const DAMAGED: &str = "the dataset is damaged; build it again with `dataset build`";

/// Fails unless `id` can be the name of a file in the folder and nothing else: ids come from a file that somebody
/// else wrote, and `../x` must not lead out of the folder.
pub fn check_id(id: &str) -> Result<()> {
    let bad = id.is_empty()
        || id.len() > MAX_ID_BYTES
        || id.starts_with('.')
        || id.chars().any(|c| matches!(c, '/' | '\\' | ':') || c.is_control());
    if !bad {
        return Ok(());
    }
    let shown: String = id.chars().take(40).collect();
    Err(FormatError::new(ErrorKind::Inconsistent, format!("the id {shown:?} cannot be a file name"))
        .with_hint("ids are plain names such as `000123`"))
}

/// Reads a file of the folder `dir`.
fn read_json<T: DeserializeOwned>(dir: &Path, path: &Path) -> Result<T> {
    package::check_file(dir, path)?;
    let bytes = std::fs::read(path).map_err(|e| FormatError::io(path, "read", &e))?;
    serde_json::from_slice(&bytes).map_err(|e| json_error(&e).in_file(path))
}

/// A file that every dataset has, beside the one that makes it a dataset.
fn read_part<T: DeserializeOwned>(dir: &Path, path: &Path) -> Result<T> {
    package::check_file(dir, path)?;
    read_json(dir, path).map_err(|e| e.with_hint(DAMAGED))
}

/// The bytes of a file that may be absent.
fn read_optional(dir: &Path, path: &Path) -> Result<Vec<u8>> {
    package::check_file(dir, path)?;
    match std::fs::read(path) {
        Ok(bytes) => Ok(bytes),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(Vec::new()),
        Err(e) => Err(FormatError::io(path, "read", &e)),
    }
}

fn inconsistent(path: &Path, message: String) -> FormatError {
    FormatError::new(ErrorKind::Inconsistent, message).in_file(path)
}

pub(super) fn read(dir: &Path) -> Result<Dataset> {
    if !dir.is_dir() {
        let message = if dir.exists() { "is not a folder" } else { "does not exist" };
        return Err(FormatError::new(ErrorKind::Missing, message)
            .in_file(dir)
            .with_hint("a dataset is made by `dataset build TAKE --balance --out DATASET`"));
    }
    let path = dir.join("dataset.json");
    let file: DatasetFile = read_json(dir, &path).map_err(|e| match e.kind() {
        ErrorKind::Io => {
            e.with_hint("this folder is not a dataset; make one with `dataset build TAKE --balance --out DATASET`")
        }
        _ => e,
    })?;
    check_ids(&file).map_err(|e| e.in_file(&path))?;

    let path = dir.join("metadata.json");
    let mut all: BTreeMap<String, FrameMetadata> = read_part(dir, &path)?;
    let mut metadata = BTreeMap::new();
    for id in &file.ids {
        let entry = all.remove(id).ok_or_else(|| inconsistent(&path, format!("has nothing about `{id}`")))?;
        metadata.insert(id.clone(), entry);
    }

    let path = dir.join("scene.json");
    let raw: SceneFile = read_part(dir, &path)?;
    let scene =
        SceneBounds { center_in_world: DVec3::from(raw.center), scale: raw.scale, near: raw.near, far: raw.far };
    if !scene.is_valid() {
        let message = format!(
            "scale {}, near {}, far {}: these must be above 0 and far beyond near",
            raw.scale, raw.near, raw.far
        );
        return Err(inconsistent(&path, message));
    }

    let camera = |id: &String| {
        let path = camera_path(dir, id);
        package::check_file(dir, &path)?;
        Ok((id.clone(), camera::read_camera(path)?))
    };
    let cameras = file.ids.iter().map(camera).collect::<Result<_>>()?;

    let path = dir.join("mapping.yml");
    let mapping = yaml::parse_mapping(&read_optional(dir, &path)?).map_err(|e| e.in_file(&path))?;
    let path = dir.join("annotations.yml");
    let annotations =
        yaml::parse_annotations(&read_optional(dir, &path)?, mapping.len()).map_err(|e| e.in_file(&path))?;

    if file.risorius.is_some() && (mapping.is_empty() || annotations.is_empty()) {
        // Plain folders of the family may go without; in ours every frame would be taken for neutral.
        let name = if mapping.is_empty() { "mapping.yml" } else { "annotations.yml" };
        return Err(FormatError::new(ErrorKind::Missing, "is missing or empty")
            .in_file(dir.join(name))
            .with_hint(DAMAGED));
    }

    let DatasetFile { ids, train_ids, val_ids, risorius: extras, .. } = file;
    Ok(Dataset { ids, train_ids, val_ids, metadata, scene, cameras, mapping, annotations, extras })
}

fn check_ids(file: &DatasetFile) -> Result<()> {
    let fail = |message: String| Err(FormatError::new(ErrorKind::Inconsistent, message));
    if file.ids.is_empty() {
        return Err(FormatError::new(ErrorKind::Empty, "has no ids"));
    }
    let mut known = BTreeSet::new();
    for id in &file.ids {
        check_id(id)?;
        if !known.insert(id) {
            return fail(format!("the id `{id}` stands there twice"));
        }
    }
    for (name, list) in [("train_ids", &file.train_ids), ("val_ids", &file.val_ids)] {
        if let Some(id) = list.iter().find(|&id| !known.contains(id)) {
            return fail(format!("`{name}` holds {id:?}, which is not among `ids`"));
        }
    }
    if let Some(extras) = &file.risorius {
        let points = extras.head_hull_in_world.iter().flatten().chain([&extras.head_center]);
        // Written so that a NaN is refused.
        let sane = |v: f64| v.abs() <= 1e12;
        let radius = extras.head_radius;
        if !points.into_iter().all(|p| p.to_array().into_iter().all(sane))
            || !(radius == 0.0 || (1e-12..=1e12).contains(&radius))
        {
            return fail(format!("`risorius`: the head's place, hull or radius ({radius}) makes no sense"));
        }
        extras.ids_without_masks.iter().try_for_each(|id| check_id(id))?;
    }
    Ok(())
}

pub(super) fn write(dataset: &Dataset, dir: &Path) -> Result<()> {
    let file = DatasetFile {
        count: dataset.ids.len() as u64,
        num_exemplars: dataset.train_ids.len() as u64,
        ids: dataset.ids.clone(),
        train_ids: dataset.train_ids.clone(),
        val_ids: dataset.val_ids.clone(),
        risorius: dataset.extras.clone(),
    };
    let path = dir.join("dataset.json");
    check_ids(&file).map_err(|e| e.in_file(&path))?;
    if !dataset.scene.is_valid() {
        return Err(inconsistent(&dir.join("scene.json"), "the scene has no valid extent".to_owned()));
    }
    if let Some(a) = dataset.annotations.iter().find(|a| !a.value.is_finite()) {
        return Err(inconsistent(
            &dir.join("annotations.yml"),
            format!("frame {} has a value that is not a number", a.frame),
        ));
    }
    for id in &dataset.ids {
        let path = camera_path(dir, id);
        let camera = dataset.cameras.get(id).ok_or_else(|| inconsistent(&path, format!("no camera for `{id}`")))?;
        camera::write_camera(path, camera)?;
    }
    let SceneBounds { center_in_world, scale, near, far } = dataset.scene;
    write_json(dir.join("scene.json"), &SceneFile { scale, center: center_in_world.to_array(), near, far })?;
    write_json(dir.join("metadata.json"), &dataset.metadata)?;
    if !dataset.mapping.is_empty() {
        atomic::write_file(dir.join("mapping.yml"), yaml::mapping_text(&dataset.mapping).as_bytes())?;
    }
    if !(dataset.annotations.is_empty() && dataset.mapping.is_empty()) {
        atomic::write_file(dir.join("annotations.yml"), yaml::annotations_text(&dataset.annotations).as_bytes())?;
    }
    // Last: a folder without it is not a dataset yet.
    write_json(path, &file)
}
