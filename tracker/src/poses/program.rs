//! Which program does COLMAP's steps: its own, or a Python that has `pycolmap`.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use risorius_formats::{Reporter, Warning};

use super::child::Runner;
use super::flags::Version;
use crate::error::{Result, TrackerError};

/// The steps by `pycolmap`; it is handed to Python as text, so that no file has to be found.
const BY_PYTHON: &str = include_str!("pycolmap.py");
/// COLMAP's own program, as it is installed.
const COLMAP: &str = "colmap";
/// Asked where there is no such program.
const PYTHON: &str = "python3";

/// The program's path where none was named.
pub(crate) fn default_path() -> PathBuf {
    PathBuf::from(COLMAP)
}

/// A program that does COLMAP's steps.
#[derive(Clone, Debug)]
pub(crate) struct Program {
    /// A path, or a name to be found by the system.
    pub(crate) path: PathBuf,
    /// What stands before the step.
    pub(crate) before: Vec<OsString>,
    /// Its version, where it tells one.
    pub(crate) version: Option<Version>,
}

/// What running it needs besides the program.
#[derive(Clone, Copy)]
pub(crate) struct Surroundings<'a> {
    /// Where the output goes.
    pub(crate) log: &'a Path,
    /// The log's place once everything is done.
    pub(crate) final_log: &'a Path,
    /// When the work began.
    pub(crate) started: Instant,
    /// How long all steps together may take.
    pub(crate) limit: Option<Duration>,
    /// Hears the progress.
    pub(crate) reporter: &'a dyn Reporter,
}

impl Program {
    /// A path whose last part begins with `python` is a Python that has `pycolmap`; all others are COLMAP itself.
    fn of(path: &Path) -> Self {
        let is_python = path.file_name().is_some_and(|n| n.to_string_lossy().to_lowercase().starts_with("python"));
        let before = if is_python { vec!["-c".into(), BY_PYTHON.into()] } else { Vec::new() };
        Self { path: path.to_owned(), before, version: None }
    }

    /// The program at `path` if it is there; where COLMAP was not named and is not installed, `pycolmap` if that is.
    pub(crate) fn find(path: &Path, around: Surroundings<'_>) -> Result<Self> {
        let ask = |program: Self| program.with_version(around);
        match ask(Self::of(path)) {
            Err(missing @ TrackerError::ColmapMissing { .. }) if path == Path::new(COLMAP) => {
                // If that is missing too, it is COLMAP that the user should hear of.
                ask(Self::of(Path::new(PYTHON))).map_err(|e| match e {
                    TrackerError::ColmapMissing { .. } => missing,
                    other => other,
                })
            }
            found => found,
        }
    }

    fn is_python(&self) -> bool {
        !self.before.is_empty()
    }

    fn with_version(self, around: Surroundings<'_>) -> Result<Self> {
        let text = match self.runner(around).run("help", &[], None) {
            Ok(text) => text,
            Err(TrackerError::ColmapFailed { last_line: reason, .. }) if self.is_python() => {
                return Err(TrackerError::ColmapMissing { program: self.path, reason });
            }
            Err(TrackerError::ColmapFailed { last_line, .. }) => last_line,
            Err(e) => return Err(e),
        };
        let version = Version::find(&text);
        if version.is_none() {
            let message = format!(
                "`{} help` does not tell its version; the option names of the newest one are used",
                self.path.display()
            );
            around.reporter.warn(Warning::new("colmap-version", message));
        }
        Ok(Self { version, ..self })
    }

    /// Runs its steps.
    pub(crate) fn runner<'a>(&'a self, around: Surroundings<'a>) -> Runner<'a> {
        let Surroundings { log, final_log, started, limit, reporter } = around;
        Runner { program: &self.path, before: &self.before, log, final_log, started, limit, reporter }
    }

    /// For notes: `COLMAP 3.8`, `COLMAP 4.2 by pycolmap`.
    pub(crate) fn in_words(&self) -> String {
        let version = self.version.map_or("of unknown version".to_owned(), |v| v.to_string());
        format!("COLMAP {version}{}", if self.is_python() { " by pycolmap" } else { "" })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pythons_get_the_steps_as_text() {
        for path in ["python3", "/opt/venv/bin/python", "python3.12", "Python.exe"] {
            let program = Program::of(Path::new(path));
            assert!(program.is_python() && program.before[0] == "-c", "{path}");
        }
        for path in ["colmap", "/usr/bin/colmap", "/opt/python/colmap", "COLMAP.bat"] {
            assert!(!Program::of(Path::new(path)).is_python(), "{path}");
        }
    }

    #[test]
    fn notes_tell_who_did_the_work() {
        let version = Some(Version { major: 4, minor: 2 });
        assert_eq!(Program { version, ..Program::of(Path::new("python3")) }.in_words(), "COLMAP 4.2 by pycolmap");
        assert_eq!(Program::of(Path::new("colmap")).in_words(), "COLMAP of unknown version");
    }
}
