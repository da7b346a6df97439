//! Captures and avatars that many tests look at and none changes, made once for all test processes.
//!
//! Test runners give each test a process of its own, so that a `static` is made anew every time. What is made here lies
//! in the target folder under a key of the binaries that made it, is made by whoever comes first while the others wait,
//! and gives way to the next build's.

use std::fs::{self, File};
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use crate::{binary, succeed, text};

/// The binaries that captures and avatars are made with.
const MAKERS: [&str; 5] = ["synth", "capture", "tracker", "dataset", "trainer"];

/// The folder of the fixture `name`, which `make` fills if this build has not made it yet.
///
/// Tests must not change anything in it; what they write goes to a folder of their own.
///
/// # Panics
/// When the target folder cannot be written to, or `make` panics: then nothing is left, and the next test tries again.
pub fn shared_fixture(name: &str, make: impl FnOnce(&Path)) -> PathBuf {
    let fail = |what: &str, path: &Path, e: std::io::Error| -> ! { panic!("cannot {what} {}: {e}", path.display()) };
    // From target/<profile>/ to target/tmp/fixtures.
    let target = binary("").parent().map(Path::to_owned).unwrap_or_default();
    let folder = target.join("tmp").join("fixtures");
    fs::create_dir_all(&folder).unwrap_or_else(|e| fail("create", &folder, e));
    let lock_path = folder.join(format!("{name}.lock"));
    let lock = File::create(&lock_path).unwrap_or_else(|e| fail("open", &lock_path, e));
    // Held until the file is closed, also by a process that is killed.
    lock.lock().unwrap_or_else(|e| fail("lock", &lock_path, e));
    let done = folder.join(format!("{name}-{:016x}", key()));
    if done.is_dir() {
        return done;
    }
    for entry in fs::read_dir(&folder).into_iter().flatten().flatten() {
        let is_old = entry.file_name().to_str().is_some_and(|n| n.strip_prefix(name).is_some_and(is_key));
        if is_old {
            let _ = fs::remove_dir_all(entry.path());
        }
    }
    let staging = folder.join(format!("{name}-{:016x}.part", key()));
    fs::create_dir_all(&staging).unwrap_or_else(|e| fail("create", &staging, e));
    make(&staging);
    fs::rename(&staging, &done).unwrap_or_else(|e| fail("rename", &staging, e));
    done
}

/// `-` and 16 digits, and perhaps `.part`: a folder of this or another build.
fn is_key(rest: &str) -> bool {
    let digits = rest.strip_suffix(".part").unwrap_or(rest);
    digits.len() == 17 && digits.starts_with('-') && digits[1..].bytes().all(|b| b.is_ascii_hexdigit())
}

/// Changes with every build of a binary.
fn key() -> u64 {
    let mut hasher = DefaultHasher::new();
    for name in MAKERS {
        let of = fs::metadata(binary(name)).ok().and_then(|m| {
            let modified = m.modified().ok()?.duration_since(UNIX_EPOCH).ok()?;
            Some((m.len(), modified))
        });
        (name, of).hash(&mut hasher);
    }
    hasher.finish()
}

/// A capture of so many small frames, and a take of it with its track and poses.
///
/// # Panics
/// When they cannot be made.
pub fn posed_take(capture: &Path, take: &Path, frames: usize) {
    let frames = frames.to_string();
    succeed("synth", &["--out", text(capture), "--frames", &frames, "--fps", "30", "--size", "64x96", "-q"]);
    succeed("capture", &["record", "--input", text(&capture.join("video.mp4")), "--out", text(take), "-q"]);
    succeed("tracker", &["import", text(take), "--openface", text(&capture.join("openface.csv")), "-q"]);
    succeed("tracker", &["poses", text(take), "--colmap-model", text(&capture.join("truth_colmap")), "-q"]);
}

/// A small capture with a take, a dataset and an avatar of each field: `capture`, `take`, `data`, `splat`, `confies`.
///
/// # Panics
/// When it cannot be made.
#[must_use]
#[expect(clippy::unwrap_used, reason = "a test fails by panicking")]
pub fn tiny() -> PathBuf {
    shared_fixture("tiny", |dir| {
        let at = |name: &str| dir.join(name);
        let (capture, take, data) = (at("capture"), at("take"), at("data"));
        posed_take(&capture, &take, 24);
        let build = ["build", text(&take), "--balance", "--frames", "12", "--scale", "2", "--scales", "2", "-q"];
        succeed("dataset", &[&build[..], &["--out", text(&data)]].concat());
        for (field, more) in [("splat", &["--steps", "20"][..]), ("confies", &["--preset", "tiny", "--steps", "2"])] {
            let run = at(field);
            succeed("trainer", &[&["fit", text(&data), "--out", text(&run), "--field", field, "-q"], more].concat());
            fs::remove_dir_all(run.join("checkpoints")).unwrap();
        }
    })
}

/// A copy of the folder `from` at `to` for a test that writes into it: files are linked where the file system can, so that
/// it costs nothing, and must be replaced, not written to.
///
/// # Panics
/// When a file can be neither linked nor copied.
pub fn linked_copy(from: &Path, to: &Path) {
    let fail = |e: std::io::Error| panic!("cannot copy {} to {}: {e}", from.display(), to.display());
    fs::create_dir_all(to).unwrap_or_else(fail);
    for entry in fs::read_dir(from).unwrap_or_else(|e| panic!("cannot read {}: {e}", from.display())).flatten() {
        let (path, target) = (entry.path(), to.join(entry.file_name()));
        if path.is_dir() {
            linked_copy(&path, &target);
        } else if fs::hard_link(&path, &target).is_err() {
            fs::copy(&path, &target).map_or_else(fail, drop);
        }
    }
}
