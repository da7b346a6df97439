//! From what was seen to the rows of the track: interpolation, AUs, head pose, and the files.

use std::fs::File;
use std::io::{BufWriter, Write as _};
use std::path::Path;

use glam::{DMat3, DVec2, DVec3};
use risorius_formats::au::OPENFACE_INTENSITIES;
use risorius_formats::track::HeadPose;
use risorius_formats::{FormatError, FrameIndex, Isometry, Landmarks68, Reporter, Take, Track, TrackRow, openface};

use super::between::{Interpolator, Smoothed};
use super::observations::{Observation, Recording};
use crate::aus::openface::clip::ClipAus;
use crate::aus::{FEATURES, PITCH, Person};
use crate::error::{Result, TrackerError};
use crate::gaze::{EYE_LANDMARKS, Gaze, Gazer};
use crate::head_pose::Lens;
use crate::head_pose::shape::{self, PersonShape};
use crate::models::manifest::AuModel;
use crate::parquet::{self, Extra};
use crate::quality::{QualityMeter, TrackQuality};

/// Everything that is known when rows are written.
pub struct Writer<'a> {
    /// The take.
    pub take: &'a Take,
    /// What is known of camera and person.
    pub maker: RowMaker,
    /// Every how many frames the networks ran.
    pub every: u32,
    /// Whether scores are means of three frames, which needs the frame after.
    pub smooth: bool,
}

/// Makes rows of what was seen.
pub struct RowMaker {
    /// The camera.
    pub lens: Lens,
    /// The person's resting shape.
    pub shape: PersonShape,
    /// The person's resting scores, where there are scores.
    pub person: Option<Person>,
    /// The AU network whose intensities were seen, in their place.
    pub au_model: Option<AuModel>,
    /// The AUs of OpenFace's models, where they take the person's place.
    pub clip: Option<ClipAus>,
    /// The person's eyes.
    pub eyes: Gazer,
    /// The pose of the row before.
    pub before: Option<Isometry>,
    /// How far the mesh's pitch is from the pose's, mean and number of the rows before.
    pub pitch_apart: (f64, usize),
}

/// What was written.
#[derive(Clone, Debug, PartialEq)]
pub struct Written {
    /// Frames that were interpolated.
    pub interpolated: usize,
    /// The track's quality.
    pub quality: TrackQuality,
}

impl Writer<'_> {
    /// Writes `openface.csv` and `track.parquet` into `dir`.
    pub fn write(mut self, recording: &Recording, dir: &Path, reporter: &dyn Reporter) -> Result<Written> {
        let units = OPENFACE_INTENSITIES.to_vec();
        let mut csv = CsvWriter::create(&dir.join("openface.csv"))?;
        let mut table = parquet::Writer::create(dir.join("track.parquet"), &units, &units)?;
        let mut meter = QualityMeter::new(&units, self.take.frames.len());
        let mut interpolated = 0;
        let mut batch: Vec<(TrackRow, Extra)> = Vec::new();
        let take = self.take;
        let between = Interpolator::new(recording.read()?, self.every, take.frames.len());
        let mut observations = Smoothed::new(between, if self.smooth { FEATURES } else { 0 });
        for record in &take.frames {
            let (observation, is_between) = observations.next_frame()?;
            let (row, mut extra) =
                self.maker.row(record.index, record.timestamp_nanos as f64 * 1e-9, observation.as_ref());
            interpolated += usize::from(is_between && row.success);
            extra.interpolated = is_between;
            batch.push((row, extra));
            let done = record.index.0 as usize + 1;
            if batch.len() == parquet::ROWS_PER_GROUP || done == take.frames.len() {
                if reporter.cancelled() {
                    return Err(TrackerError::Cancelled { doing: "writing the track".to_owned() });
                }
                let (rows, extras): (Vec<TrackRow>, Vec<Extra>) = batch.drain(..).unzip();
                let frames = &take.frames[done - rows.len()..done];
                table.push(&rows.iter().map(Some).collect::<Vec<_>>(), frames, &extras)?;
                for (row, extra) in rows.iter().zip(&extras) {
                    meter.push(row, extra.au_confidences.as_ref());
                }
                let track = Track { units: units.clone(), presence_units: units.clone(), rows };
                csv.push(&track, &extras)?;
            }
        }
        csv.finish()?;
        table.finish()?;
        Ok(Written { interpolated, quality: meter.finish() })
    }
}

impl RowMaker {
    /// The row of the frame after that of the call before.
    pub fn row(&mut self, frame: FrameIndex, timestamp_secs: f64, seen: Option<&Observation>) -> (TrackRow, Extra) {
        let count = OPENFACE_INTENSITIES.len();
        let mut row = TrackRow {
            frame,
            face_id: 0,
            timestamp_secs: Some(timestamp_secs),
            confidence: 0.0,
            success: false,
            intensities: vec![None; count],
            presences: vec![None; count],
            landmarks: None,
            landmarks_in_camera_mm: None,
            head_pose: None,
        };
        let mut extra = Extra::default();
        let Some(seen) = seen else {
            self.before = None;
            return (row, extra);
        };
        row.success = true;
        row.confidence = seen.presence.clamp(0.0, 1.0);
        if let Some(units) = self.person.as_mut().and_then(|p| p.units(&seen.features)) {
            row.intensities = units.intensities.iter().map(|v| Some(*v)).collect();
            row.presences = units.presences.iter().map(|v| Some(*v)).collect();
            extra.au_confidences = Some(units.confidences.map(|c| c * row.confidence));
        }
        if let Some(model) = self.au_model.as_ref().filter(|m| m.units.len() == seen.features.len()) {
            for (slot, unit) in OPENFACE_INTENSITIES.iter().enumerate() {
                if let Some(i) = model.units.iter().position(|u| u == unit) {
                    row.intensities[slot] = Some(seen.features[i]);
                    row.presences[slot] = Some(seen.features[i] >= model.present_from);
                }
            }
        }
        if let Some(aus) = self.clip.as_ref().and_then(|clip| clip.get(frame.0 as usize)) {
            row.intensities = aus.intensities.to_vec();
            row.presences = aus.presences.to_vec();
        }
        self.place(&mut row, &mut extra, seen);
        row.landmarks = Some(Box::new(Landmarks68 { points_px: seen.points_px }));
        (row, extra)
    }

