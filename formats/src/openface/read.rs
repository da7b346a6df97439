//! Reading the rows of a table, and what is done about the damage that real ones show.

use glam::DVec3;

use super::ReadOptions;
use super::frames::{choose_faces, number_frames};
use super::header::{self, Columns, cell};
use crate::au::MAX_INTENSITY;
use crate::error::shown;
use crate::table_scale::{self, Judged, Values};
use crate::track::HeadPose;
use crate::{
    ActionUnit, ErrorKind, FormatError, FrameIndex, Landmarks68, Reporter, Result, TableScale, Track, TrackRow,
    Warning, dialect,
};

/// What to do about a row that cannot be used.
const BAD_ROW: &str = "correct or remove this row, or run OpenFace's FeatureExtraction again";

/// How many bytes are looked at for signs of a file that is no text.
const SNIFFED: usize = 4096;

/// What went wrong and was recovered; told once per sort, with a count and the first line.
#[derive(Clone, Default)]
struct Trouble {
    count: u64,
    first: usize,
}

impl Trouble {
    fn add(&mut self, start: usize) {
        if self.count == 0 {
            self.first = start;
        }
        self.count += 1;
    }

    fn tell(&self, bytes: &[u8], reporter: &dyn Reporter, kind: &'static str, what: &str) {
        if self.count > 0 {
            let (count, first_line) = (self.count, line_at(bytes, self.first));
            reporter.warn(Warning::new(kind, format!("{count} {what} (first in line {first_line})")));
        }
    }
}

#[derive(Default)]
struct Troubles {
    negative: Trouble,
    above: Trouble,
    missing_intensity: Vec<Trouble>,
    missing_point: Trouble,
}

/// One row of the file as it stands.
pub(super) struct RawRow {
    /// Byte offset of its start; lines are counted only when somebody asks.
    pub(super) start: usize,
    pub(super) number: u32,
    pub(super) row: TrackRow,
}

pub(super) struct Parser<'a> {
    pub(super) bytes: &'a [u8],
    pub(super) columns: Columns,
    troubles: Troubles,
    values: Values,
    /// Row (byte offset) and column of the first value that is off the scale.
    off_scale: Option<(usize, usize)>,
}

/// Parses a table; see [`super::parse`].
pub(super) fn parse(bytes: &[u8], options: &ReadOptions, reporter: &dyn Reporter) -> Result<Track> {
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    if bytes.trim_ascii().is_empty() {
        return Err(FormatError::new(ErrorKind::Empty, "the table is empty")
            .with_hint("run OpenFace's FeatureExtraction again"));
    }
    let no_text = |at: usize| FormatError::syntax("is not a text table").at_line(line_at(bytes, at));
    if bytes.starts_with(b"\xff\xfe") || bytes.starts_with(b"\xfe\xff") {
        return Err(no_text(0).with_hint("it is saved as UTF-16; save it as UTF-8"));
    }
    // No text holds a zero byte, and nearly every other file does.
    if let Some(at) = bytes.iter().take(SNIFFED).position(|&b| b == 0) {
        return Err(no_text(at).with_hint(header::EXPECTED));
    }
    let (converted, what) = dialect::with_commas(bytes);
    if let Some(what) = what {
        reporter.warn(Warning::new("other-separators", format!("{what}; both were converted")));
    }
    let bytes = &*converted;
    // Quotes are stripped per cell: a stray one must not swallow the lines after it.
    let mut reader = csv::ReaderBuilder::new().has_headers(false).flexible(true).quoting(false).from_reader(bytes);
    let mut record = csv::ByteRecord::new();
    let broken = |e: csv::Error| FormatError::syntax(format!("cannot be read as a table: {e}"));
    reader.read_byte_record(&mut record).map_err(broken)?;
    let header_line = line_at(bytes, start_of(&record));
    let columns = Columns::parse(record.iter()).map_err(|e| e.at_line(header_line))?;

    let missing_intensity = vec![Trouble::default(); columns.intensities.len()];
    let troubles = Troubles { missing_intensity, ..Troubles::default() };
    let mut parser = Parser { bytes, columns, troubles, values: Values::default(), off_scale: None };
    let mut rows: Vec<RawRow> = Vec::new();
    let mut more = reader.read_byte_record(&mut record).map_err(broken)?;
    let mut next = csv::ByteRecord::new();
    while more {
        more = reader.read_byte_record(&mut next).map_err(broken)?;
        match parser.row(&record) {
            Ok(row) => rows.push(row),
            Err(e) if !more && parser.is_cut_off(&record) => {
                let line = line_at(bytes, start_of(&record));
                let message = format!("line {line}: the last row is cut off and left out; was the run killed? ({e})");
                reporter.warn(Warning::new("truncated-row", message));
            }
            Err(e) => return Err(e.at_line(line_at(bytes, start_of(&record))).or_hint(BAD_ROW)),
        }
        std::mem::swap(&mut record, &mut next);
    }
    if rows.is_empty() {
        return Err(FormatError::new(ErrorKind::Empty, "the table has a header but no rows")
            .with_hint("OpenFace found no frames; check its input video"));
    }
    parser.scale(&mut rows, options.scale, reporter)?;
    parser.tell(&rows, reporter);
    let frames = number_frames(rows, &parser, options, reporter)?;
    Ok(parser.into_track(choose_faces(frames, options.face, reporter)))
}

