//! The video or the images of a take: copied or referred to, with their hash.

use std::fs::{self, File};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use risorius_formats::{FormatError, Reporter, hash};
use sha2::{Digest, Sha256};

use crate::{CaptureError, Result};

/// Where a take's media lie and what they hash to.
#[derive(Debug)]
pub(crate) struct Media {
    /// As written into `take.toml`: relative to the take, or absolute.
    pub(crate) path: PathBuf,
    pub(crate) sha256: String,
}

/// Puts a video into the folder `dir`, or refers to it with `link`.
pub(crate) fn take_video(input: &Path, dir: &Path, link: bool, reporter: &dyn Reporter) -> Result<Media> {
    if link {
        let path = fs::canonicalize(input).map_err(|e| FormatError::io(input, "open", &e))?;
        return Ok(Media { path, sha256: copy(input, None, reporter)? });
    }
    let extension = input.extension().map_or_else(|| "mp4".to_owned(), |e| e.to_string_lossy().to_ascii_lowercase());
    let name = format!("video.{extension}");
    let sha256 = copy(input, Some(&dir.join(&name)), reporter)?;
    Ok(Media { path: name.into(), sha256 })
}

/// Puts the images of a folder into `dir/images`, or refers to the folder with `link`.
pub(crate) fn take_images(
    input: &Path,
    files: &[PathBuf],
    dir: &Path,
    link: bool,
    reporter: &dyn Reporter,
) -> Result<Media> {
    let target = dir.join("images");
    if !link {
        fs::create_dir(&target).map_err(|e| FormatError::io(&target, "create the folder", &e))?;
    }
    let mut hashes = Vec::with_capacity(files.len());
    for file in files {
        let to = (!link).then(|| target.join(file.file_name().unwrap_or_default()));
        hashes.push(copy(file, to.as_deref(), reporter)?);
    }
    let path =
        if link { fs::canonicalize(input).map_err(|e| FormatError::io(input, "open", &e))? } else { "images".into() };
    Ok(Media { path, sha256: hash_of_hashes(&hashes) })
}

/// The hash of an image folder: of its images' hashes, in the order of the frames, a line each.
pub(crate) fn hash_of_hashes(hashes: &[String]) -> String {
    hash::sha256_of_bytes((hashes.join("\n") + "\n").as_bytes())
}

/// Reads a file once: hashes it and, with `to`, copies it.
pub(crate) fn copy(from: &Path, to: Option<&Path>, reporter: &dyn Reporter) -> Result<String> {
    let read = |e: std::io::Error| FormatError::io(from, "read", &e);
    let mut source = File::open(from).map_err(read)?;
    let mut target = match to {
        Some(path) => Some((path, File::create(path).map_err(|e| FormatError::io(path, "create", &e))?)),
        None => None,
    };
    let mut hasher = Sha256::new();
    let mut buffer = vec![0; 1 << 20];
    loop {
        if reporter.cancelled() {
            return Err(CaptureError::Interrupted);
        }
        let n = match source.read(&mut buffer) {
            Ok(0) => break,
            Ok(n) => n,
            Err(e) if e.kind() == std::io::ErrorKind::Interrupted => continue,
            Err(e) => return Err(read(e).into()),
        };
        hasher.update(&buffer[..n]);
        if let Some((path, file)) = &mut target {
            file.write_all(&buffer[..n]).map_err(|e| FormatError::io(path, "write", &e))?;
        }
    }
    if let Some((path, file)) = &target {
        file.sync_all().map_err(|e| FormatError::io(path, "write", &e))?;
    }
    Ok(format!("{:x}", hasher.finalize()))
}
