//! One process at a time per result: a lock file beside it that says who makes it and since when.
//!
//! The file is locked by the operating system, which lets go of it when the owner ends, however it ends. So a lock whose
//! owner was killed is free at once, and no process can take a lock from a living one. What stands in the file is for
//! people, for telling that the last owner died, and for folders that several machines share without sharing locks:
//! there, an owner of another machine is believed for as long as it writes itself down again, every [`HEARTBEAT`].

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::thread::JoinHandle;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use risorius_formats::staging::is_at;
use risorius_formats::{FormatError, Reporter, Warning};
use serde::{Deserialize, Serialize};

use crate::Failure;

/// How often an owner writes itself down again.
const HEARTBEAT: Duration = Duration::from_secs(20);
/// An owner on another machine that has not been heard of for this long is dead.
const SILENCE: Duration = Duration::from_mins(3);
/// How often a waiting process looks again.
const POLL: Duration = Duration::from_millis(200);

/// Who makes a result.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Owner {
    stage: String,
    host: String,
    pid: u32,
    since_unix_secs: u64,
}

impl Owner {
    fn this(stage: &str) -> Self {
        Self { stage: stage.to_owned(), host: host(), pid: std::process::id(), since_unix_secs: unix_secs() }
    }

    /// `` `trainer fit` (process 12 on here, since 40 s) ``
    fn in_words(&self) -> String {
        let age = unix_secs().saturating_sub(self.since_unix_secs);
        let since = if age < 120 { format!("{age} s") } else { format!("{} min", age / 60) };
        format!("`{}` (process {} on {}, since {since})", self.stage, self.pid, self.host)
    }
}

/// The right to make a result, until it is dropped.
#[derive(Debug)]
pub(super) struct Lock {
    path: PathBuf,
    file: File,
    beat: Option<(Sender<()>, JoinHandle<()>)>,
    /// Folders that were made for the lock, the deepest first: they go again if nothing came into them.
    made: Vec<PathBuf>,
}

/// What an attempt found.
enum Found {
    Free { file: File, died: Option<Owner> },
    Held(Option<Owner>),
}

impl Lock {
    /// Takes the lock of `result` for `stage`. Where another process has it, waits for that one to end with `wait`, else
    /// fails. `None` for a path that no lock can lie beside, such as `..`.
    pub(super) fn take(
        result: &Path,
        stage: &str,
        wait: bool,
        reporter: &dyn Reporter,
    ) -> Result<Option<Self>, Failure> {
        // Two names of one folder are one result.
        let real = if result.is_symlink() { fs::canonicalize(result) } else { Ok(result.to_owned()) };
        let real = real.unwrap_or_else(|_| result.to_owned());
        let Some(name) = real.file_name() else { return Ok(None) };
        let path = real.with_file_name(format!(".{}.lock", name.to_string_lossy()));
        let made = make_parent(&path)?;
        let mut told = false;
        loop {
            match look(&path).map_err(|e| FormatError::io(result, "create the folder", &e))? {
                Found::Free { mut file, died } => {
                    write_owner(&mut file, stage).map_err(|e| FormatError::io(&path, "write", &e))?;
                    if let Some(owner) = died {
                        let message = format!("{}: takes over from {}, which died", result.display(), owner.in_words());
                        reporter.warn(Warning::new("stale-lock", message));
                    }
                    let beat = file.try_clone().ok().and_then(|file| heartbeat(file, stage));
                    return Ok(Some(Self { path, file, beat, made }));
                }
                Found::Held(owner) if wait => {
                    if reporter.cancelled() {
                        return Err(Failure::interrupted("nothing was written"));
                    }
                    if !told {
                        reporter.note(&format!("{}: waits for {}", result.display(), in_words(owner.as_ref())));
                        told = true;
                    }
                    std::thread::sleep(POLL);
                }
                Found::Held(owner) => {
                    let message = format!("{}: is being made by {}", result.display(), in_words(owner.as_ref()));
                    return Err(Failure::input(message).with_hint(
                        "wait until that is done, or end it; the lock of a process that died is taken over by itself",
                    ));
                }
            }
        }
    }
}

