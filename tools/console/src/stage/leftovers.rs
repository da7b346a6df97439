//! What a process that was killed left beside its result.

use std::fs;
use std::path::{Path, PathBuf};

/// Puts a result back that was set aside to be replaced, and removes half-made ones: `.NAME.PID.part` and
/// `.NAME.PID.old`, the names that `formats::atomic` gives. Only for whoever has the lock.
pub(super) fn clear(result: &Path) {
    let Some(name) = result.file_name().map(|n| n.to_string_lossy().into_owned()) else { return };
    let parent = result.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let Ok(entries) = fs::read_dir(parent) else { return };
    let found: Vec<PathBuf> = entries.flatten().map(|e| e.path()).collect();
    for ending in ["old", "part"] {
        for path in found.iter().filter(|p| is_leftover(p, &name, ending)) {
            // What cannot be removed does no harm.
            if ending == "old" && fs::symlink_metadata(result).is_err() {
                let _ = fs::rename(path, result);
            } else if path.is_dir() {
                let _ = fs::remove_dir_all(path);
            } else {
                let _ = fs::remove_file(path);
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
