//! `RUN/run.json`: what a fit was made from.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::pose_report::{json_error, write_json};
use crate::{FormatError, Result};

/// `RUN/run.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RunManifest {
    /// Version of this file's layout.
    pub version: u32,
    /// The dataset's folder as it was given.
    pub dataset: PathBuf,
    /// SHA-256 of the dataset's manifest files.
    pub dataset_sha256: String,
    /// The field's name: `splat` or `confies`.
    pub field: String,
    /// The seed of every random draw.
    pub seed: u64,
    /// Steps done so far.
    pub steps: u64,
    /// Wall seconds spent so far, resumed parts included.
    pub seconds: f64,
    /// The program that wrote this, with its version.
    pub written_by: String,
}

impl RunManifest {
    /// Reads `RUN/run.json`.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let bytes = std::fs::read(path).map_err(|e| {
            FormatError::io(path, "read", &e)
                .with_hint("this folder is not a run; make one with `trainer fit DATASET --out RUN`")
        })?;
        serde_json::from_slice(&bytes).map_err(|e| json_error(&e).in_file(path))
    }

    /// Writes `RUN/run.json`, whole or not at all.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<()> {
        write_json(path, self)
    }
}
