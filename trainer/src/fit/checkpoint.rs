//! Checkpoints: folders of what a field needs to go on, with step and time, whole or not at all, the newest two kept.
//! Those of the paper's networks hold weights and Adam's moments as records of Burn.

use std::fs;
use std::path::{Path, PathBuf};

use burn::module::Module as _;
use burn::optim::ModuleOptimizer;
use burn::store::ModuleRecord;
use risorius_formats::FormatError;
use risorius_formats::pose_report::json_error;
use serde::{Deserialize, Serialize};

use crate::error::{Result, TrainerError};
use crate::model::ConfiesModel;

/// Checkpoints kept.
const KEEP: usize = 2;

/// `state.json` of a checkpoint.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct CheckpointState {
    pub(crate) version: u32,
    pub(crate) step: u64,
    pub(crate) seconds: f64,
    pub(crate) dataset_sha256: String,
}

/// The folder of a step's checkpoint.
pub(crate) fn folder(run: &Path, step: u64) -> PathBuf {
    run.join("checkpoints").join(format!("step-{step:08}"))
}

/// Removes all but the newest checkpoints.
pub(crate) fn prune(run: &Path) -> Result<()> {
    let all = list(run);
    for (_, old) in &all[..all.len().saturating_sub(KEEP)] {
        fs::remove_dir_all(old).map_err(|e| FormatError::io(old, "remove", &e))?;
    }
    Ok(())
}

/// The newest checkpoint and its state, if it was made from this dataset.
pub(crate) fn newest(run: &Path, dataset_sha256: &str) -> Result<(PathBuf, CheckpointState)> {
    let Some((_, path)) = list(run).pop() else {
        return Err(TrainerError::Run {
            path: run.to_owned(),
            message: "holds no checkpoint to resume".to_owned(),
            hint: "leave out `--resume` to begin".to_owned(),
        });
    };
    let file = path.join("state.json");
    let bytes = fs::read(&file).map_err(|e| FormatError::io(&file, "read", &e))?;
    let state: CheckpointState = serde_json::from_slice(&bytes).map_err(|e| json_error(&e).in_file(&file))?;
    if state.dataset_sha256 != dataset_sha256 {
        return Err(TrainerError::Run {
            path,
            message: "was made from another dataset".to_owned(),
            hint: "resume with the dataset of the run, or fit into a new folder".to_owned(),
        });
    }
    Ok((path, state))
}

/// What a checkpoint holds.
pub struct Loaded {
    /// The model, with its parameters' identities.
    pub model: ConfiesModel,
    /// The optimiser with its moments.
    pub optimizer: ModuleOptimizer,
    /// The last step done.
    pub step: u64,
    /// Wall seconds spent until then.
    pub seconds: f64,
}

fn failed(path: &Path, what: &str, error: &dyn std::fmt::Display) -> TrainerError {
    TrainerError::Run {
        path: path.to_owned(),
        message: format!("cannot {what}: {error}"),
        hint: "the checkpoint may be damaged; remove its folder to fall back to the one before".to_owned(),
    }
}

/// Checkpoint folders of a run with their steps, oldest first.
pub fn list(run: &Path) -> Vec<(u64, PathBuf)> {
    let step = |path: &Path| path.file_name()?.to_str()?.strip_prefix("step-")?.parse().ok();
    let entries = fs::read_dir(run.join("checkpoints")).into_iter().flatten().filter_map(std::result::Result::ok);
    let mut found: Vec<_> = entries.filter_map(|e| Some((step(&e.path())?, e.path()))).collect();
    found.sort();
    found
}

/// Writes weights and moments into a checkpoint's folder.
pub(crate) fn write(folder: &Path, model: &ConfiesModel, optimizer: &ModuleOptimizer) -> Result<()> {
    let weights = model.clone().into_record().into_bytes().map_err(|e| failed(folder, "pack the weights", &e))?;
    let moments = optimizer.into_bytes().map_err(|e| failed(folder, "pack the optimiser", &e))?;
    for (name, bytes) in [("weights.bpk", &weights), ("optimizer.bpk", &moments)] {
        risorius_formats::atomic::write_file(folder.join(name), bytes)?;
    }
    Ok(())
}

/// Loads the newest checkpoint into a fresh model and optimiser.
pub fn load(run: &Path, model: ConfiesModel, optimizer: ModuleOptimizer, dataset_sha256: &str) -> Result<Loaded> {
    let (path, state) = newest(run, dataset_sha256)?;
    let read = |name: &str| {
        let file = path.join(name);
        fs::read(&file).map_err(|e| FormatError::io(&file, "read", &e))
    };
    let bytes = |v: Vec<u8>| burn::tensor::Bytes::from_bytes_vec(v);
    let record =
        ModuleRecord::from_bytes(bytes(read("weights.bpk")?)).map_err(|e| failed(&path, "read the weights", &e))?;
    let model = model.try_load_record(record).map_err(|e| failed(&path, "use the weights", &e))?;
    let optimizer =
        optimizer.from_bytes(bytes(read("optimizer.bpk")?)).map_err(|e| failed(&path, "use the optimiser", &e))?;
    Ok(Loaded { model, optimizer, step: state.step, seconds: state.seconds })
}
