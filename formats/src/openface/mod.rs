//! OpenFace CSV tables of every version: read with all their oddities, written as OpenFace 2.2 does.
//!
//! Columns are found by name, so that tables of 1.x (no `face_id`), of AUs only, of single images (`face` instead of
//! `frame`) and tables with other tools' columns all read. Pixels and frame numbers are converted (see the crate's
//! conventions). What cannot be trusted is `None`: everything in rows with `success` 0, and cells that hold no number.
//!
//! Separators, decimal commas and other scales are converted (see `dialect`, `table_scale`), or refused where they cannot be.
//!
//! Recovered with a warning: a last row that is cut off (left out), intensities below 0 or above 5 (clamped: OpenFace
//! itself clamps them at the end of a run, so they tell of a killed one), a `frame` column that is stuck at 0 or
//! repeats without `face_id` (rows are numbered by their order, and only then), several faces in a frame.

mod faces;
mod frames;
mod header;
mod read;
mod write;

use std::path::Path;

use glam::DVec3;

use crate::{Reporter, Result, TableScale, Track};

/// Which face of a frame with several is taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum FaceChoice {
    /// The one that is largest in the first frame with a face, then followed by its place (ids are not stable).
    #[default]
    Largest,
    /// The first row of each frame.
    First,
}

/// How to read a table. The default is for tables of our own, [`ReadOptions::foreign`] for others.
#[derive(Clone, Copy, Debug)]
pub struct ReadOptions {
    /// The number of the take's first frame in the `frame` column; `None` is OpenFace's 1.
    pub first_frame: Option<u32>,
    /// Which face is taken where there are several.
    pub face: FaceChoice,
    /// The scale of the AU values; `None` lets the values tell.
    pub scale: Option<TableScale>,
}

impl Default for ReadOptions {
    fn default() -> Self {
        Self { first_frame: None, face: FaceChoice::default(), scale: Some(TableScale::Five) }
    }
}

impl ReadOptions {
    /// For a table that anything may have written: its values tell their scale.
    pub fn foreign() -> Self {
        Self { scale: None, ..Self::default() }
    }
}

/// Parses a table of any OpenFace version: one row per frame, in the order of frames.
///
/// AUs whose column holds no number at all are left out of the track.
pub fn parse(bytes: &[u8], options: &ReadOptions, reporter: &dyn Reporter) -> Result<Track> {
    read::parse(bytes, options, reporter)
}

/// Reads a table of any OpenFace version.
pub fn read(path: impl AsRef<Path>, options: &ReadOptions, reporter: &dyn Reporter) -> Result<Track> {
    let path = path.as_ref();
    let bytes = std::fs::read(path).map_err(|e| crate::FormatError::io(path, "read", &e))?;
    parse(&bytes, options, reporter).map_err(|e| e.in_file(path))
}

/// Eye landmarks of a table: 8 of the iris, 12 of the lids, 8 of the pupil; the eye on the image's left first.
pub const EYE_LANDMARKS: usize = 56;

/// Gaze and eye landmarks of one row, which a [`Track`] does not hold.
#[derive(Clone, Copy, Debug)]
pub struct Eyes<'a> {
    /// Unit vectors in camera axes (x right, y down, z away), the eye on the image's left first.
    pub directions: [DVec3; 2],
    /// Radians, of both eyes together: positive to the image's right, positive down.
    pub angles: [f64; 2],
    /// Pixels, the centre of the first pixel at 0.5.
    pub landmarks_px: &'a [[f32; 2]; EYE_LANDMARKS],
    /// Millimetres in camera space; those that are missing are written as 0.
    pub landmarks_mm: &'a [[f32; 3]],
}

/// The bytes of an OpenFace 2.2 table with its 714 columns; AUs that OpenFace does not have follow the last of them.
///
/// Gaze, eye landmarks and shape parameters, which a track does not hold, are 0, and so is all of a row without
/// success, as in OpenFace's own tables. A value that is missing in a row with success is `nan`, which reads back as
/// missing; 0 would read back as a measurement.
pub fn to_bytes(track: &Track) -> Result<Vec<u8>> {
    write::to_bytes(track, &[])
}

/// The same with the gaze and eye landmarks of each row; rows that `eyes` does not reach have none.
pub fn to_bytes_with_eyes(track: &Track, eyes: &[Option<Eyes<'_>>]) -> Result<Vec<u8>> {
    write::to_bytes(track, eyes)
}

/// Writes an OpenFace 2.2 table, whole or not at all.
pub fn write(path: impl AsRef<Path>, track: &Track) -> Result<()> {
    crate::atomic::write_file(path, &to_bytes(track)?)
}

#[cfg(test)]
#[path = "tests.rs"]
mod tests;
