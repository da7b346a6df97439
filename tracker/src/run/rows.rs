//! From what was seen to the rows of the track: interpolation, AUs, head pose, and the files.

use std::fs::File;
use std::io::{BufWriter, Write as _};
use std::path::Path;

use glam::{DVec2, DVec3};
use risorius_formats::au::OPENFACE_INTENSITIES;
use risorius_formats::track::HeadPose;
use risorius_formats::{FormatError, FrameIndex, Isometry, Landmarks68, Reporter, Take, Track, TrackRow, openface};

use super::observations::{Observation, Recording};
use crate::aus::Person;
use crate::error::{Result, TrackerError};
use crate::head_pose::Lens;
use crate::head_pose::shape::{self, PersonShape};
use crate::models::manifest::AuModel;
use crate::parquet;
use crate::quality::{QualityMeter, TrackQuality};

/// Everything that is known when rows are written.
pub struct Writer<'a> {
    /// The take.
    pub take: &'a Take,
    /// What is known of camera and person.
    pub maker: RowMaker,
    /// Every how many frames the networks ran.
    pub every: u32,
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
    /// The pose of the row before.
    pub before: Option<Isometry>,
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
        let mut batch: Vec<(TrackRow, bool)> = Vec::new();
        let take = self.take;
        let mut between = Interpolator::new(recording.read()?, self.every, take.frames.len());
        for record in &take.frames {
            let (observation, is_between) = between.next_frame()?;
            let row = self.maker.row(record.index, record.timestamp_nanos as f64 * 1e-9, observation.as_ref());
            interpolated += usize::from(is_between && row.success);
            batch.push((row, is_between));
            let done = record.index.0 as usize + 1;
            if batch.len() == parquet::ROWS_PER_GROUP || done == take.frames.len() {
                if reporter.cancelled() {
                    return Err(TrackerError::Cancelled { doing: "writing the track".to_owned() });
                }
                let (rows, flags): (Vec<TrackRow>, Vec<bool>) = batch.drain(..).unzip();
                let frames = &take.frames[done - rows.len()..done];
                table.push(&rows.iter().map(Some).collect::<Vec<_>>(), frames, &flags)?;
                for row in &rows {
                    meter.push(row);
                }
                let track = Track { units: units.clone(), presence_units: units.clone(), rows };
                csv.push(&track)?;
            }
        }
        csv.finish()?;
        table.finish()?;
        Ok(Written { interpolated, quality: meter.finish() })
    }
}

impl RowMaker {
    /// The row of the frame after that of the call before.
    pub fn row(&mut self, frame: FrameIndex, timestamp_secs: f64, seen: Option<&Observation>) -> TrackRow {
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
        let Some(seen) = seen else {
            self.before = None;
            return row;
        };
        row.success = true;
        row.confidence = seen.presence.clamp(0.0, 1.0);
        if let Some(units) = self.person.as_mut().and_then(|p| p.units(&seen.features)) {
            row.intensities = units.intensities.iter().map(|v| Some(*v)).collect();
            row.presences = units.presences.iter().map(|v| Some(*v)).collect();
        }
        if let Some(model) = self.au_model.as_ref().filter(|m| m.units.len() == seen.features.len()) {
            for (slot, unit) in OPENFACE_INTENSITIES.iter().enumerate() {
                if let Some(i) = model.units.iter().position(|u| u == unit) {
                    row.intensities[slot] = Some(seen.features[i]);
                    row.presences[slot] = Some(seen.features[i] >= model.present_from);
                }
            }
        }
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
        }
        row.landmarks = Some(Box::new(Landmarks68 { points_px: seen.points_px }));
        row
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
    pub fn lines(&mut self, piece: &Track) -> Result<Vec<u8>> {
        let mut bytes = openface::to_bytes(piece)?;
        if self.has_header {
            let start = bytes.iter().position(|b| *b == b'\n').map_or(0, |at| at + 1);
            bytes.drain(..start);
        }
        self.has_header = true;
        Ok(bytes)
    }
}

impl CsvWriter {
    fn create(path: &Path) -> Result<Self> {
        let file = File::create(path).map_err(|e| FormatError::io(path, "create", &e))?;
        Ok(Self { path: path.to_owned(), file: BufWriter::with_capacity(1 << 18, file), pieces: Pieces::default() })
    }

