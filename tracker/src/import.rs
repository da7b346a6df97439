//! A table of OpenFace (or of anything that writes its layout) as the track of a take.
//!
//! Rows belong to frames by their frame number, never by their place in the table: tables lose rows, start late and count
//! differently. The times of the track are those of `frames.csv`; a table's own assume a constant frame rate.

use std::path::{Path, PathBuf};

use risorius_formats::atomic::AtomicDir;
use risorius_formats::openface::{self, FaceChoice, ReadOptions};
use risorius_formats::{FrameIndex, Reporter, TableScale, Take, Track, TrackRow, Warning};
use serde::Serialize;

use crate::error::{Result, TrackerError};
use crate::poses::focal::{TableCamera, table_camera};
use crate::quality::{self, TrackQuality};

/// Rows below this confidence are lost unless told otherwise; OpenFace's own advice.
pub const MIN_CONFIDENCE: f32 = 0.8;

/// What to import and how.
#[derive(Clone, Debug)]
pub struct ImportOptions {
    /// The table.
    pub openface: PathBuf,
    /// The number of the take's first frame in the table; `None` is OpenFace's 1.
    pub first_frame: Option<u32>,
    /// Which face is taken where there are several.
    pub face: FaceChoice,
    /// Rows below this confidence count as lost, 0–1.
    pub min_confidence: f32,
    /// The scale of the table's AU values; `None` lets the values tell.
    pub scale: Option<TableScale>,
}

impl ImportOptions {
    /// The defaults for a table.
    pub fn new(openface: impl Into<PathBuf>) -> Self {
        Self {
            openface: openface.into(),
            first_frame: None,
            face: FaceChoice::default(),
            min_confidence: MIN_CONFIDENCE,
            scale: None,
        }
    }
}

/// What an import found.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ImportSummary {
    /// Rows of the table, one face per frame.
    pub rows: usize,
    /// Rows whose frame number lies beyond the video; left out.
    pub rows_beyond_video: usize,
    /// Frames of the take without a row; lost.
    pub frames_without_row: usize,
    /// Frames whose row had success but too little confidence; lost.
    pub frames_below_confidence: usize,
    /// Quality of what was written.
    pub quality: TrackQuality,
    /// The focal length that the table was made with, pixels, where it holds 3-D landmarks.
    pub table_focal_px: Option<f64>,
}

/// Reads the table, joins it with the take and writes `TAKE/track/`.
pub fn import(take_dir: impl AsRef<Path>, options: &ImportOptions, reporter: &dyn Reporter) -> Result<ImportSummary> {
    let take = Take::open(take_dir)?;
    let read = ReadOptions { first_frame: options.first_frame, face: options.face, scale: options.scale };
    reporter.stage("read the table", None);
    let table = openface::read(&options.openface, &read, reporter)?;
    let rows = table.rows.len();
    let camera = table_camera(&table.rows);
    warn_about_times(&table, &take, reporter);
    let joined = join(table, &take, options.min_confidence);
    joined.report(&take, rows, reporter);
    if joined.track.rows.len() == joined.frames_without_row {
        return Err(TrackerError::NoCommonFrame { path: options.openface.clone(), rows, frames: take.frames.len() });
    }
    let quality = quality::measure(&joined.track, take.frames.len(), 0.0);
    if quality.valid_frames == 0 {
        return Err(TrackerError::NoValidFrame {
            path: options.openface.clone(),
            min_confidence: options.min_confidence,
        });
    }
    warn_about_place(&joined.track, &take, camera.as_ref(), reporter);
    reporter.stage("write the track", None);
    let folder = AtomicDir::create(take.dir.join("track"))?;
    openface::write(folder.path().join("openface.csv"), &joined.track)?;
    crate::parquet::write(folder.path().join("track.parquet"), &joined.track, &take.frames)?;
    folder.commit()?;
    Ok(ImportSummary {
        rows,
        rows_beyond_video: joined.rows_beyond_video,
        frames_without_row: joined.frames_without_row,
        frames_below_confidence: joined.frames_below_confidence,
        quality,
        table_focal_px: camera.map(|c| c.focal_px),
    })
}

/// A track with exactly one row per frame of the take.
struct Joined {
    track: Track,
    rows_beyond_video: usize,
    frames_without_row: usize,
    frames_below_confidence: usize,
}

/// Gives every frame of the take its row by frame number; frames without one get a row without success.
fn join(table: Track, take: &Take, min_confidence: f32) -> Joined {
    let mut slots: Vec<Option<TrackRow>> = vec![None; take.frames.len()];
    let (mut rows_beyond_video, mut frames_below_confidence) = (0, 0);
    for row in table.rows {
        match slots.get_mut(row.frame.0 as usize) {
            Some(slot) => {
                slot.get_or_insert(row);
            }
            None => rows_beyond_video += 1,
        }
    }
    let mut frames_without_row = 0;
    let rows = slots
        .into_iter()
        .zip(&take.frames)
        .map(|(slot, record)| {
            let mut row = slot.unwrap_or_else(|| {
                frames_without_row += 1;
                lost_row(record.index, table.units.len(), table.presence_units.len())
            });
            if row.success && !row.is_valid(min_confidence) {
                frames_below_confidence += 1;
                row.success = false;
            }
            row.timestamp_secs = Some(record.timestamp_nanos as f64 * 1e-9);
            row
        })
        .collect();
    Joined {
        track: Track { units: table.units, presence_units: table.presence_units, rows },
        rows_beyond_video,
        frames_without_row,
        frames_below_confidence,
    }
}

