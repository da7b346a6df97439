//! Folders that come from somebody else: nothing in them may lead out of them.
//!
//! A dataset is shared as a folder. A name with `..` in it, a link to another place or a pipe in the place of a picture
//! would have a program read, copy or wait for what the sender never gave and the user never meant.

use std::path::{Component, Path};

use crate::{ErrorKind, FormatError, Result};

const LINKED: &str = "put the file itself in the place of the link";

/// Fails unless `path` is relative and stays below where it starts: no `..`, no root, not empty.
pub fn check_relative(path: impl AsRef<Path>) -> Result<()> {
    let path = path.as_ref();
    let stays = |c: Component<'_>| matches!(c, Component::Normal(_) | Component::CurDir);
    let names_a_file = path.file_name().is_some() && !path.to_string_lossy().contains('\0');
    if names_a_file && path.components().all(stays) {
        return Ok(());
    }
    let shown: String = path.to_string_lossy().chars().take(80).collect();
    Err(FormatError::new(ErrorKind::Inconsistent, format!("the path {shown:?} leads out of its folder"))
        .with_hint("name files by their path below the folder, such as `images/000123.png`"))
}

/// Fails where `path`, which lies below `dir`, is a link to a place outside of `dir`, or no file at all but a folder,
/// pipe or device. One that does not exist is left to whoever reads it.
pub fn check_file(dir: impl AsRef<Path>, path: impl AsRef<Path>) -> Result<()> {
    let (dir, path) = (dir.as_ref(), path.as_ref());
    let Ok(real) = std::fs::canonicalize(path) else { return Ok(()) };
    let root = std::fs::canonicalize(dir).map_err(|e| FormatError::io(dir, "open the folder", &e))?;
    let refused = |message: &str| FormatError::new(ErrorKind::Unsupported, message).in_file(path).with_hint(LINKED);
    if !real.starts_with(&root) {
        return Err(refused("is a link that leads out of the folder"));
    }
    match std::fs::metadata(&real) {
        Ok(m) if m.is_file() => Ok(()),
        Ok(m) if m.is_dir() => Err(refused("is a folder, not a file")),
        Ok(_) => Err(refused("is a pipe or a device, not a file")),
        Err(e) => Err(FormatError::io(path, "read", &e)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_paths_below_their_folder_pass() {
        for good in ["a.png", "./a.png", "images/a b.png", "a..b", "..a/b", "ü"] {
            assert!(check_relative(good).is_ok(), "{good}");
        }
        for bad in ["", ".", "..", "/etc/passwd", "../a.png", "images/../../a.png", "a/..", "a\0b"] {
            assert!(check_relative(bad).is_err(), "{bad}");
        }
    }

    #[cfg(unix)]
    #[test]
    fn links_out_of_the_folder_and_devices_are_refused() {
        use std::os::unix::fs::symlink;
        let dir = tempfile::tempdir().unwrap();
        let (inside, outside) = (dir.path().join("in"), dir.path().join("out.png"));
        std::fs::create_dir(&inside).unwrap();
        std::fs::write(&outside, b"x").unwrap();
        std::fs::write(inside.join("own.png"), b"x").unwrap();
        symlink("own.png", inside.join("alias.png")).unwrap();
        symlink("../out.png", inside.join("stranger.png")).unwrap();
        symlink("/dev/zero", inside.join("endless.png")).unwrap();
        symlink(dir.path(), inside.join("up")).unwrap();
        let check = |name: &str| check_file(&inside, inside.join(name));
        for good in ["own.png", "alias.png", "missing.png"] {
            assert!(check(good).is_ok(), "{good}");
        }
        for bad in ["stranger.png", "endless.png", "up/out.png", "."] {
            let error = check(bad).unwrap_err();
            assert!(error.path().is_some(), "{bad}: {error}");
        }
        // The folder itself may be reached by a link: that is the user's own.
        symlink(&inside, dir.path().join("link")).unwrap();
        assert!(check_file(dir.path().join("link"), dir.path().join("link/own.png")).is_ok());
    }
}
