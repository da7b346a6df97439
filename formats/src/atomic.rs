//! Files and folders that appear whole or not at all: written beside their place, synced, then renamed.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use crate::staging::Staging;
use crate::{ErrorKind, FormatError, Result};

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

/// Puts a file at `path` that `write` makes in a folder of its own: for writers that lay further files beside theirs.
pub fn write_file_by<E: From<FormatError>>(
    path: impl AsRef<Path>,
    write: impl FnOnce(&Path) -> std::result::Result<(), E>,
) -> std::result::Result<(), E> {
    let path = path.as_ref();
    let wrap = |e: io::Error| FormatError::io(path, "write", &e);
    create_parent(path)?;
    let staging = Staging::folder(path).map_err(wrap)?;
    let file = staging.path().join(path.file_name().unwrap_or_default());
    write(&file)?;
    sync_entry(&file).map_err(wrap)?;
    fs::rename(&file, path).map_err(wrap)?;
    Ok(())
}

/// A file under construction. Dropped without [`commit`](Self::commit), it leaves nothing behind.
#[derive(Debug)]
pub struct AtomicFile {
    path: PathBuf,
    writer: Option<BufWriter<File>>,
    staging: Staging,
}

impl AtomicFile {
    /// Begins a file that will appear at `path`.
    pub fn create(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref().to_owned();
        create_parent(&path)?;
        let (staging, file) = Staging::file(&path, "").map_err(|e| FormatError::io(&path, "create", &e))?;
        Ok(Self { path, writer: Some(BufWriter::with_capacity(1 << 18, file)), staging })
    }

    /// Where the file lies until it is committed, for writers that want a path of their own.
    pub fn staging_path(&self) -> &Path {
        self.staging.path()
    }

    /// Flushes, syncs and renames the file into its place.
    pub fn commit(mut self) -> Result<()> {
        let wrap = |e: io::Error| FormatError::io(&self.path, "write", &e);
        if let Some(writer) = self.writer.take() {
            let file = writer.into_inner().map_err(|e| wrap(e.into_error()))?;
            file.sync_all().map_err(wrap)?;
        }
        fs::rename(self.staging.path(), &self.path).map_err(wrap)
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

/// A folder under construction. Dropped without [`commit`](Self::commit), it leaves nothing behind.
#[derive(Debug)]
pub struct AtomicDir {
    path: PathBuf,
    staging: Staging,
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
        let staging = Staging::folder(&path).map_err(|e| FormatError::io(&path, "create the folder", &e))?;
        Ok(Self { path, staging })
    }

    /// The folder to fill.
    pub fn path(&self) -> &Path {
        self.staging.path()
    }

    /// Syncs all files and renames the folder into its place; an older folder there is replaced, in one step where the
    /// system can.
    pub fn commit(self) -> Result<()> {
        let wrap = |e: io::Error| FormatError::io(&self.path, "put in place", &e);
        let staging = self.staging.path();
        sync_folder(staging).map_err(wrap)?;
        let replaces = self.path.exists();
        let old = if replaces && exchange(staging, &self.path).is_ok() {
            Some(staging.to_owned())
        } else if replaces {
            let old = self.staging.old();
            // Others tell by the lock that the older folder is not a leftover yet.
            let _lock = File::open(&self.path).ok().filter(|folder| folder.try_lock().is_ok());
            fs::rename(&self.path, &old).map_err(wrap)?;
            if let Err(e) = fs::rename(staging, &self.path) {
                // Put the older folder back: nothing is lost on failure.
                let _ = fs::rename(&old, &self.path);
                return Err(wrap(e));
            }
            Some(old)
        } else {
            fs::rename(staging, &self.path).map_err(wrap)?;
            None
        };
        // From here on the new folder is in its place: what fails now is no failure of the work.
        if let Some(parent) = self.path.parent() {
            let _ = sync_entry(if parent.as_os_str().is_empty() { Path::new(".") } else { parent });
        }
        match old.map(|old| (fs::remove_dir_all(&old), old)) {
            Some((Err(e), old)) if e.kind() != io::ErrorKind::NotFound => {
                Err(FormatError::io(&old, "remove the older folder", &e))
            }
            _ => Ok(()),
        }
    }
}

/// Lets two folders change places in one step, so that there is a whole one at each moment.
#[cfg(target_os = "linux")]
fn exchange(a: &Path, b: &Path) -> io::Result<()> {
    use rustix::fs::{CWD, RenameFlags, renameat_with};
    Ok(renameat_with(CWD, a, CWD, b, RenameFlags::EXCHANGE)?)
}

#[cfg(not(target_os = "linux"))]
fn exchange(_: &Path, _: &Path) -> io::Result<()> {
    Err(io::ErrorKind::Unsupported.into())
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
