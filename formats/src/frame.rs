//! Frames and their times: `frames.csv` of a take.

use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::error::shown;
use crate::{ErrorKind, FormatError, Result, atomic};

/// The number of a frame in its take, from 0.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct FrameIndex(pub u32);

impl FrameIndex {
    /// The name that stands for this frame in COLMAP models: `%06d.png`.
    pub fn image_name(self) -> String {
        format!("{:06}.png", self.0)
    }

    /// The frame that an image name means by its last run of digits, shifted so that counting starts at `first`.
    ///
    /// `None` when there are no digits, or the number lies before `first`.
    pub fn from_image_name(name: &str, first: u32) -> Option<Self> {
        let stem = name.rsplit_once('.').map_or(name, |(stem, _)| stem);
        let end = stem.rfind(|c: char| c.is_ascii_digit())? + 1;
        let start = stem[..end].rfind(|c: char| !c.is_ascii_digit()).map_or(0, |i| i + 1);
        stem[start..end].parse::<u32>().ok()?.checked_sub(first).map(Self)
    }
}

impl std::fmt::Display for FrameIndex {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:06}", self.0)
    }
}

/// One row of `frames.csv`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FrameRecord {
    /// Number of the frame, from 0.
    pub index: FrameIndex,
    /// Presentation time since the first frame.
    pub timestamp_nanos: i64,
    /// How many frames are missing between this frame and the one before it.
    pub dropped_before: u32,
    /// Whether the picture is the same as the frame before (a repeated frame).
    pub repeated: bool,
    /// Variance of the Laplacian of the luma, in squared 8-bit levels: the higher, the sharper.
    pub sharpness: Option<f32>,
    /// Mean luma, 0–255.
    pub luma_mean: Option<f32>,
    /// Mean absolute difference of the luma from the frame before, 8-bit levels; absent in older tables.
    #[serde(default)]
    pub motion: Option<f32>,
    /// Share of pixels at the ends of the range (luma ≤ 2 or ≥ 253), 0–1.
    pub clipped_share: Option<f32>,
}

/// Parses `frames.csv`; extra columns are ignored, the index must count up from 0, and time must not go back.
pub fn parse_frames(bytes: &[u8]) -> Result<Vec<FrameRecord>> {
    if bytes.trim_ascii().is_empty() {
        return Err(FormatError::new(ErrorKind::Empty, "the table is empty"));
    }
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(bytes);
    let headers = reader.headers().map_err(|e| row_error(&e))?.clone();
    let mut frames: Vec<FrameRecord> = Vec::new();
    for record in reader.records() {
        let record = record.map_err(|e| row_error(&e))?;
        let line = record.position().map_or(1, csv::Position::line);
        let row: FrameRecord =
            record.deserialize(Some(&headers)).map_err(|e| cell_error(&e, &headers, &record).at_line(line))?;
        if row.index.0 as usize != frames.len() {
            let message = format!("expected frame {}, found {}", frames.len(), row.index.0);
            return Err(FormatError::new(ErrorKind::Inconsistent, message).at_line(line).in_column("index"));
        }
        if let Some(before) = frames.last().filter(|before| before.timestamp_nanos > row.timestamp_nanos) {
            let message = format!("expected a time from {} on, found {}", before.timestamp_nanos, row.timestamp_nanos);
            return Err(FormatError::new(ErrorKind::Inconsistent, message)
                .at_line(line)
                .in_column("timestamp_nanos")
                .with_hint("a clock was set back while the frames were written down; make the take anew"));
        }
        frames.push(row);
    }
    Ok(frames)
}

/// Why a line is no row of the table at all.
fn row_error(error: &csv::Error) -> FormatError {
    let line = error.position().map_or(1, csv::Position::line);
    let message = match error.kind() {
        csv::ErrorKind::UnequalLengths { expected_len, len, .. } => {
            format!("expected {expected_len} columns, found {len}")
        }
        csv::ErrorKind::Utf8 { .. } => "is not a text table".to_owned(),
        _ => format!("cannot be read as a table: {error}"),
    };
    FormatError::syntax(message).at_line(line)
}

