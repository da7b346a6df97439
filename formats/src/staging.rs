//! Where a file or folder lies until it is whole, and the removal of what killed processes left behind.
//!
//! It lies beside its place under a hidden name of its own, and is locked for as long as its owner lives: the system lets
//! go of the lock however the owner ends. What is found under such a name, of a process that is no more and unlocked,
//! belongs to nobody; the first time a process stages something in a folder, it removes what it finds there.

use std::collections::BTreeSet;
use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Mutex, PoisonError};

/// Ends the name of what is not whole yet.
const PART: &str = ".part";
/// Ends the name of an older folder that is being replaced.
const OLD: &str = ".old";
/// Names that are tried; more than one only where another process uses the same number, in a container of its own.
const TRIES: u32 = 1000;

static NEXT: AtomicU32 = AtomicU32::new(0);
/// Folders in which this process has looked for leftovers.
static SWEPT: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());

/// A file or folder that is not whole yet; dropped, it goes with all that is in it.
#[derive(Debug)]
pub struct Staging {
    path: PathBuf,
    /// Held for the lock's sake.
    _lock: Option<File>,
}

impl Staging {
    /// An empty file beside `path`, open for writing. `ending` follows its name, for writers that go by endings.
    pub fn file(path: &Path, ending: &str) -> io::Result<(Self, File)> {
        claim(path, ending, |at| {
            let file = File::options().write(true).create_new(true).open(at)?;
            Ok((file.try_clone().ok(), file))
        })
    }

    /// An empty folder beside `path`.
    pub fn folder(path: &Path) -> io::Result<Self> {
        // Not every system opens folders to be locked; there the owner's number has to do.
        let (staging, ()) = claim(path, "", |at| fs::create_dir(at).map(|()| (File::open(at).ok(), ())))?;
        Ok(staging)
    }

    /// Where it lies.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Where an older folder lies while this one takes its place, on systems that do not exchange them in one step.
    pub(crate) fn old(&self) -> PathBuf {
        self.path.with_extension(&OLD[1..])
    }
}

impl Drop for Staging {
    fn drop(&mut self) {
        // What was put in its place is not here any more, and nothing is found.
        if self.path.is_dir() {
            let _ = fs::remove_dir_all(&self.path);
        } else {
            let _ = fs::remove_file(&self.path);
        }
    }
}

/// Makes something under a name that nobody else has, and locks it.
fn claim<T>(
    path: &Path,
    ending: &str,
    make: impl Fn(&Path) -> io::Result<(Option<File>, T)>,
) -> io::Result<(Staging, T)> {
    let parent = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    sweep(parent);
    let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    for _ in 0..TRIES {
        let count = NEXT.fetch_add(1, Ordering::Relaxed);
        let at = path.with_file_name(format!(".{name}.{}-{count}{PART}{ending}", std::process::id()));
        let (lock, made) = match make(&at) {
            Err(e) if e.kind() == io::ErrorKind::AlreadyExists => continue,
            other => other?,
        };
        match lock.as_ref().map(File::try_lock) {
            // Another process took it for a leftover in the moment before it was locked.
            Some(Err(TryLockError::WouldBlock)) => {}
            Some(Ok(())) if lock.as_ref().is_some_and(|lock| !is_at(lock, &at)) => {}
            // Locked, or on a file system without locks.
            _ => return Ok((Staging { path: at, _lock: lock }, made)),
        }
    }
    Err(io::ErrorKind::AlreadyExists.into())
}

/// Whether an open file or folder is the one at `path`: another process may have removed it, or put another in its place.
#[cfg(unix)]
pub fn is_at(file: &File, path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt as _;
    match (file.metadata(), path.symlink_metadata()) {
        (Ok(a), Ok(b)) => (a.dev(), a.ino()) == (b.dev(), b.ino()),
        _ => false,
    }
}

/// Whether there is something at `path`: elsewhere an open file cannot be removed.
#[cfg(not(unix))]
pub fn is_at(_: &File, path: &Path) -> bool {
    path.exists()
}