fn lost_row(frame: FrameIndex, units: usize, presence_units: usize) -> TrackRow {
    TrackRow {
        frame,
        face_id: 0,
        timestamp_secs: None,
        confidence: 0.0,
        success: false,
        intensities: vec![None; units],
        presences: vec![None; presence_units],
        landmarks: None,
        landmarks_in_camera_mm: None,
        head_pose: None,
    }
}

impl Joined {
    fn report(&self, take: &Take, rows: usize, reporter: &dyn Reporter) {
        let frames = take.frames.len();
        if self.rows_beyond_video > 0 {
            reporter.warn(Warning::new(
                "rows-beyond-video",
                format!(
                    "{} of {rows} rows lie beyond the take's {frames} frames and were left out; is this the table of another video?",
                    self.rows_beyond_video
                ),
            ));
        }
        if self.frames_without_row > 0 {
            let missing = quality::runs(
                self.track
                    .rows
                    .iter()
                    .filter(|r| r.confidence == 0.0 && !r.success && r.landmarks.is_none())
                    .map(|r| r.frame.0),
            );
            let longest = missing
                .iter()
                .max_by_key(|r| r[1] - r[0])
                .map_or(String::new(), |r| format!(" (longest run: {}–{})", r[0], r[1]));
            let advice = if self.frames_without_row * 10 > frames {
                "; is this the table of another or a shorter video?"
            } else {
                ""
            };
            reporter.warn(Warning::new(
                "frames-without-row",
                format!(
                    "{} of {frames} frames have no row and count as lost{longest}{advice}",
                    self.frames_without_row
                ),
            ));
        }
    }
}

/// Tables tell their frame rate by their time column.
fn warn_about_times(table: &Track, take: &Take, reporter: &dyn Reporter) {
    let timed: Vec<(f64, f64)> =
        table.rows.iter().filter_map(|r| r.timestamp_secs.map(|t| (f64::from(r.frame.0), t))).collect();
    let (Some(first), Some(last)) = (timed.first(), timed.last()) else { return };
    let secs = last.1 - first.1;
    let fps = (last.0 - first.0) / secs;
    let own = take.fps();
    if secs > 0.2 && own > 0.0 && (fps / own - 1.0).abs() > 0.1 {
        reporter.warn(Warning::new(
            "frame-rate",
            format!(
                "the table's times mean {fps:.1} frames/s, the take has {own:.1}; rows were joined by frame number, which is wrong if the table was made from a re-timed copy"
            ),
        ));
    }
}

/// Tables of a turned, scaled or other video put the face where it cannot be.
fn warn_about_place(track: &Track, take: &Take, camera: Option<&TableCamera>, reporter: &dyn Reporter) {
    let (width, height) = (f64::from(take.manifest.width), f64::from(take.manifest.height));
    let points: Vec<[f64; 2]> = track
        .rows
        .iter()
        .filter(|r| r.success)
        .filter_map(|r| r.landmarks.as_ref())
        .flat_map(|l| l.points_px.iter().map(|p| p.map(f64::from)))
        .collect();
    if points.is_empty() {
        reporter.warn(Warning::new(
            "no-landmarks",
            "the table has no landmarks (`x_0` … `y_67`): AUs can be used, but poses and region masks need landmarks",
        ));
        return;
    }
    // Faces may hang over the edge a little: a tenth of the picture is allowed.
    let inside = |w: f64, h: f64| {
        let fits = |p: &&[f64; 2]| (-0.1 * w..=1.1 * w).contains(&p[0]) && (-0.1 * h..=1.1 * h).contains(&p[1]);
        points.iter().filter(fits).count() as f64 / points.len() as f64
    };
    let share = inside(width, height);
    if share < 0.9 {
        let turned = inside(height, width) > 0.99;
        let guess =
            if turned { "it fits a picture turned by 90°" } else { "is it the table of another or a larger video?" };
        reporter.warn(Warning::new(
            "landmarks-outside",
            format!(
                "{:.0} % of the landmarks lie outside the take's {width}×{height} picture; {guess}",
                100.0 * (1.0 - share)
            ),
        ));
    } else if let Some(c) = camera
        && ((c.cx / width - 0.5).abs() > 0.05 || (c.cy / height - 0.5).abs() > 0.05)
    {
        reporter.warn(Warning::new(
            "other-picture-size",
            format!(
                "the table's 2-D and 3-D landmarks belong to a picture with its middle at ({:.0}, {:.0}), about {:.0}×{:.0}, but the take is {width}×{height}",
                c.cx,
                c.cy,
                2.0 * c.cx,
                2.0 * c.cy
            ),
        ));
    }
}

#[cfg(test)]
#[path = "import_tests.rs"]
mod tests;