/// Which cell of a row does not hold what it should.
fn cell_error(error: &csv::Error, headers: &csv::StringRecord, record: &csv::StringRecord) -> FormatError {
    let csv::ErrorKind::Deserialize { err, .. } = error.kind() else { return row_error(error) };
    let Some(column) = err.field().map(|f| f as usize) else {
        // Without a cell it is a column that is not there.
        return FormatError::syntax(err.kind().to_string());
    };
    let found = shown(record.get(column).unwrap_or_default().as_bytes());
    FormatError::syntax(format!("cannot use {found}: {}", err.kind()))
        .in_column(headers.get(column).unwrap_or_default())
}

/// Reads `frames.csv`.
pub fn read_frames(path: impl AsRef<Path>) -> Result<Vec<FrameRecord>> {
    let path = path.as_ref();
    let bytes = std::fs::read(path).map_err(|e| FormatError::io(path, "read", &e))?;
    parse_frames(&bytes).map_err(|e| e.in_file(path))
}

/// Writes `frames.csv`, whole or not at all.
pub fn write_frames(path: impl AsRef<Path>, frames: &[FrameRecord]) -> Result<()> {
    let path = path.as_ref();
    let mut writer = csv::Writer::from_writer(Vec::new());
    let fail = |e: &dyn std::fmt::Display| FormatError::syntax(format!("cannot encode: {e}")).in_file(path);
    for frame in frames {
        writer.serialize(frame).map_err(|e| fail(&e))?;
    }
    let bytes = writer.into_inner().map_err(|e| fail(&e))?;
    atomic::write_file(path, &bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_matched_by_their_digits() {
        assert_eq!(FrameIndex(7).image_name(), "000007.png");
        assert_eq!(FrameIndex::from_image_name("frame_000012.png", 0), Some(FrameIndex(12)));
        assert_eq!(FrameIndex::from_image_name("cam1/f0013.jpg", 1), Some(FrameIndex(12)));
        assert_eq!(FrameIndex::from_image_name("take2_0005_left.png", 0), Some(FrameIndex(5)));
        assert_eq!(FrameIndex::from_image_name("0.png", 1), None);
        assert_eq!(FrameIndex::from_image_name("face.png", 0), None);
    }

    #[test]
    fn frames_come_back_as_written() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("frames.csv");
        let frames = vec![
            FrameRecord { sharpness: Some(12.5), ..FrameRecord::default() },
            FrameRecord {
                index: FrameIndex(1),
                timestamp_nanos: 8_333_333,
                dropped_before: 2,
                repeated: true,
                ..FrameRecord::default()
            },
        ];
        write_frames(&path, &frames).unwrap();
        assert_eq!(read_frames(&path).unwrap(), frames);
    }

    #[test]
    fn a_gap_in_the_index_is_named_with_its_line() {
        let text = "index,timestamp_nanos,dropped_before,repeated,sharpness,luma_mean,clipped_share\n0,0,0,false,,,\n2,1,0,false,,,\n";
        let error = parse_frames(text.as_bytes()).unwrap_err();
        assert_eq!((error.line(), error.column()), (Some(3), Some("index")));
    }

    #[test]
    fn damage_is_named_with_its_line_and_column() {
        let head = "index,timestamp_nanos,dropped_before,repeated,sharpness,luma_mean,clipped_share\n0,0,0,false,,,\n";
        let error = |bytes: &[u8]| parse_frames(bytes).unwrap_err().to_string();
        let with = |row: &str| error(format!("{head}{row}").as_bytes());
        assert_eq!(error(b"\n"), "the table is empty");
        assert_eq!(error(b"\x7fELF\xff\xfe\n\xff"), "line 1: is not a text table");
        assert_eq!(with("1,33,0"), "line 3: expected 7 columns, found 3");
        assert_eq!(
            with("1,x,0,false,,,"),
            "line 3: column `timestamp_nanos`: cannot use `x`: invalid digit found in string"
        );
        assert_eq!(error(b"index\n0\n"), "line 2: missing field `timestamp_nanos`");
        assert_eq!(with("1,-1,0,false,,,"), "line 3: column `timestamp_nanos`: expected a time from 0 on, found -1");
    }
}