/// Removes what ended processes left in `folder`, the first time this process asks. What cannot be removed stays: nothing
/// depends on it.
fn sweep(folder: &Path) {
    let known = fs::canonicalize(folder).unwrap_or_else(|_| folder.to_owned());
    if !SWEPT.lock().unwrap_or_else(PoisonError::into_inner).insert(known) {
        return;
    }
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let name = entry.file_name();
        let Some((whole, owner, is_old)) = name.to_str().and_then(parse) else { continue };
        // Links and devices are nothing of ours.
        let Ok(kind) = entry.file_type() else { continue };
        if is_alive(owner) || !(kind.is_dir() || kind.is_file()) {
            continue;
        }
        let path = entry.path();
        let Ok(lock) = File::open(&path) else { continue };
        if lock.try_lock().is_err() {
            continue;
        }
        let whole = folder.join(whole);
        let _ = match (kind.is_dir(), is_old) {
            // Its owner ended between moving it aside and putting the new one in its place.
            (true, true) if whole.symlink_metadata().is_err() => fs::rename(&path, &whole),
            (true, _) => fs::remove_dir_all(&path),
            (false, _) => fs::remove_file(&path),
        };
    }
}

/// The place, the owner's process, and whether it is an older folder, of a name such as `.ada.4711-0.part`.
fn parse(name: &str) -> Option<(&str, u32, bool)> {
    let rest = name.strip_prefix('.')?;
    let (rest, is_old) = match rest.strip_suffix(OLD) {
        Some(rest) => (rest, true),
        None => (rest.strip_suffix(PART).or_else(|| rest.strip_suffix(".part.mp4"))?, false),
    };
    let (whole, numbers) = rest.rsplit_once('.')?;
    let (owner, count) = numbers.split_once('-')?;
    let is_number = |s: &str| !s.is_empty() && s.bytes().all(|b| b.is_ascii_digit());
    (!whole.is_empty() && is_number(owner) && is_number(count)).then_some(())?;
    Some((whole, owner.parse().ok()?, is_old))
}

/// Whether a process of this number runs here; elsewhere than on Linux, only the lock can tell.
fn is_alive(process: u32) -> bool {
    cfg!(target_os = "linux") && Path::new("/proc").join(process.to_string()).exists()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A number that no process has: Linux gives none above 2²².
    const NOBODY: u32 = 1 << 30;

    fn names(dir: &Path) -> Vec<String> {
        let mut names: Vec<_> =
            fs::read_dir(dir).unwrap().map(|e| e.unwrap().file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }

    #[test]
    fn leftovers_of_ended_processes_go_and_nothing_else_does() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        for name in ["a", "video"] {
            fs::write(at(&format!(".{name}.{NOBODY}-3.part")), "half").unwrap();
        }
        fs::write(at(&format!(".video.{NOBODY}-0.part.mp4")), "half").unwrap();
        fs::create_dir_all(at(&format!(".ada.{NOBODY}-1.part/deep"))).unwrap();
        // Moved aside by a process that was killed before the new one was in place, and after.
        for (whole, file) in [("lost", "x"), ("kept", "y")] {
            fs::create_dir(at(&format!(".{whole}.{NOBODY}-2.old"))).unwrap();
            fs::write(at(&format!(".{whole}.{NOBODY}-2.old/{file}")), "").unwrap();
        }
        fs::create_dir(at("kept")).unwrap();
        // Of a living process, locked by one that is not seen from here, and other people's.
        let mine = format!(".b.{}-9.part", std::process::id());
        let locked = format!(".c.{NOBODY}-0.part");
        let others = [".x.part", ".y.12.part", ".z.1-2.parts", "z.1-2.part", ".1-2.part"];
        for name in others.iter().copied().chain([mine.as_str(), &locked]) {
            fs::write(at(name), "theirs").unwrap();
        }
        let lock = File::open(at(&locked)).unwrap();
        lock.try_lock().unwrap();

        let (staging, _) = Staging::file(&at("new"), "").unwrap();
        drop(staging);
        let mut expected: Vec<String> = others.iter().map(|s| (*s).to_owned()).collect();
        expected.extend([mine, locked, "kept".to_owned(), "lost".to_owned()]);
        expected.sort();
        assert_eq!(names(dir.path()), expected);
        assert!(at("lost/x").is_file() && !at("kept/y").exists());
    }

    #[test]
    fn many_at_once_have_names_of_their_own() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("same");
        let all: Vec<Staging> = (0..8).map(|_| Staging::folder(&path).unwrap()).collect();
        assert_eq!(names(dir.path()).len(), all.len());
        assert!(all.iter().all(|s| parse(s.path().file_name().unwrap().to_str().unwrap()).is_some()));
        drop(all);
        assert!(names(dir.path()).is_empty());
    }
}