    /// Appends rows. Pieces are small: the encoder makes one text of all rows it gets.
    fn push(&mut self, track: &Track) -> Result<()> {
        for rows in track.rows.chunks(256) {
            let piece =
                Track { units: track.units.clone(), presence_units: track.presence_units.clone(), rows: rows.to_vec() };
            let lines = self.pieces.lines(&piece)?;
            self.file.write_all(&lines).map_err(|e| FormatError::io(&self.path, "write", &e))?;
        }
        Ok(())
    }

    fn finish(mut self) -> Result<()> {
        Ok(self.file.flush().map_err(|e| FormatError::io(&self.path, "write", &e))?)
    }
}

/// Gives every frame its observation: that of its own, or one between its tracked neighbours.
struct Interpolator<I> {
    source: I,
    every: usize,
    frames: usize,
    next: usize,
    /// Tracked frames around the current one: number and observation, two before and two after.
    around: [Option<(usize, Option<Observation>)>; 4],
}

impl<I: Iterator<Item = Result<Option<Observation>>>> Interpolator<I> {
    fn new(source: I, every: u32, frames: usize) -> Self {
        Self { source, every: every.max(1) as usize, frames, next: 0, around: [None, None, None, None] }
    }

    /// The observation of the next frame, and whether it was made from others.
    fn next_frame(&mut self) -> Result<(Option<Observation>, bool)> {
        let frame = self.next;
        self.next += 1;
        if self.every == 1 {
            return Ok((self.source.next().transpose()?.flatten(), false));
        }
        if frame == 0 {
            for slot in 1..4 {
                self.around[slot] = self.pull(slot - 1)?;
            }
        }
        while self.around[2].as_ref().is_some_and(|(at, _)| *at <= frame) {
            self.around.rotate_left(1);
            let after = self.around[2].as_ref().map_or(self.frames, |(at, _)| at / self.every + 1);
            self.around[3] = self.pull(after)?;
        }
        let Some((at, here)) = &self.around[1] else { return Ok((None, true)) };
        if *at == frame {
            return Ok((here.clone(), false));
        }
        let known = |slot: usize| {
            let (at, observation) = self.around[slot].as_ref()?;
            Some((*at as f32, observation.as_ref()?))
        };
        // A face that was seen on one side only may have gone anywhere.
        let (Some(left), Some(right)) = (known(1), known(2)) else { return Ok((None, true)) };
        Ok((Some(between(known(0), left, right, known(3), frame as f32)), true))
    }

    /// The tracked frame with the number `order` among the tracked ones.
    fn pull(&mut self, order: usize) -> Result<Option<(usize, Option<Observation>)>> {
        let at = (order * self.every).min(self.frames.saturating_sub(1));
        Ok(match self.source.next() {
            Some(observation) => Some((at, observation?)),
            None => None,
        })
    }
}

type At<'a> = (f32, &'a Observation);

/// A cubic through two tracked frames with the slopes that their neighbours suggest (Catmull–Rom for uneven spacing);
/// where a neighbour is missing the slope is that of the chord.
fn between(before: Option<At>, left: At, right: At, after: Option<At>, frame: f32) -> Observation {
    let length = right.0 - left.0;
    let u = (frame - left.0) / length;
    let value = |get: &dyn Fn(&Observation) -> f32| {
        let (a, b) = (get(left.1), get(right.1));
        let slope_a = before.map_or(b - a, |(at, o)| (b - get(o)) / (right.0 - at) * length);
        let slope_b = after.map_or(b - a, |(at, o)| (get(o) - a) / (at - left.0) * length);
        let (u2, u3) = (u * u, u * u * u);
        (2.0 * u3 - 3.0 * u2 + 1.0) * a
            + (u3 - 2.0 * u2 + u) * slope_a
            + (3.0 * u2 - 2.0 * u3) * b
            + (u3 - u2) * slope_b
    };
    let features = left.1.features.len().min(right.1.features.len());
    Observation {
        points_px: std::array::from_fn(|i| [0, 1].map(|axis| value(&|o| o.points_px[i][axis]))),
        presence: left.1.presence.min(right.1.presence),
        features: (0..features).map(|k| value(&|o| o.features.get(k).copied().unwrap_or(left.1.features[k]))).collect(),
    }
}

#[cfg(test)]
#[path = "rows_tests.rs"]
mod tests;
