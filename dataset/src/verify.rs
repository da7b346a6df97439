//! `dataset verify`: opens a dataset as a stranger would and lists every problem with its path.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use image::ImageReader;
use rayon::prelude::*;
use risorius_formats::landmark_table::{self, LandmarkTable};
use risorius_formats::mask::LabelImage;
use risorius_formats::nerfies::{self, Dataset, Polygons};
use risorius_formats::{AttributeTable, FormatError, Reporter, package};
use serde::Serialize;

use crate::error::DatasetError;
use crate::{tables, verify_layouts};

/// Something wrong with a dataset.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct Problem {
    /// The file or folder.
    pub path: PathBuf,
    /// What is wrong with it.
    pub message: String,
}

/// What was found.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Verdict {
    /// Frames of the dataset.
    pub frames: usize,
    /// Image scales found.
    pub scales: Vec<u32>,
    /// Pictures that were decoded.
    pub pictures: usize,
    /// Attributes.
    pub attributes: usize,
    /// Everything that is wrong, sorted by path.
    pub problems: Vec<Problem>,
}

impl Verdict {
    pub(crate) fn add(&mut self, path: impl Into<PathBuf>, message: impl Into<String>) {
        self.problems.push(Problem { path: path.into(), message: message.into() });
    }

    pub(crate) fn add_failure(&mut self, dir: &Path, error: &DatasetError) {
        match error {
            DatasetError::Format(error) => self.add_error(dir, error),
            other => self.add(dir, other.to_string()),
        }
    }

    pub(crate) fn add_error(&mut self, dir: &Path, error: &FormatError) {
        let path = error.path().unwrap_or(dir).to_owned();
        let message = error.to_string();
        // The path stands in front already; the line stays.
        let message = message.strip_prefix(&path.display().to_string()).unwrap_or(&message);
        let message = message.trim_start_matches([':', ' ']);
        let message = if error.line().is_some() { format!("line {message}") } else { message.to_owned() };
        self.add(path, message);
    }
}

/// Checks the dataset in `dir`: ours, a plain one of the Nerfies family, or an export to another layout.
pub fn verify(dir: &Path, reporter: &dyn Reporter) -> Verdict {
    let mut verdict = Verdict::default();
    if let Ok(layout) = crate::import::layout_of(dir)
        && layout != crate::import::Layout::Nerfies
    {
        verify_layouts::check(dir, layout, &mut verdict);
        finish(&mut verdict);
        return verdict;
    }
    let dataset = match Dataset::read(dir) {
        Ok(dataset) => dataset,
        Err(error) => {
            verdict.add_error(dir, &error);
            other_cameras(dir, &mut verdict);
            finish(&mut verdict);
            return verdict;
        }
    };
    verdict.frames = dataset.ids.len();
    check_splits(dir, &dataset, &mut verdict);
    check_annotations(dir, &dataset, &mut verdict);
    let regions = check_attributes(dir, &dataset, &mut verdict);
    check_cameras(dir, &dataset, &mut verdict);
    check_landmarks(dir, &dataset, &mut verdict);
    check_tables(dir, &dataset, &mut verdict);
    check_pictures(dir, &dataset, regions, &mut verdict, reporter);
    finish(&mut verdict);
    verdict
}

fn finish(verdict: &mut Verdict) {
    verdict.problems.sort();
    verdict.problems.dedup();
}

/// When the folder cannot be read as a whole, at least all broken cameras are named at once.
fn other_cameras(dir: &Path, verdict: &mut Verdict) {
    let Ok(bytes) = std::fs::read(dir.join("dataset.json")) else { return };
    let Ok(value) = serde_json::from_slice::<serde_json::Value>(&bytes) else { return };
    let ids = value["ids"].as_array().into_iter().flatten().filter_map(|v| v.as_str());
    for id in ids.filter(|id| nerfies::check_id(id).is_ok()) {
        if let Err(error) = nerfies::read_camera(nerfies::camera_path(dir, id)) {
            verdict.add_error(dir, &error);
        }
    }
}

fn check_splits(dir: &Path, dataset: &Dataset, verdict: &mut Verdict) {
    let path = dir.join("dataset.json");
    let train: BTreeSet<_> = dataset.train_ids.iter().collect();
    if let Some(id) = dataset.val_ids.iter().find(|id| train.contains(id)) {
        verdict.add(&path, format!("`{id}` is both in `train_ids` and in `val_ids`"));
    }
    if dataset.train_ids.is_empty() {
        verdict.add(&path, "`train_ids` is empty");
    }
    let takes = dataset.extras.as_ref().map_or(0, |e| e.takes.len());
    if takes > 0 {
        let mut times = BTreeMap::new();
        for id in &dataset.ids {
            if let Some(other) = dataset.source_frame(id).and_then(|t| times.insert(t, id)) {
                verdict.add(dir.join("metadata.json"), format!("`{other}` and `{id}` have the same time_id"));
            }
        }
    }
}