impl Drop for Lock {
    fn drop(&mut self) {
        if let Some((stop, thread)) = self.beat.take() {
            drop(stop);
            let _ = thread.join();
        }
        // Removed while it is locked: whoever opened it meanwhile sees that it is not the file at the path any more.
        if is_at(&self.file, &self.path) {
            let _ = fs::remove_file(&self.path);
        }
        for folder in &self.made {
            let _ = fs::remove_dir(folder);
        }
    }
}

fn in_words(owner: Option<&Owner>) -> String {
    owner.map_or_else(|| "another process".to_owned(), Owner::in_words)
}

/// Opens and locks the file at `path`, if nobody has it.
fn look(path: &Path) -> io::Result<Found> {
    loop {
        let mut file = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(path)?;
        match file.try_lock() {
            Ok(()) if !is_at(&file, path) => {}
            Ok(()) => {
                let owner = read_owner(&mut file);
                let elsewhere = owner.as_ref().is_some_and(|o| o.host != host());
                return Ok(if elsewhere && !is_silent(&file) {
                    Found::Held(owner)
                } else {
                    Found::Free { file, died: owner }
                });
            }
            Err(TryLockError::WouldBlock) => return Ok(Found::Held(read_owner(&mut file))),
            // A file system without locks: what stands in the file has to do.
            Err(TryLockError::Error(_)) => {
                let owner = read_owner(&mut file);
                let lives = owner.as_ref().is_some_and(|o| o.host == host() && is_alive(o.pid));
                let held = lives || (owner.is_some() && !is_silent(&file));
                return Ok(if held { Found::Held(owner) } else { Found::Free { file, died: owner } });
            }
        }
    }
}

fn read_owner(file: &mut File) -> Option<Owner> {
    let mut text = String::new();
    file.seek(SeekFrom::Start(0)).ok()?;
    file.read_to_string(&mut text).ok()?;
    serde_json::from_str(&text).ok()
}

fn write_owner(file: &mut File, stage: &str) -> io::Result<()> {
    let text = serde_json::to_string(&Owner::this(stage)).map_err(io::Error::other)?;
    file.set_len(0)?;
    file.seek(SeekFrom::Start(0))?;
    file.write_all(text.as_bytes())
}

/// Sets the file's time now and then, so that other machines know that its owner lives.
fn heartbeat(file: File, stage: &str) -> Option<(Sender<()>, JoinHandle<()>)> {
    let (stop, stopped) = mpsc::channel();
    let beat = move || {
        while stopped.recv_timeout(HEARTBEAT) == Err(RecvTimeoutError::Timeout) {
            let _ = file.set_modified(SystemTime::now());
        }
    };
    let thread = std::thread::Builder::new().name(format!("lock of {stage}")).spawn(beat).ok()?;
    Some((stop, thread))
}

fn is_silent(file: &File) -> bool {
    let modified = file.metadata().and_then(|m| m.modified());
    modified.ok().and_then(|t| t.elapsed().ok()).is_some_and(|age| age > SILENCE)
}

fn is_alive(pid: u32) -> bool {
    // Where there is no such folder, nobody can tell: believe it.
    !Path::new("/proc/self").exists() || Path::new(&format!("/proc/{pid}")).exists()
}

fn host() -> String {
    let read = |path: &str| fs::read_to_string(path).ok().map(|s| s.trim().to_owned()).filter(|s| !s.is_empty());
    let set = |name: &str| std::env::var(name).ok().filter(|s| !s.is_empty());
    read("/proc/sys/kernel/hostname")
        .or_else(|| set("HOSTNAME"))
        .or_else(|| set("COMPUTERNAME"))
        .unwrap_or_else(|| "this machine".to_owned())
}

fn unix_secs() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs())
}

