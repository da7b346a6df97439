//! Key frames for COLMAP: chosen, read, and written as pictures with masks.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use glam::DVec2;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ImageEncoder, RgbImage, imageops};
use risorius_formats::{FormatError, FrameIndex, Reporter, Take, Track};

use super::colmap::{ColmapOptions, MaskFace};
use super::picture::Picture;
use super::work::Work;
use super::{keyframes, mask};
use crate::error::{Result, TrackerError};

/// Key frames needed at least.
const FEWEST_KEYS: usize = 8;
/// So many textured places beside the face, and the face is left out.
const TEXTURED: usize = 100;

/// Key frames in memory.
pub struct Keys {
    /// Grey, for patches.
    pub(crate) pictures: BTreeMap<u32, Picture>,
    /// In colour and at the size for COLMAP.
    reduced: BTreeMap<u32, RgbImage>,
    /// Outlines of the faces, pixels, where there are landmarks.
    pub(crate) outlines: BTreeMap<u32, Vec<DVec2>>,
}

/// Chooses and reads the key frames.
pub fn read(take: &Take, track: &Track, options: &ColmapOptions, reporter: &dyn Reporter) -> Result<Keys> {
    let count = options.keyframes.unwrap_or_else(|| keyframes::default_count(&take.frames));
    let keys = keyframes::choose(&take.frames, track, count);
    if keys.len() < FEWEST_KEYS {
        return Err(TrackerError::FewFrames { frames: keys.len() });
    }
    let mut read = Keys { pictures: BTreeMap::new(), reduced: BTreeMap::new(), outlines: outlines(track, &keys) };
    reporter.stage("key frames", Some(keys.len() as u64));
    risorius_video::read_take_frames(take, &keys, |frame, picture| -> Result<()> {
        if reporter.cancelled() {
            return Err(TrackerError::Cancelled { doing: "extracting key frames".into() });
        }
        read.pictures.insert(frame, Picture::new(&picture));
        read.reduced.insert(frame, reduced(picture, options.max_side));
        reporter.advance(1);
        Ok(())
    })?;
    Ok(read)
}

/// Outlines of the faces in the key frames.
fn outlines(track: &Track, keys: &[u32]) -> BTreeMap<u32, Vec<DVec2>> {
    let rows = track.rows.iter().filter(|r| r.success && keys.binary_search(&r.frame.0).is_ok());
    rows.filter_map(|r| Some((r.frame.0, mask::face_outline(r.landmarks.as_deref()?, 1.0)))).collect()
}

/// Whether the face is left out, and why.
pub(super) fn decide_mask(
    mask: MaskFace,
    pictures: &BTreeMap<u32, Picture>,
    outlines: &BTreeMap<u32, Vec<DVec2>>,
) -> (bool, String) {
    match mask {
        MaskFace::On => (true, "features on the face left out, as asked".to_owned()),
        MaskFace::Off => (false, "features on the face used, as asked".to_owned()),
        MaskFace::Auto if outlines.is_empty() => {
            (false, "features everywhere: no key frame has landmarks to mask the face by".to_owned())
        }
        MaskFace::Auto => {
            let outside = mask::texture_outside(pictures, outlines);
            if outside >= TEXTURED {
                (true, format!("features on the moving face left out: {outside} textured places beside it"))
            } else {
                (false, format!("features on the face used: only {outside} textured places beside it"))
            }
        }
    }
}

/// Writes the key frames (and masks) as PNG.
pub(super) fn write(
    keys: &[u32],
    read: &Keys,
    face: &BTreeMap<u32, Vec<DVec2>>,
    masked: bool,
    take: &Take,
    work: &Work,
) -> Result<()> {
    let (pictures, masks) = (work.path("images"), work.path("masks"));
    create_dir(&pictures)?;
    if masked {
        create_dir(&masks)?;
    }
    for frame in keys {
        let Some(picture) = read.reduced.get(frame) else { continue };
        let name = FrameIndex(*frame).image_name();
        write_png(&pictures.join(&name), picture)?;
        if masked {
            let scale = f64::from(picture.width()) / f64::from(take.manifest.width);
            let outline = face.get(frame).map(Vec::as_slice);
            let mask = mask::outside_face(picture.width(), picture.height(), scale, outline);
            let path = masks.join(format!("{name}.png"));
            mask.save(&path).map_err(|e| FormatError::syntax(format!("cannot write: {e}")).in_file(&path))?;
        }
    }
    Ok(())
}

fn reduced(picture: RgbImage, max_side: u32) -> RgbImage {
    let side = picture.width().max(picture.height());
    if side <= max_side {
        return picture;
    }
    let scale = f64::from(max_side) / f64::from(side);
    let to = |n: u32| (f64::from(n) * scale).round().max(1.0) as u32;
    imageops::resize(&picture, to(picture.width()), to(picture.height()), imageops::FilterType::Triangle)
}

fn write_png(path: &Path, picture: &RgbImage) -> Result<()> {
    let io = |e: std::io::Error| FormatError::io(path, "write", &e);
    let file = std::io::BufWriter::new(fs::File::create(path).map_err(io)?);
    PngEncoder::new_with_quality(file, CompressionType::Fast, FilterType::Sub)
        .write_image(picture.as_raw(), picture.width(), picture.height(), image::ExtendedColorType::Rgb8)
        .map_err(|e| FormatError::syntax(format!("cannot write: {e}")).in_file(path).into())
}

pub(super) fn create_dir(dir: &Path) -> Result<()> {
    fs::create_dir_all(dir).map_err(|e| FormatError::io(dir, "create the folder", &e).into())
}