/// The byte offset where the reader began to look for a record.
fn start_of(record: &csv::ByteRecord) -> usize {
    record.position().map_or(0, |p| p.byte() as usize)
}

/// The 1-based line of the record at `start`. The reader's own count is behind after `\r\n` and blank lines.
pub(super) fn line_at(bytes: &[u8], start: usize) -> u64 {
    let start = start.min(bytes.len());
    let blank = bytes[start..].iter().take_while(|b| matches!(b, b'\r' | b'\n')).count();
    bytes[..start + blank].split(|&b| b == b'\n').count() as u64
}

/// A number; `None` for a cell that says there is none (blank, `nan`, Windows' `1.#QNAN`).
fn number(raw: &[u8]) -> Result<Option<f64>, ()> {
    let text = cell(raw);
    if let Ok(value) = fast_float2::parse::<f64, _>(text) {
        // Also what is too large for the 32 bits it is kept in.
        return Ok(Some(value).filter(|v| v.abs() <= f64::from(f32::MAX)));
    }
    let text = text.to_ascii_lowercase();
    let unsigned = text.strip_prefix(b"-").unwrap_or(&text);
    let none = text.is_empty() || text == b"na" || unsigned.starts_with(b"nan") || unsigned.starts_with(b"1.#");
    if none { Ok(None) } else { Err(()) }
}