/// Landmarks must belong to frames of the dataset and lie near the picture.
fn check_landmarks(dir: &Path, dataset: &Dataset, verdict: &mut Verdict) {
    let path = landmark_table::path(dir);
    let table = match LandmarkTable::read(dir) {
        Ok(table) => table.unwrap_or_default(),
        Err(error) => return verdict.add_error(&path, &error),
    };
    for (id, landmarks) in &table.rows {
        let Some(camera) = dataset.cameras.get(id) else {
            verdict.add(&path, format!("`{id}` is not among the dataset's ids"));
            continue;
        };
        let (width, height) = (camera.intrinsics.width as f32, camera.intrinsics.height as f32);
        let [left, top, right, bottom] = landmarks.bounds_px();
        if left > width || top > height || right < 0.0 || bottom < 0.0 {
            verdict.add(&path, format!("the landmarks of `{id}` lie outside its picture"));
        }
    }
}

fn check_annotations(dir: &Path, dataset: &Dataset, verdict: &mut Verdict) {
    let path = dir.join("annotations.yml");
    if dataset.annotations.is_empty() {
        return;
    }
    let mut numbers: BTreeSet<u32> = BTreeSet::new();
    for id in &dataset.ids {
        let Ok(number) = id.parse() else {
            verdict
                .add(dir.join("dataset.json"), format!("the id `{id}` is not a number, so annotations cannot find it"));
            return;
        };
        numbers.insert(number);
    }
    let mut seen = BTreeSet::new();
    let (mut unknown, mut outside, mut twice) = (BTreeSet::new(), 0usize, 0usize);
    for a in &dataset.annotations {
        if !numbers.contains(&a.frame) {
            unknown.insert(a.frame);
        }
        outside += usize::from(!(-1.0..=1.0).contains(&a.value));
        twice += usize::from(!seen.insert((a.class, a.frame)));
    }
    if let Some(first) = unknown.first() {
        verdict.add(&path, format!("{} frames are not in dataset.json, the first is {first}", unknown.len()));
    }
    if outside > 0 {
        verdict.add(&path, format!("{outside} values are out of −1 to 1"));
    }
    if twice > 0 {
        verdict.add(&path, format!("{twice} entries repeat a class of a frame"));
    }
    if dataset.mapping.is_empty() {
        verdict.add(dir.join("mapping.yml"), "is missing or empty, although there are annotations");
    }
}

/// Compares `attributes.toml` with the mapping; the number of regions where there is one.
fn check_attributes(dir: &Path, dataset: &Dataset, verdict: &mut Verdict) -> Option<usize> {
    verdict.attributes = dataset.mapping.len();
    let path = dir.join("attributes.toml");
    if !path.exists() {
        if dataset.extras.is_some() {
            verdict.add(path, "does not exist");
        }
        return None;
    }
    match AttributeTable::read(&path) {
        Ok(table) => {
            let names: Vec<String> = table.attributes.iter().map(|a| a.unit.to_string()).collect();
            if names != dataset.mapping {
                verdict.add(path, "its AUs are not those of mapping.yml");
            }
            Some(table.regions.len())
        }
        Err(error) => {
            verdict.add_error(dir, &error);
            None
        }
    }
}

/// The tables, where there are any, hold the frames of the dataset.
fn check_tables(dir: &Path, dataset: &Dataset, verdict: &mut Verdict) {
    if dataset.extras.is_none() || !dir.join("tables").is_dir() {
        return;
    }
    match tables::read(dir) {
        Ok(rows) => {
            let frames = rows.takes.iter().flat_map(|t| &t.frames);
            let mut ids: Vec<&String> = frames.filter_map(|f| f.id.as_ref()).collect();
            let mut expected: Vec<&String> = dataset.ids.iter().collect();
            ids.sort_unstable();
            expected.sort_unstable();
            if ids != expected {
                verdict.add(dir.join("tables"), "its chosen frames are not those of dataset.json");
            }
        }
        Err(error) => verdict.add_failure(dir, &error),
    }
}

fn check_cameras(dir: &Path, dataset: &Dataset, verdict: &mut Verdict) {
    let sizes: BTreeSet<_> = dataset.cameras.values().map(|c| (c.intrinsics.width, c.intrinsics.height)).collect();
    let Some(extras) = &dataset.extras else { return };
    if sizes.len() > 1 {
        verdict.add(dir.join("camera"), format!("the cameras have {} different image sizes", sizes.len()));
    }
    for (id, camera) in &dataset.cameras {
        let path = nerfies::camera_path(dir, id);
        let depth = camera.camera_from_world.transform_point(extras.head_center).z;
        if depth <= 0.0 {
            verdict.add(&path, "the head lies behind the camera");
        }
        if dataset.scene.scene_from_world(camera.center()).length() > 10.0 {
            verdict.add(&path, "stands more than ten units from the scene's centre: scene.json does not fit");
        }
    }
}

