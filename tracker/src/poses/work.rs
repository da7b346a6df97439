//! The folder of an unfinished run, so that the next one goes on where it stopped.
//!
//! It lies beside `poses/`, which appears whole or not at all. A run of another job (other key frames, options or video)
//! starts afresh.

use std::fs;
use std::path::{Path, PathBuf};

use risorius_formats::{FormatError, atomic};

use crate::error::Result;

/// Name of the folder in the take.
pub const WORK_DIR: &str = ".poses-work";
/// Says what the folder's files were made for.
const JOB: &str = "job.json";

/// The folder of an unfinished run.
#[derive(Clone, Debug)]
pub(crate) struct Work {
    dir: PathBuf,
}

impl Work {
    /// Opens the folder for `job`; whatever was made for another one is removed.
    pub(crate) fn open(dir: PathBuf, job: &str) -> Result<Self> {
        let known = fs::read(dir.join(JOB)).unwrap_or_default();
        if known != job.as_bytes() {
            remove(&dir)?;
            fs::create_dir_all(&dir).map_err(|e| FormatError::io(&dir, "create the folder", &e))?;
            atomic::write_file(dir.join(JOB), job.as_bytes())?;
        }
        Ok(Self { dir })
    }

    /// A file or folder in it.
    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.dir.join(name)
    }

    /// Removes a file with those beside it that begin with its name, such as a database with its journal.
    pub(crate) fn remove_files(&self, name: &str) -> Result<()> {
        let entries = fs::read_dir(&self.dir).map_err(|e| FormatError::io(&self.dir, "read", &e))?;
        for entry in entries.flatten().filter(|e| e.file_name().to_string_lossy().starts_with(name)) {
            fs::remove_file(entry.path()).map_err(|e| FormatError::io(entry.path(), "remove", &e))?;
        }
        Ok(())
    }

    fn marker(&self, step: &str) -> PathBuf {
        self.dir.join(format!("{step}.done"))
    }

    /// Whether a step was finished.
    pub(crate) fn is_done(&self, step: &str) -> bool {
        self.marker(step).is_file()
    }

    /// A step is finished.
    pub(crate) fn done(&self, step: &str) -> Result<()> {
        Ok(atomic::write_file(self.marker(step), b"")?)
    }
}

/// Removes a work folder, if it is there.
pub(crate) fn remove(dir: &Path) -> Result<()> {
    match fs::remove_dir_all(dir) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(FormatError::io(dir, "remove", &e).into()),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_same_job_goes_on_and_another_one_starts_afresh() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join(WORK_DIR);
        let work = Work::open(path.clone(), "a").unwrap();
        fs::write(work.path("data"), "x").unwrap();
        work.done("features").unwrap();
        let again = Work::open(path.clone(), "a").unwrap();
        assert!(again.is_done("features") && !again.is_done("map") && again.path("data").is_file());
        let other = Work::open(path.clone(), "b").unwrap();
        assert!(!other.is_done("features") && !other.path("data").exists());
        remove(&path).unwrap();
        remove(&path).unwrap();
        assert!(!path.exists());
    }
}