impl Parser<'_> {
    fn bad_cell(&self, column: usize, raw: &[u8], expected: &str) -> FormatError {
        let found = shown(cell(raw));
        FormatError::syntax(format!("expected {expected}, found {found}")).in_column(self.columns.name(column))
    }

    fn number(&self, record: &csv::ByteRecord, column: usize, expected: &str) -> Result<Option<f64>> {
        let raw = record.get(column).unwrap_or_default();
        number(raw).map_err(|()| self.bad_cell(column, raw, expected))
    }

    /// Whole numbers also come as `12.0`, from tools that rewrote the table.
    fn whole(&self, record: &csv::ByteRecord, column: usize) -> Result<u32> {
        let expected = "a whole number from 0";
        match self.number(record, column, expected)? {
            Some(v) if v >= 0.0 && v < f64::from(u32::MAX) && v.fract() == 0.0 => Ok(v as u32),
            _ => Err(self.bad_cell(column, record.get(column).unwrap_or_default(), expected)),
        }
    }

    /// All numbers of a group; `None` where one of them is missing, which is trouble unless all are.
    fn group<const N: usize>(&mut self, record: &csv::ByteRecord, columns: &[usize]) -> Result<Option<[f64; N]>> {
        let mut out = [0.0; N];
        let mut missing = 0;
        for (value, &column) in out.iter_mut().zip(columns) {
            match self.number(record, column, "a number")? {
                Some(v) => *value = v,
                None => missing += 1,
            }
        }
        if missing > 0 && missing < N {
            self.troubles.missing_point.add(start_of(record));
        }
        Ok((missing == 0).then_some(out))
    }

    fn row(&mut self, record: &csv::ByteRecord) -> Result<RawRow> {
        let width = self.columns.names.len();
        let too_many = record.iter().skip(width).any(|raw| !cell(raw).is_empty());
        if record.len() < width || too_many {
            if let Some(error) = dialect::decimal_commas(width, record.len(), record.iter()) {
                return Err(error);
            }
            return Err(FormatError::syntax(format!("expected {width} columns, found {}", record.len()))
                .with_hint("the table may be cut off, or two tables may have been pasted together"));
        }
        let number = self.columns.frame.map_or(Ok(0), |c| self.whole(record, c))?;
        let face_id = self.columns.face_id.map_or(Ok(0), |c| self.whole(record, c))?;
        let timestamp_secs = match self.columns.timestamp {
            Some(c) => self.number(record, c, "a time in seconds")?,
            None => None,
        };
        let confidence = self.number(record, self.columns.confidence, "a number from 0 to 1")?.unwrap_or(0.0) as f32;
        let success = match self.columns.success {
            Some(c) => self.number(record, c, "`0` or `1`")?.is_some_and(|v| v > 0.5),
            None => true,
        };
        let mut row = TrackRow {
            frame: FrameIndex(number),
            face_id,
            timestamp_secs,
            confidence,
            success,
            intensities: vec![None; self.columns.intensities.len()],
            presences: vec![None; self.columns.presences.len()],
            landmarks: None,
            landmarks_in_camera_mm: None,
            head_pose: None,
        };
        self.values.confidence = self.values.confidence.max(confidence);
        // OpenFace fills rows without success with zeros or with its last guess; both are no measurement.
        if success {
            self.measurements(record, &mut row)?;
        }
        Ok(RawRow { start: start_of(record), number, row })
    }

    fn measurements(&mut self, record: &csv::ByteRecord, row: &mut TrackRow) -> Result<()> {
        for i in 0..self.columns.intensities.len() {
            let column = self.columns.intensities[i].1;
            let value = self.number(record, column, "an intensity from 0 to 5")?.map(|v| v as f32);
            match value {
                None => self.troubles.missing_intensity[i].add(start_of(record)),
                Some(v) => {
                    self.values.add(i, v);
                    if v > MAX_INTENSITY {
                        self.off_scale.get_or_insert((start_of(record), column));
                    }
                }
            }
            row.intensities[i] = value;
        }
        for (i, &(_, column)) in self.columns.presences.iter().enumerate() {
            let value = self.number(record, column, "`0` or `1`")?;
            self.values.presence = self.values.presence.max(value.unwrap_or(0.0) as f32);
            if self.values.presence > 1.5 {
                self.off_scale.get_or_insert((start_of(record), column));
            }
            row.presences[i] = value.map(|v| v > 0.5);
        }
        if let Some(columns) = self.columns.landmarks.take() {
            let points = self.group::<136>(record, &columns);
            self.columns.landmarks = Some(columns);
            // OpenFace has the centre of the first pixel at (0, 0).
            row.landmarks = points?.map(|p| {
                let points_px = std::array::from_fn(|i| [(p[i] + 0.5) as f32, (p[i + 68] + 0.5) as f32]);
                Box::new(Landmarks68 { points_px })
            });
        }
        if let Some(columns) = self.columns.landmarks_3d.take() {
            let points = self.group::<204>(record, &columns);
            self.columns.landmarks_3d = Some(columns);
            row.landmarks_in_camera_mm =
                points?.map(|p| Box::new(std::array::from_fn(|i| [p[i] as f32, p[i + 68] as f32, p[i + 136] as f32])));
        }
        if let Some(columns) = self.columns.head_pose.take() {
            let pose = self.group::<6>(record, &columns);
            self.columns.head_pose = Some(columns);
            row.head_pose = pose?.map(|[tx, ty, tz, rx, ry, rz]| HeadPose {
                translation_mm: DVec3::new(tx, ty, tz),
                rotation_rad: DVec3::new(rx, ry, rz),
            });
        }
        Ok(())
    }

    /// Brings intensities to 0–5 and confidences to 0–1; what is off the scale then is clamped and counted.
    fn scale(&mut self, rows: &mut [RawRow], stated: Option<TableScale>, reporter: &dyn Reporter) -> Result<()> {
        let most = self.values.most();
        let scale = if let Some(stated) = stated {
            stated
        } else {
            let place = |e: FormatError| match self.off_scale {
                Some((start, column)) => e.at_line(line_at(self.bytes, start)).in_column(self.columns.name(column)),
                None => e,
            };
            match self.values.judge().map_err(place)? {
                Judged::Plain => TableScale::Five,
                Judged::Other(found) => {
                    reporter.warn(Warning::new("other-scale", table_scale::converted(found, most)));
                    found
                }
                Judged::Small => {
                    reporter.warn(Warning::new("small-intensities", table_scale::small(most, "--au-scale")));
                    TableScale::Five
                }
            }
        };
        let percent = self.values.confidence > 1.5;
        if percent {
            let message = format!("confidences reach {}: taken as percent", self.values.confidence);
            reporter.warn(Warning::new("confidence-percent", message));
        }
        for RawRow { start, row, .. } in rows {
            if percent {
                row.confidence /= 100.0;
            }
            for value in row.intensities.iter_mut().flatten() {
                *value *= scale.factor();
                match *value {
                    v if v < 0.0 => self.troubles.negative.add(*start),
                    v if v > MAX_INTENSITY => self.troubles.above.add(*start),
                    _ => {}
                }
                *value = value.clamp(0.0, MAX_INTENSITY);
            }
        }
        Ok(())
    }

    /// Whether the last record looks like one that a killed run left: too short, or without a line end.
    fn is_cut_off(&self, record: &csv::ByteRecord) -> bool {
        record.len() < self.columns.names.len() || !self.bytes.ends_with(b"\n")
    }

    fn tell(&self, rows: &[RawRow], reporter: &dyn Reporter) {
        let t = &self.troubles;
        let negative =
            "negative intensities read as 0; a killed run leaves them, so run FeatureExtraction again to the end";
        t.negative.tell(self.bytes, reporter, "negative-intensity", negative);
        let above = "intensities above 5 read as 5; a run that did not end leaves them, or the table has another scale";
        t.above.tell(self.bytes, reporter, "intensity-above-5", above);
        t.missing_point.tell(
            self.bytes,
            reporter,
            "missing-value",
            "landmark sets or head poses with a number missing were left out",
        );
        // A column without any number is no intensity at all: the unit is not in the table.
        let tracked = rows.iter().filter(|r| r.row.success).count() as u64;
        for ((unit, column), trouble) in self.columns.intensities.iter().zip(&t.missing_intensity) {
            if trouble.count < tracked {
                let what = format!("values of {unit} in column `{}` are missing", self.columns.name(*column));
                trouble.tell(self.bytes, reporter, "missing-value", &what);
            }
        }
        if self.columns.intensities.is_empty() {
            reporter.warn(Warning::new(
                "no-action-units",
                "the table has no action-unit intensities (columns such as `AU12_r`)",
            ));
        }
    }

    fn into_track(self, mut rows: Vec<TrackRow>) -> Track {
        let mut units: Vec<ActionUnit> = self.columns.intensities.iter().map(|(u, _)| *u).collect();
        let mut presence_units: Vec<ActionUnit> = self.columns.presences.iter().map(|(u, _)| *u).collect();
        if rows.iter().any(|r| r.success) {
            let kept = kept_columns(units.len(), rows.iter().map(|r| r.intensities.as_slice()));
            let kept_presences = kept_columns(presence_units.len(), rows.iter().map(|r| r.presences.as_slice()));
            retain(&mut units, &kept);
            retain(&mut presence_units, &kept_presences);
            for row in &mut rows {
                retain(&mut row.intensities, &kept);
                retain(&mut row.presences, &kept_presences);
            }
        }
        Track { units, presence_units, rows }
    }
}

fn kept_columns<'a, T: 'a>(count: usize, rows: impl Iterator<Item = &'a [Option<T>]>) -> Vec<bool> {
    let mut kept = vec![false; count];
    for row in rows {
        kept.iter_mut().zip(row).for_each(|(k, v)| *k |= v.is_some());
    }
    kept
}

fn retain<T>(values: &mut Vec<T>, kept: &[bool]) {
    if !kept.iter().all(|&k| k) {
        let mut flags = kept.iter();
        values.retain(|_| flags.next().copied().unwrap_or(true));
    }
}
