//! A checkpoint of a fit of the Gaussian field: `splat.json` (how far it is, and sizes) and `state.safetensors` (every array
//! of [`Fitter::arrays`], f32).

use std::path::Path;

use risorius_formats::pose_report::{json_error, write_json};
use risorius_formats::{FormatError, Isometry};
use risorius_splat::fit::Progress;
use risorius_splat::{Fitter, Layout, Settings};
use serde::{Deserialize, Serialize};

use super::store::{Stored, check_finite, read_floats, write_arrays};
use crate::bounds;
use crate::error::Result;
use crate::saved::damaged;

const NUMBERS: &str = "state.safetensors";
const STATE: &str = "splat.json";

/// The state besides the arrays.
#[derive(Debug, Serialize, Deserialize)]
struct State {
    progress: Progress,
    layout: Layout,
    head_poses: Vec<Isometry>,
}

/// Writes the state of a fit into a folder.
pub(super) fn write(folder: &Path, fitter: &Fitter) -> Result<()> {
    let path = folder.join(NUMBERS);
    let arrays = fitter.arrays();
    for (name, values) in &arrays {
        check_finite(name, values).map_err(|problem| damaged(&path, &format!("{problem}: nothing is written")))?;
    }
    let stored = arrays.into_iter().map(|(name, v)| (name.to_owned(), Stored::floats(v, vec![v.len()])));
    write_arrays(&path, stored.collect())?;
    let state = State {
        progress: fitter.progress.clone(),
        layout: fitter.model.layout.clone(),
        head_poses: fitter.head_poses.clone(),
    };
    Ok(write_json(folder.join(STATE), &state)?)
}

/// Reads the state of a fit; `images` and `layout` are those of the dataset that goes on.
pub(super) fn read(folder: &Path, settings: &Settings) -> Result<Fitter> {
    let file = folder.join(STATE);
    let bytes = std::fs::read(&file).map_err(|e| FormatError::io(&file, "read", &e))?;
    let State { progress, layout, head_poses } =
        serde_json::from_slice(&bytes).map_err(|e| json_error(&e).in_file(&file))?;
    let path = folder.join(NUMBERS);
    let mut arrays = read_floats(&path)?;
    let size = arrays.values().map(|v| 4 * v.len()).sum();
    bounds::of_layout(&layout, size)
        .and_then(|()| bounds::of_progress(&progress))
        .map_err(|problem| damaged(&file, &problem))?;
    let mut take = |name: &str| arrays.remove(name).ok_or_else(|| format!("`{name}` is missing"));
    Fitter::restore(layout, settings.clone(), progress, head_poses, &mut take)
        .map_err(|problem| damaged(&path, &problem))
}
