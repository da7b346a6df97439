//! A folder of images as a video.

use std::cmp::Ordering;
use std::path::{Path, PathBuf};

use image::{DynamicImage, ImageDecoder, ImageReader, RgbImage};
use risorius_formats::FormatError;

use crate::VideoError;

/// The images of a folder, in the natural order of their names.
#[derive(Debug)]
pub(crate) struct ImageFolder {
    files: Vec<PathBuf>,
    next: usize,
    size: (u32, u32),
}

impl ImageFolder {
    pub(crate) fn open(dir: &Path) -> Result<Self, VideoError> {
        let files = list(dir)?;
        let Some(first) = files.first() else {
            return Err(VideoError::EmptyFolder { path: dir.to_owned() });
        };
        let size = load(first)?.dimensions();
        Ok(Self { files, next: 0, size })
    }

    pub(crate) fn size(&self) -> (u32, u32) {
        self.size
    }

    pub(crate) fn len(&self) -> usize {
        self.files.len()
    }

    pub(crate) fn files(&self) -> &[PathBuf] {
        &self.files
    }

    pub(crate) fn skip(&mut self) -> bool {
        let there = self.next < self.files.len();
        self.next += usize::from(there);
        there
    }

    pub(crate) fn next_image(&mut self) -> Result<Option<RgbImage>, VideoError> {
        let Some(path) = self.files.get(self.next) else { return Ok(None) };
        self.next += 1;
        let image = load(path)?;
        if image.dimensions() != self.size {
            return Err(VideoError::SizeChanged { path: path.clone(), expected: self.size, found: image.dimensions() });
        }
        Ok(Some(image))
    }
}

fn list(dir: &Path) -> Result<Vec<PathBuf>, VideoError> {
    let wrap = |e: std::io::Error| FormatError::io(dir, "list the folder", &e);
    let mut files = Vec::new();
    for entry in std::fs::read_dir(dir).map_err(wrap)? {
        let path = entry.map_err(wrap)?.path();
        let hidden = path.file_name().is_none_or(|n| n.as_encoded_bytes().starts_with(b"."));
        let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
        if !hidden && matches!(extension.as_deref(), Some("png" | "jpg" | "jpeg")) && path.is_file() {
            files.push(path);
        }
    }
    files.sort_by(|a, b| natural_order(&name(a), &name(b)));
    Ok(files)
}

fn name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// An image, turned as its EXIF orientation asks.
fn load(path: &Path) -> Result<RgbImage, VideoError> {
    let fail = |message: String| VideoError::Image { path: path.to_owned(), message };
    let reader = ImageReader::open(path).map_err(|e| FormatError::io(path, "open", &e))?;
    let reader = reader.with_guessed_format().map_err(|e| FormatError::io(path, "read", &e))?;
    let mut decoder = reader.into_decoder().map_err(|e| fail(e.to_string()))?;
    let orientation = decoder.orientation().map_err(|e| fail(e.to_string()))?;
    let mut image = DynamicImage::from_decoder(decoder).map_err(|e| fail(e.to_string()))?;
    image.apply_orientation(orientation);
    Ok(image.into_rgb8())
}

/// Orders names as people do: runs of digits by their value, so that `f2` comes before `f10`.
fn natural_order(a: &str, b: &str) -> Ordering {
    let (mut x, mut y) = (a.as_bytes(), b.as_bytes());
    while let (Some(p), Some(q)) = (x.first(), y.first()) {
        let order = if p.is_ascii_digit() && q.is_ascii_digit() {
            let (m, n) = (digits(&mut x), digits(&mut y));
            m.len().cmp(&n.len()).then_with(|| m.cmp(n))
        } else {
            (x, y) = (&x[1..], &y[1..]);
            p.cmp(q)
        };
        if order.is_ne() {
            return order;
        }
    }
    // `f1` and `f01` have the same value: the bytes decide, so that the order is one.
    x.len().cmp(&y.len()).then_with(|| a.cmp(b))
}

/// Takes a run of digits off the front, without its leading zeros.
fn digits<'a>(bytes: &mut &'a [u8]) -> &'a [u8] {
    let end = bytes.iter().position(|b| !b.is_ascii_digit()).unwrap_or(bytes.len());
    let (run, rest) = bytes.split_at(end);
    *bytes = rest;
    &run[run.iter().take_while(|&&b| b == b'0').count()..]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_ordered_as_people_do() {
        let mut names = ["f10.png", "f2.png", "a.png", "f002.png", "f1b.png", "f1.png", "f99999999999999999999999.png"];
        names.sort_by(|a, b| natural_order(a, b));
        assert_eq!(
            names,
            ["a.png", "f1.png", "f1b.png", "f002.png", "f2.png", "f10.png", "f99999999999999999999999.png"]
        );
    }
}