/// Makes the folder that `path` is to lie in; gives the folders that were not there, the deepest first.
fn make_parent(path: &Path) -> Result<Vec<PathBuf>, Failure> {
    let Some(parent) = path.parent().filter(|p| !p.as_os_str().is_empty()) else { return Ok(Vec::new()) };
    let missing = parent.ancestors().take_while(|p| !p.as_os_str().is_empty() && fs::symlink_metadata(p).is_err());
    let missing: Vec<PathBuf> = missing.map(Path::to_owned).collect();
    fs::create_dir_all(parent).map_err(|e| FormatError::io(parent, "create the folder", &e))?;
    Ok(missing)
}

#[cfg(test)]
mod tests {
    use risorius_formats::Silent;
    use risorius_formats::report::Collected;

    use super::*;

    fn entries(dir: &Path) -> Vec<String> {
        let mut all: Vec<_> =
            fs::read_dir(dir).unwrap().map(|e| e.unwrap().file_name().to_string_lossy().into_owned()).collect();
        all.sort();
        all
    }

    #[test]
    fn a_second_process_is_told_who_has_it_and_nothing_stays_behind() {
        let dir = tempfile::tempdir().unwrap();
        let result = dir.path().join("new/take/track");
        let first = Lock::take(&result, "tracker run", false, &Silent).unwrap().unwrap();
        let failure = Lock::take(&result, "tracker import", false, &Silent).unwrap_err();
        let words = format!("is being made by `tracker run` (process {} on ", std::process::id());
        assert!(failure.message().contains(&words), "{failure:?}");
        assert_eq!(failure.status(), 1);
        drop(first);
        drop(Lock::take(&result, "tracker import", false, &Silent).unwrap());
        assert!(entries(dir.path()).is_empty());
        assert!(Lock::take(Path::new(".."), "x", false, &Silent).unwrap().is_none());
    }

    #[test]
    fn of_many_at_once_one_at_a_time_gets_it() {
        let dir = tempfile::tempdir().unwrap();
        let result = dir.path().join("result");
        let inside = std::sync::atomic::AtomicU32::new(0);
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| {
                    for _ in 0..10 {
                        let lock = Lock::take(&result, "x", true, &Silent).unwrap();
                        assert_eq!(inside.fetch_add(1, std::sync::atomic::Ordering::SeqCst), 0);
                        inside.fetch_sub(1, std::sync::atomic::Ordering::SeqCst);
                        drop(lock);
                    }
                });
            }
        });
        assert!(entries(dir.path()).is_empty());
    }

    #[test]
    fn the_lock_of_a_dead_process_is_taken_over_with_a_word() {
        let dir = tempfile::tempdir().unwrap();
        let result = dir.path().join("track");
        let dead = Owner { stage: "tracker run".to_owned(), host: host(), pid: 4_000_000, since_unix_secs: 0 };
        fs::write(dir.path().join(".track.lock"), serde_json::to_string(&dead).unwrap()).unwrap();
        let heard = Collected::default();
        let lock = Lock::take(&result, "tracker run", false, &heard).unwrap();
        let warnings = heard.warnings();
        assert!(warnings[0].message.contains("takes over from `tracker run` (process 4000000 on"), "{warnings:?}");
        drop(lock);
        assert!(entries(dir.path()).is_empty());
    }

    #[test]
    fn an_owner_on_another_machine_is_believed_while_it_is_heard_of() {
        let dir = tempfile::tempdir().unwrap();
        let (result, path) = (dir.path().join("run"), dir.path().join(".run.lock"));
        let other =
            Owner { stage: "trainer fit".to_owned(), host: "else where".to_owned(), pid: 1, since_unix_secs: 0 };
        fs::write(&path, serde_json::to_string(&other).unwrap()).unwrap();
        assert!(Lock::take(&result, "x", false, &Silent).is_err());
        let file = OpenOptions::new().write(true).open(&path).unwrap();
        file.set_modified(SystemTime::now() - SILENCE * 2).unwrap();
        drop(Lock::take(&result, "x", false, &Silent).unwrap());
        assert!(!path.exists());
    }
}
