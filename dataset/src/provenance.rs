//! `takes.toml`: whom a dataset shows, under which consent, and from which recordings it was made.
//!
//! Nothing here tells where the recordings lie or on which machine: a dataset may be passed on as the consent allows.

use std::path::Path;

use risorius_formats::{ErrorKind, FormatError, atomic};
use serde::{Deserialize, Serialize};

use crate::align::TakeInput;

/// The name of the file.
pub const TAKES_FILE: &str = "takes.toml";
/// What stands in place of the name of a take that was removed, so that the others keep their numbers.
pub const REDACTED: &str = "redacted";

/// One take of a dataset.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct TakeEntry {
    /// Its name, as the tables and reports have it.
    pub name: String,
    /// Its number, from 0: ids are this times [`crate::TAKE_OFFSET`] plus the frame.
    pub number: usize,
    /// Who is seen, as `take.toml` says it; free text, may be empty.
    pub subject: String,
    /// Under which consent it was recorded, as `take.toml` says it.
    pub consent: String,
    /// SHA-256 of the recording.
    pub media_sha256: String,
    /// Frames per second.
    pub fps: f64,
    /// Frames of the recording.
    pub frames: u32,
}

/// The whole file.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// The takes in order; those that were removed are gone.
    #[serde(rename = "take", default)]
    pub takes: Vec<TakeEntry>,
}

impl Provenance {
    /// What the takes say about themselves.
    pub(crate) fn of(inputs: &[TakeInput]) -> Self {
        let entry = |(number, input): (usize, &TakeInput)| TakeEntry {
            name: input.name.clone(),
            number,
            subject: input.take.manifest.subject.clone(),
            consent: input.take.manifest.consent.clone(),
            media_sha256: input.take.manifest.media_sha256.clone(),
            fps: input.take.fps(),
            frames: input.take.manifest.frame_count,
        };
        Self { takes: inputs.iter().enumerate().map(entry).collect() }
    }

    /// Reads the file of the dataset in `dir`; empty where there is none.
    pub fn read(dir: &Path) -> Result<Self, FormatError> {
        let path = dir.join(TAKES_FILE);
        let text = match std::fs::read_to_string(&path) {
            Ok(text) => text,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(Self::default()),
            Err(e) => return Err(FormatError::io(&path, "read", &e)),
        };
        toml::from_str(&text).map_err(|e| {
            FormatError::new(ErrorKind::Syntax, e.message().trim().replace('\n', ", "))
                .in_file(&path)
                .with_hint("the file is written by `dataset build`; build the dataset again")
        })
    }

    /// Writes the file, whole or not at all.
    pub fn write(&self, dir: &Path) -> Result<(), FormatError> {
        let path = dir.join(TAKES_FILE);
        let text =
            toml::to_string(self).map_err(|e| FormatError::syntax(format!("cannot encode: {e}")).in_file(&path))?;
        atomic::write_file(path, text.as_bytes())
    }
}
