//! Files and folders that appear whole or not at all: written beside their place, synced, then renamed.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use crate::{ErrorKind, FormatError, Result};

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
        let wrap = |e: io::Error| FormatError::io(&self.path, "write", &e);
        if let Some(writer) = self.writer.take() {
            let file = writer.into_inner().map_err(|e| wrap(e.into_error()))?;
            file.sync_all().map_err(wrap)?;
        }
        fs::rename(&self.staging, &self.path).map_err(wrap)
    }
}

impl Write for AtomicFile {
    fn write(&mut self, buf: &[u8]) -> io::Result<usize> {
        match &mut self.writer {
            Some(w) => w.write(buf),
            None => Err(io::Error::other("the file is already committed")),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
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
    /// Begins a folder that will appear at `path`. A folder that is there will be replaced, whatever it holds: where
    /// people choose the path, ask [`check_replaceable`] first.
    pub fn create(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref().to_owned();
        if path.file_name().is_none() {
            return Err(FormatError::new(ErrorKind::Unsupported, "cannot be made anew")
                .in_file(&path)
                .with_hint("name a new folder in it"));
        }
        if fs::metadata(&path).is_ok_and(|m| !m.is_dir()) {
            return Err(FormatError::io(&path, "create the folder", &io::ErrorKind::AlreadyExists.into()));
        }
        // A link stays a link: what it leads to is replaced.
        let path = if path.is_symlink() { fs::canonicalize(&path).unwrap_or(path) } else { path };
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

    /// Syncs all files and renames the folder into its place; an older folder there is replaced.
    pub fn commit(self) -> Result<()> {
        let wrap = |e: io::Error| FormatError::io(&self.path, "put in place", &e);
        sync_folder(&self.staging).map_err(wrap)?;
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
        // From here on the new folder is in its place: what fails now is no failure of the work.
        if let Some(parent) = self.path.parent() {
            let _ = sync_entry(if parent.as_os_str().is_empty() { Path::new(".") } else { parent });
        }
        if replaces {
            fs::remove_dir_all(&old).map_err(|e| FormatError::io(&old, "remove the older folder", &e))?;
        }
        Ok(())
    }
}

/// Fails unless there is nothing at `path`, an empty folder, or a folder that one of the files in `marks` shows to be
/// `what` (such as `a dataset`): nobody's own folder is replaced by a mistyped path.
pub fn check_replaceable(path: impl AsRef<Path>, what: &str, marks: &[&str]) -> Result<()> {
    let path = path.as_ref();
    if path.symlink_metadata().is_err() {
        return Ok(());
    }
    let is_empty = || fs::read_dir(path).is_ok_and(|mut entries| entries.next().is_none());
    if marks.iter().any(|mark| path.join(mark).is_file()) || is_empty() {
        return Ok(());
    }
    let message = format!("already exists and is not {what}, so it is not replaced");
    Err(FormatError::new(ErrorKind::Inconsistent, message)
        .in_file(path)
        .with_hint("choose another `--out`, or remove it yourself"))
}

/// How many files are synced at once: the disk commits what waits together, which makes thousands of small pictures
/// take a fraction of the time.
const SYNCED_AT_ONCE: usize = 16;

/// Brings a folder's files and entries to the disk, so that after a power cut a renamed folder is not full of files
/// without content. Links are left alone: what they lead to was there before.
fn sync_folder(dir: &Path) -> io::Result<()> {
    let (mut files, mut folders) = (Vec::new(), vec![dir.to_owned()]);
    let mut next = 0;
    while let Some(folder) = folders.get(next).cloned() {
        next += 1;
        for entry in fs::read_dir(folder)? {
            let entry = entry?;
            match entry.file_type()? {
                kind if kind.is_dir() => folders.push(entry.path()),
                kind if kind.is_file() => files.push(entry.path()),
                _ => {}
            }
        }
    }
    std::thread::scope(|scope| {
        let share = files.len().div_ceil(SYNCED_AT_ONCE).max(1);
        let sync_all = |paths: &[PathBuf]| paths.iter().try_for_each(|p| sync_entry(p));
        let workers: Vec<_> = files.chunks(share).map(|paths| scope.spawn(move || sync_all(paths))).collect();
        let died = || Err(io::Error::other("a thread broke down"));
        workers.into_iter().try_for_each(|worker| worker.join().unwrap_or_else(|_| died()))
    })?;
    folders.iter().try_for_each(|folder| sync_entry(folder))
}

fn sync_entry(path: &Path) -> io::Result<()> {
    File::open(path)?.sync_all()
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
    fn what_is_in_the_way_is_named_and_stays() {
        let dir = tempfile::tempdir().unwrap();
        let (file, full) = (dir.path().join("file"), dir.path().join("full"));
        fs::write(&file, "mine").unwrap();
        fs::create_dir_all(full.join("inner")).unwrap();
        let error = |result: Result<()>| result.unwrap_err().to_string();
        for path in [file.clone(), file.join("below"), PathBuf::from("/"), PathBuf::from("..")] {
            assert!(error(AtomicDir::create(path).map(drop)).contains(": cannot "));
        }
        assert!(error(check_replaceable(&full, "a dataset", &["dataset.json"])).ends_with("so it is not replaced"));
        check_replaceable(full.join("inner"), "a dataset", &["dataset.json"]).unwrap();
        check_replaceable(dir.path(), "a file", &["x", "file"]).unwrap();
        check_replaceable(dir.path().join("new"), "a dataset", &[]).unwrap();
        assert_eq!(fs::read(&file).unwrap(), b"mine");
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
