//! Files and folders that appear whole or not at all: written beside their place, synced, then renamed.

use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use crate::{FormatError, Result};

/// The sibling that holds a file or folder until it is whole. One name per process, so that a leftover is recognised.
fn staging_path(path: &Path) -> PathBuf {
    let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    path.with_file_name(format!(".{name}.{}.part", std::process::id()))
}

fn create_parent(path: &Path) -> Result<()> {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => {
            fs::create_dir_all(parent).map_err(|e| FormatError::io(parent, "create the folder", &e))
        }
        _ => Ok(()),
    }
}

/// Writes `bytes` to `path`, whole or not at all; missing parent folders are made.
pub fn write_file(path: impl AsRef<Path>, bytes: &[u8]) -> Result<()> {
    let mut file = AtomicFile::create(path)?;
    file.write_all(bytes).map_err(|e| FormatError::io(&file.path, "write", &e))?;
    file.commit()
}

/// A file under construction. Dropped without [`commit`](Self::commit), it leaves nothing behind.
#[derive(Debug)]
pub struct AtomicFile {
    path: PathBuf,
    staging: PathBuf,
    writer: Option<BufWriter<File>>,
}

impl AtomicFile {
    /// Begins a file that will appear at `path`.
    pub fn create(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref().to_owned();
        create_parent(&path)?;
        let staging = staging_path(&path);
        let file = File::create(&staging).map_err(|e| FormatError::io(&path, "create", &e))?;
        Ok(Self { path, staging, writer: Some(BufWriter::with_capacity(1 << 18, file)) })
    }

    /// Where the file lies until it is committed, for writers that want a path of their own.
    pub fn staging_path(&self) -> &Path {
        &self.staging
    }

    /// Flushes, syncs and renames the file into its place.
    pub fn commit(mut self) -> Result<()> {
        let wrap = |e: std::io::Error| FormatError::io(&self.path, "write", &e);
        if let Some(writer) = self.writer.take() {
            let file = writer.into_inner().map_err(|e| wrap(e.into_error()))?;
            file.sync_all().map_err(wrap)?;
        }
        fs::rename(&self.staging, &self.path).map_err(wrap)
    }
}

impl Write for AtomicFile {
    fn write(&mut self, buf: &[u8]) -> std::io::Result<usize> {
        match &mut self.writer {
            Some(w) => w.write(buf),
            None => Err(std::io::Error::other("the file is already committed")),
        }
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.writer.as_mut().map_or(Ok(()), Write::flush)
    }
}

impl Drop for AtomicFile {
    fn drop(&mut self) {
        // After a commit the staging file is gone and this finds nothing.
        let _ = fs::remove_file(&self.staging);
    }
}

/// A folder under construction. Dropped without [`commit`](Self::commit), it leaves nothing behind.
#[derive(Debug)]
pub struct AtomicDir {
    path: PathBuf,
    staging: PathBuf,
}

impl AtomicDir {
    /// Begins a folder that will appear at `path`.
    pub fn create(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref().to_owned();
        create_parent(&path)?;
        let staging = staging_path(&path);
        if staging.exists() {
            fs::remove_dir_all(&staging).map_err(|e| FormatError::io(&staging, "remove the leftover", &e))?;
        }
        fs::create_dir(&staging).map_err(|e| FormatError::io(&path, "create the folder", &e))?;
        Ok(Self { path, staging })
    }

    /// The folder to fill.
    #[expect(clippy::misnamed_getters, reason = "until it is committed, the folder is the staging folder")]
    pub fn path(&self) -> &Path {
        &self.staging
    }

    /// Renames the folder into its place; an older folder there is replaced.
    pub fn commit(self) -> Result<()> {
        let wrap = |e: std::io::Error| FormatError::io(&self.path, "put in place", &e);
        let old = self.staging.with_extension("old");
        let replaces = self.path.exists();
        if replaces {
            fs::rename(&self.path, &old).map_err(wrap)?;
        }
        if let Err(e) = fs::rename(&self.staging, &self.path) {
            if replaces {
                // Put the older folder back: nothing is lost on failure.
                let _ = fs::rename(&old, &self.path);
            }
            return Err(wrap(e));
        }
        if replaces {
            fs::remove_dir_all(&old).map_err(wrap)?;
        }
        Ok(())
    }
}

impl Drop for AtomicDir {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.staging);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_uncommitted_file_or_folder_leaves_nothing() {
        let dir = tempfile::tempdir().unwrap();
        {
            let mut f = AtomicFile::create(dir.path().join("a.txt")).unwrap();
            f.write_all(b"half").unwrap();
            let d = AtomicDir::create(dir.path().join("d")).unwrap();
            fs::write(d.path().join("x"), b"x").unwrap();
        }
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0);
    }

    #[test]
    fn committing_replaces_what_was_there() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("deep/a.txt");
        write_file(&path, b"one").unwrap();
        write_file(&path, b"two").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"two");
        for word in ["one", "two"] {
            let d = AtomicDir::create(dir.path().join("d")).unwrap();
            fs::write(d.path().join(word), word).unwrap();
            d.commit().unwrap();
        }
        assert!(!dir.path().join("d/one").exists() && dir.path().join("d/two").exists());
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 2);
    }
}
