//! What a process that was killed left beside its result.

use std::fs;
use std::path::{Path, PathBuf};

/// How deep a result that grows in its place is looked into.
const DEPTH: usize = 2;

/// Puts a result back that was set aside to be replaced, and removes half-made ones: `.NAME.PID.part` and
/// `.NAME.PID.old`, the names that `formats::atomic` gives; in the result those of the process that died, and scratch
/// files. Only for whoever has the lock.
pub(super) fn clear(result: &Path, died: u32) {
    beside(result);
    inside(result, died, DEPTH);
}

/// Half-made files in a result that grows in its place, such as a run.
fn inside(folder: &Path, died: u32, depth: usize) {
    let endings = [format!(".{died}.part"), format!(".{died}.old")];
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let (path, name) = (entry.path(), entry.file_name().to_string_lossy().into_owned());
        // `.tmp` and six letters is what writers that want a file of their own make.
        let scratch = name.strip_prefix(".tmp").is_some_and(|n| n.len() == 6 && path.is_file());
        if scratch || (name.starts_with('.') && endings.iter().any(|e| name.ends_with(e))) {
            remove(&path);
        } else if depth > 1 && entry.file_type().is_ok_and(|t| t.is_dir()) {
            inside(&path, died, depth - 1);
        }
    }
}

fn remove(path: &Path) {
    // What cannot be removed does no harm.
    let _ = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
}

fn beside(result: &Path) {
    let Some(name) = result.file_name().map(|n| n.to_string_lossy().into_owned()) else { return };
    let parent = result.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let Ok(entries) = fs::read_dir(parent) else { return };
    let found: Vec<PathBuf> = entries.flatten().map(|e| e.path()).collect();
    for ending in ["old", "part"] {
        for path in found.iter().filter(|p| is_leftover(p, &name, ending)) {
            if ending == "old" && fs::symlink_metadata(result).is_err() {
                let _ = fs::rename(path, result);
            } else {
                remove(path);
            }
        }
    }
}

fn is_leftover(path: &Path, name: &str, ending: &str) -> bool {
    let file = path.file_name().unwrap_or_default().to_string_lossy();
    let rest = file.strip_prefix('.').and_then(|f| f.strip_prefix(name)).and_then(|f| f.strip_prefix('.'));
    let pid = rest.and_then(|r| r.strip_suffix(ending)).and_then(|r| r.strip_suffix('.'));
    pid.is_some_and(|p| !p.is_empty() && p.bytes().all(|b| b.is_ascii_digit()))
}