fn check_pictures(
    dir: &Path,
    dataset: &Dataset,
    regions: Option<usize>,
    verdict: &mut Verdict,
    reporter: &dyn Reporter,
) {
    let scales: Vec<u32> =
        crate::SCALES.into_iter().filter(|s| dir.join("rgb").join(format!("{s}x")).is_dir()).collect();
    verdict.scales.clone_from(&scales);
    if scales.is_empty() {
        verdict.add(dir.join("rgb"), "has no pictures at 1x, 2x, 4x or 8x");
        return;
    }
    if let Some(extras) = dataset.extras.as_ref().filter(|e| !scales.contains(&e.default_scale)) {
        verdict.add(dir.join("rgb"), format!("has no pictures at its own scale, {}x", extras.default_scale));
    }
    reporter.stage("open every picture", Some((scales.len() * dataset.ids.len()) as u64));
    let without: BTreeSet<&String> = dataset.extras.iter().flat_map(|e| &e.ids_without_masks).collect();
    let work: Vec<(u32, &String)> = scales.iter().flat_map(|&s| dataset.ids.iter().map(move |id| (s, id))).collect();
    let found: Vec<(usize, Vec<Problem>)> = work
        .par_iter()
        .map(|&(s, id)| {
            let mut own = Verdict::default();
            let files = [nerfies::rgb_path, nerfies::region_path, nerfies::valid_path, nerfies::head_path];
            let strangers: Vec<FormatError> = files
                .map(|path| path(dir, s, id))
                .into_iter()
                .chain([nerfies::polygons_path(dir, id)])
                .filter_map(|path| package::check_file(dir, path).err())
                .collect();
            if !strangers.is_empty() {
                // Such a file is not even opened.
                for error in &strangers {
                    own.add_error(dir, error);
                }
                return (own.pictures, own.problems);
            }
            let size = dataset.cameras[id].reduced(s).intrinsics;
            let size = (size.width, size.height);
            own.pictures += usize::from(check_picture(&nerfies::rgb_path(dir, s, id), size, &mut own));
            if dataset.extras.is_some() && !without.contains(id) && regions.is_some() {
                own.pictures +=
                    usize::from(check_labels(&nerfies::region_path(dir, s, id), size, regions.unwrap_or(0), &mut own));
            }
            let head = nerfies::head_path(dir, s, id);
            if head.exists() {
                own.pictures += usize::from(check_labels(&head, size, 255, &mut own));
            }
            if dataset.extras.as_ref().is_some_and(|e| e.head_hull_in_world.is_some()) {
                own.pictures += usize::from(check_labels(&nerfies::valid_path(dir, s, id), size, 255, &mut own));
            }
            let polygons = nerfies::polygons_path(dir, id);
            if s == scales[0] && polygons.exists() {
                check_polygons(dir, &polygons, dataset, &mut own);
            }
            reporter.advance(1);
            (own.pictures, own.problems)
        })
        .collect();
    for (pictures, problems) in found {
        verdict.pictures += pictures;
        verdict.problems.extend(problems);
    }
}

pub(crate) fn check_picture(path: &Path, size: (u32, u32), verdict: &mut Verdict) -> bool {
    let reader = match ImageReader::open(path) {
        Ok(reader) => reader,
        Err(error) => {
            verdict.add_error(path, &FormatError::io(path, "read", &error));
            return false;
        }
    };
    match reader.decode() {
        Ok(image) if (image.width(), image.height()) == size => true,
        Ok(image) => {
            verdict.add(
                path,
                format!("is {} × {} pixels, its camera says {} × {}", image.width(), image.height(), size.0, size.1),
            );
            false
        }
        Err(error) => {
            verdict.add(path, format!("cannot be decoded: {error}"));
            false
        }
    }
}

fn check_labels(path: &Path, size: (u32, u32), largest: usize, verdict: &mut Verdict) -> bool {
    match LabelImage::read_png(path) {
        Ok(labels) if (labels.width, labels.height) != size => {
            verdict.add(
                path,
                format!("is {} × {} pixels, its camera says {} × {}", labels.width, labels.height, size.0, size.1),
            );
            false
        }
        Ok(labels) => {
            let top = labels.labels.iter().copied().max().unwrap_or(0);
            if usize::from(top) > largest {
                verdict.add(path, format!("has the label {top}, but there are {largest} regions"));
                return false;
            }
            true
        }
        Err(error) => {
            verdict.add_error(path, &error);
            false
        }
    }
}

fn check_polygons(dir: &Path, path: &Path, dataset: &Dataset, verdict: &mut Verdict) {
    match Polygons::read(path) {
        Ok(file) => {
            if let Some(p) =
                file.polygons.iter().find(|p| !dataset.mapping.is_empty() && !dataset.mapping.contains(&p.label))
            {
                verdict.add(path, format!("the label `{}` is not in mapping.yml", p.label));
            }
        }
        Err(error) => verdict.add_error(dir, &error),
    }
}
