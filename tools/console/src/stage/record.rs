//! What a result was made of: hashes of inputs, settings and outputs, beside or in it.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use risorius_formats::{FormatError, atomic, hash};
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// Name of the record in a result that is a folder.
const FILE: &str = "stage.json";
/// Stands for the hash of what cannot be read: the stage itself says better why.
const UNREADABLE: &str = "unreadable";
/// How deep a folder that was named as an input is looked into.
const DEPTH: usize = 4;

/// Content hashes of what a stage reads, by their roles. Paths are not kept: a result may be passed on.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Inputs(BTreeMap<String, String>);

impl Inputs {
    /// Adds a file.
    #[must_use]
    pub fn file(mut self, role: impl Into<String>, path: impl AsRef<Path>) -> Self {
        self.0.insert(role.into(), hash_of(path.as_ref()));
        self
    }

    /// Adds the files below a folder whose path in it `wanted` takes; a file instead of a folder is added as it is.
    #[must_use]
    pub fn folder(mut self, role: impl Into<String>, path: impl AsRef<Path>, wanted: impl Fn(&str) -> bool) -> Self {
        let path = path.as_ref();
        if !path.is_dir() {
            return self.file(role, path);
        }
        let mut files = Vec::new();
        list(path, "", DEPTH, &mut files);
        files.retain(|name| wanted(name));
        files.sort();
        let of = |name: &String| format!("{name} {}\n", hash_of(&path.join(name)));
        let all: String = files.iter().map(of).collect();
        self.0.insert(role.into(), hash::sha256_of_bytes(all.as_bytes()));
        self
    }
}

/// The content's hash. A pipe or a device in the place of a file may never end: only files are read.
fn hash_of(path: &Path) -> String {
    let file = path.is_file().then(|| hash::sha256_of_file(path).ok()).flatten();
    file.unwrap_or_else(|| UNREADABLE.to_owned())
}

/// Files below a folder by their paths in it; hidden ones and records are left out.
fn list(base: &Path, below: &str, depth: usize, files: &mut Vec<String>) {
    for entry in fs::read_dir(base.join(below)).into_iter().flatten().flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        if name.starts_with('.') || name == FILE {
            continue;
        }
        let path = if below.is_empty() { name } else { format!("{below}/{name}") };
        if entry.path().is_dir() {
            if depth > 1 {
                list(base, &path, depth - 1, files);
            }
        } else {
            files.push(path);
        }
    }
}

/// What a result was made of.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Record {
    version: u32,
    stage: String,
    written_by: String,
    settings: Value,
    inputs: BTreeMap<String, String>,
    /// SHA-256 of the files that make the result; empty until it is finished.
    outputs: BTreeMap<String, String>,
    finished: bool,
}

impl Record {
    /// The record of a result that is not finished.
    pub(super) fn begun(stage: &str, settings: Value, inputs: Inputs) -> Self {
        Self {
            version: 1,
            stage: stage.to_owned(),
            written_by: format!("risorius {}", env!("CARGO_PKG_VERSION")),
            settings,
            inputs: inputs.0,
            outputs: BTreeMap::new(),
            finished: false,
        }
    }

    /// The record of what lies at `result`; `None` where there is none that can be read.
    pub(super) fn read(result: &Path) -> Option<Self> {
        serde_json::from_slice(&fs::read(place(result)).ok()?).ok()
    }

    /// Whether the work came to its end.
    pub(super) fn is_finished(&self) -> bool {
        self.finished
    }

    /// Whether both are about the same work: stage, program, settings and inputs.
    pub(super) fn is_about(&self, other: &Self) -> bool {
        let plain = |r: &Self| Self { outputs: BTreeMap::new(), finished: false, ..r.clone() };
        plain(self) == plain(other) && !self.inputs.values().any(|hash| hash == UNREADABLE)
    }

    /// Whether the work is done and what it made is still there, unchanged.
    pub(super) fn holds(&self, result: &Path) -> bool {
        let same = |(name, hash): (&String, &String)| {
            hash::sha256_of_file(output(result, name)).is_ok_and(|found| found == *hash)
        };
        self.finished && !self.outputs.is_empty() && self.outputs.iter().all(same)
    }

    /// The work is done: its outputs are hashed; those that are not there are passed by.
    pub(super) fn finish(&mut self, result: &Path, outputs: &[&str]) {
        let of = |name: &&str| Some(((*name).to_owned(), hash::sha256_of_file(output(result, name)).ok()?));
        self.outputs = outputs.iter().filter_map(of).collect();
        self.finished = true;
    }

    /// Writes the record, whole or not at all.
    pub(super) fn write(&self, result: &Path) -> Result<(), FormatError> {
        let path = place(result);
        let mut text = serde_json::to_string_pretty(self)
            .map_err(|e| FormatError::syntax(format!("cannot encode: {e}")).in_file(&path))?;
        text.push('\n');
        atomic::write_file(path, text.as_bytes())
    }
}

/// Where the record of a result lies: in a folder, beside a file.
fn place(result: &Path) -> PathBuf {
    if is_file(result) {
        let name = result.file_name().unwrap_or_default().to_string_lossy();
        return result.with_file_name(format!(".{name}.{FILE}"));
    }
    result.join(FILE)
}

/// A file of the result; one without a name is the result itself.
fn output(result: &Path, name: &str) -> PathBuf {
    if name.is_empty() { result.to_owned() } else { result.join(name) }
}

/// Whether a result is, or is going to be, a single file.
pub(super) fn is_file(result: &Path) -> bool {
    result.is_file() || (!result.is_dir() && result.extension().is_some_and(|e| e == "mp4" || e == "glb"))
}
