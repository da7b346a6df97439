//! The networks of `tracker run`: where they lie, what their manifest says, and how they are run.
//!
//! A folder of models holds `models.toml` ([`manifest`]) and the ONNX files that it names. None of them is the project's
//! own: `tools/models` fetches a set into the user's cache, and `--models` takes any other.

pub mod manifest;
pub mod runtime;

use std::path::{Path, PathBuf};

use risorius_formats::{ErrorKind, FormatError, hash};

use crate::error::Result;
use manifest::Manifest;

/// The command that fetches the default models.
pub const FETCH: &str = "`tools/models` fetches the default models and the ONNX Runtime";
/// The name of the manifest in a folder of models.
pub const MANIFEST: &str = "models.toml";

/// A folder of models whose manifest was read and whose files are there and undamaged.
#[derive(Clone, Debug)]
pub struct ModelFolder {
    /// The folder.
    pub dir: PathBuf,
    /// Its manifest.
    pub manifest: Manifest,
}

/// Where models are looked for when none are given: `$RISORIUS_MODELS`, else `risorius/models` in `$XDG_CACHE_HOME` or
/// `~/.cache`.
pub fn default_dir() -> PathBuf {
    let set = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
    let cache = || set("XDG_CACHE_HOME").or_else(|| set("HOME").map(|home| home.join(".cache")));
    set("RISORIUS_MODELS").unwrap_or_else(|| cache().unwrap_or_default().join("risorius/models"))
}

impl ModelFolder {
    /// Reads the manifest and checks that every file is there and has the hash that the manifest gives, if it gives one.
    pub fn open(dir: impl AsRef<Path>) -> Result<Self> {
        let dir = dir.as_ref().to_owned();
        let path = dir.join(MANIFEST);
        let text = std::fs::read_to_string(&path).map_err(|e| missing(FormatError::io(&path, "read", &e)))?;
        let manifest = Manifest::parse(&text).map_err(|e| e.in_file(&path))?;
        for (file, sha256) in manifest.files() {
            check(&dir.join(file), sha256)?;
        }
        Ok(Self { dir, manifest })
    }
}

fn check(path: &Path, sha256: Option<&str>) -> Result<(), FormatError> {
    if !path.is_file() {
        return Err(missing(FormatError::new(ErrorKind::Missing, "the model is missing").in_file(path)));
    }
    let Some(expected) = sha256 else { return Ok(()) };
    let found = hash::sha256_of_file(path)?;
    if found == expected.to_ascii_lowercase() {
        return Ok(());
    }
    let message = format!("the model is damaged or another one: its SHA-256 is {found}, {MANIFEST} says {expected}");
    Err(missing(FormatError::new(ErrorKind::Inconsistent, message).in_file(path)))
}

fn missing(error: FormatError) -> FormatError {
    error.with_hint(format!("{FETCH}; `--models DIR` names a folder of your own"))
}

#[cfg(test)]
mod tests {
    use super::*;

    const MANIFEST_TEXT: &str = r#"
        version = 1
        [detector]
        file = "d.onnx"
        kind = "boxes"
        width = 320
        height = 240
        layout = "nchw"
        mean = 127.0
        scale = 0.0078125
        boxes = "boxes"
        scores = "scores"
        [landmarks]
        file = "l.onnx"
        sha256 = "E3B0C44298FC1C149AFBF4C8996FB92427AE41E4649B934CA495991B7852B855"
        kind = "points68"
        width = 64
        height = 64
        layout = "nhwc"
        scale = 0.00392156862745098
        points = "points"
    "#;

    #[test]
    fn a_missing_or_damaged_model_is_named_with_the_command_that_fetches_it() {
        let dir = tempfile::tempdir().unwrap();
        let error = || {
            let e = ModelFolder::open(dir.path()).unwrap_err();
            let hint = risorius_formats::Hint::hint(&e).unwrap().into_owned();
            assert!(hint.contains("tools/models"), "{hint}");
            e.to_string()
        };
        assert!(error().contains("models.toml: does not exist"), "{}", error());
        std::fs::write(dir.path().join(MANIFEST), MANIFEST_TEXT).unwrap();
        assert!(error().contains("d.onnx: the model is missing"));
        std::fs::write(dir.path().join("d.onnx"), b"any").unwrap();
        std::fs::write(dir.path().join("l.onnx"), b"x").unwrap();
        assert!(error().contains("l.onnx: the model is damaged"));
        std::fs::write(dir.path().join("l.onnx"), b"").unwrap();
        let folder = ModelFolder::open(dir.path()).unwrap();
        assert_eq!(folder.manifest.landmarks.margin, 1.5);
    }
}