    /// Adds what the head's pose tells.
    fn place(&mut self, row: &mut TrackRow, extra: &mut Extra, seen: &Observation) {
        let normalised: Vec<DVec2> = seen.points_px.iter().map(|p| self.lens.normalised(*p)).collect();
        // Warm from the frame before, and cold where that led nowhere.
        let found = shape::pose(&self.shape.points, &normalised, self.before.as_ref())
            .filter(|(_, error)| *error < 3.0 * self.shape.error + 1e-3)
            .or_else(|| shape::pose(&self.shape.points, &normalised, None));
        self.before = found.map(|f| f.0);
        if let Some(pose) = self.before {
            row.head_pose = Some(HeadPose::from_isometry(&pose));
            row.landmarks_in_camera_mm = Some(Box::new(std::array::from_fn(|i| {
                // On the ray of the point that was seen, as deep as the shape has it.
                let depth = pose.transform_point(self.shape.points[i]).z;
                let point: DVec3 = normalised[i].extend(1.0) * depth;
                [point.x as f32, point.y as f32, point.z as f32]
            })));
            extra.gaze = seen.eyes.as_ref().map(|eyes| {
                let camera_from_head = self.steadied(&pose, &seen.features);
                let mut gaze = self.eyes.gaze(eyes, &camera_from_head);
                let on_ray = |i: usize, p: &[f32; 2]| {
                    let corners = if i < EYE_LANDMARKS / 2 { [36, 39] } else { [42, 45] };
                    let depth = corners.map(|k| pose.transform_point(self.shape.points[k]).z).iter().sum::<f64>() / 2.0;
                    (self.lens.normalised(*p).extend(1.0) * depth).as_vec3().to_array()
                };
                gaze.landmarks_mm = gaze.landmarks_px.iter().enumerate().map(|(i, p)| on_ray(i, p)).collect();
                gaze
            });
        }
    }

    /// The head's rotation for the gaze: its pitch moves as the mean of the pose's and the mesh's, whose noise differs.
    fn steadied(&mut self, pose: &Isometry, features: &[f32]) -> DMat3 {
        let mut head = HeadPose::from_isometry(pose);
        if features.len() >= FEATURES {
            let apart = f64::from(features[PITCH]) - head.rotation_rad.x;
            let (mean, rows) = &mut self.pitch_apart;
            *rows += 1;
            *mean += (apart - *mean) / *rows as f64;
            head.rotation_rad.x += 0.5 * (apart - *mean);
        }
        head.camera_from_head().rotation
    }
}

/// An OpenFace table that is written piece by piece.
struct CsvWriter {
    path: std::path::PathBuf,
    file: BufWriter<File>,
    pieces: Pieces,
}

/// Pieces of one OpenFace table: the first has the header.
#[derive(Default)]
pub struct Pieces {
    has_header: bool,
}

impl Pieces {
    /// Some rows as lines.
    pub fn lines(&mut self, piece: &Track, extras: &[Extra]) -> Result<Vec<u8>> {
        let eyes: Vec<_> = extras.iter().map(|e| e.gaze.as_ref().map(Gaze::eyes)).collect();
        let bytes = openface::to_bytes_with_eyes(piece, &eyes)?;
        let (header, rows) = bytes.split_at(bytes.iter().position(|b| *b == b'\n').map_or(0, |at| at + 1));
        let mut lines = if self.has_header { Vec::new() } else { header.to_vec() };
        lines.extend_from_slice(rows);
        self.has_header = true;
        Ok(lines)
    }
}

impl CsvWriter {
    fn create(path: &Path) -> Result<Self> {
        let file = File::create(path).map_err(|e| FormatError::io(path, "create", &e))?;
        Ok(Self { path: path.to_owned(), file: BufWriter::with_capacity(1 << 18, file), pieces: Pieces::default() })
    }

    /// Appends rows. Pieces are small: the encoder makes one text of all rows it gets.
    fn push(&mut self, track: &Track, extras: &[Extra]) -> Result<()> {
        for (rows, extras) in track.rows.chunks(256).zip(extras.chunks(256)) {
            let piece =
                Track { units: track.units.clone(), presence_units: track.presence_units.clone(), rows: rows.to_vec() };
            let lines = self.pieces.lines(&piece, extras)?;
            self.file.write_all(&lines).map_err(|e| FormatError::io(&self.path, "write", &e))?;
        }
        Ok(())
    }

    fn finish(mut self) -> Result<()> {
        Ok(self.file.flush().map_err(|e| FormatError::io(&self.path, "write", &e))?)
    }
}
