//! Shared by the end-to-end tests: where the binaries and the development data are.

mod fixture;
mod viewer;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

pub use fixture::{linked_copy, posed_take, shared_fixture, tiny};
pub use viewer::{Answer, Viewer, Visitor};

/// The built binary `name`; tests of the whole chain run what users run.
///
/// Cargo builds the workspace's binaries next to this test's own executable (`target/<profile>/`).
#[must_use]
pub fn binary(name: &str) -> PathBuf {
    let mut dir = std::env::current_exe().unwrap_or_default();
    dir.pop();
    if dir.ends_with("deps") {
        dir.pop();
    }
    dir.join(name)
}

/// Runs a binary and panics with its output unless it succeeds.
///
/// # Panics
/// When the binary is missing or fails.
pub fn succeed(name: &str, args: &[&str]) -> String {
    let output = run(name, args);
    assert!(
        output.status.success(),
        "`{name} {}` failed\n{}{}",
        args.join(" "),
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// Runs a binary.
///
/// # Panics
/// When it cannot be started.
pub fn run(name: &str, args: &[&str]) -> Output {
    let path = binary(name);
    match Command::new(&path).args(args).output() {
        Ok(output) => output,
        Err(e) => {
            panic!("{} cannot be started: {e}; build it with `cargo build --release --workspace`", path.display())
        }
    }
}

/// A path as the argument of a command.
///
/// # Panics
/// When it is no UTF-8.
#[must_use]
pub fn text(path: &Path) -> &str {
    path.to_str().unwrap_or_else(|| panic!("{} is no UTF-8", path.display()))
}

/// All files below a folder, by their paths in it, with what they hold.
///
/// # Panics
/// When one of them cannot be read.
#[must_use]
pub fn files(dir: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut folders = vec![dir.to_owned()];
    let fail = |path: &Path, e: std::io::Error| -> ! { panic!("{} cannot be read: {e}", path.display()) };
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).unwrap_or_else(|e| fail(&folder, e)) {
            let path = entry.unwrap_or_else(|e| fail(&folder, e)).path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let bytes = std::fs::read(&path).unwrap_or_else(|e| fail(&path, e));
                found.insert(path.strip_prefix(dir).unwrap_or(&path).to_owned(), bytes);
            }
        }
    }
    found
}

/// A file of the development data beside the repository, or `None` with a loud word about it.
#[must_use]
pub fn shared(path: &str) -> Option<PathBuf> {
    let base = std::env::var_os("RISORIUS_SHARED")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared"), PathBuf::from);
    let found = base.join(path);
    if found.exists() {
        return Some(found);
    }
    #[expect(clippy::print_stderr, reason = "a test that is skipped has to say so")]
    {
        eprintln!("SKIPPED: the development data `{path}` is not there (RISORIUS_SHARED names its folder)");
    }
    None
}
