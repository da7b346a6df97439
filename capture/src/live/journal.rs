//! What a recording writes beside its video while it runs, so that it can be finished after any end.
//!
//! `recording.toml` comes first and says what is being recorded; `recording.csv` grows with the video, a row a frame,
//! fragment by fragment.

use std::fs::File;
use std::io;
use std::path::Path;

use risorius_formats::{FormatError, atomic};
use serde::{Deserialize, Serialize};

use crate::controls::Changed;
use crate::script::Script;
use crate::source::PixelFormat;
use crate::{CaptureError, Result};

/// The name of the recording's description.
pub const RECORDING_FILE: &str = "recording.toml";
/// The name of the table of frames as they came.
pub const JOURNAL_FILE: &str = "recording.csv";
/// The name of the video.
pub const VIDEO_FILE: &str = "video.mp4";
/// Room on the disk that is kept for the take's tables.
pub(super) const RESERVE_FILE: &str = ".reserve";

/// `recording.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Recording {
    /// Version of this file's layout.
    pub version: u32,
    /// The camera, as it was asked for.
    pub device: String,
    /// The camera's own name.
    pub name: String,
    /// What its frames are made of.
    pub format: PixelFormat,
    /// Pixels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Frames per second that were asked for.
    pub fps_asked: Option<f64>,
    /// Frames per second that the driver promised.
    pub fps_promised: Option<f64>,
    /// Who is seen.
    pub subject: String,
    /// Under which consent.
    pub consent: String,
    /// Controls that were changed for the recording.
    #[serde(default)]
    pub controls: Vec<Changed>,
    /// The guided script.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub script: Option<Script>,
}

/// The current layout of `recording.toml`.
pub(super) const RECORDING_VERSION: u32 = 1;

impl Recording {
    pub(super) fn write(&self, dir: &Path) -> Result<()> {
        let path = dir.join(RECORDING_FILE);
        let text =
            toml::to_string(self).map_err(|e| FormatError::syntax(format!("cannot encode: {e}")).in_file(&path))?;
        Ok(atomic::write_file(&path, text.as_bytes())?)
    }

    /// Reads the description of the recording in a take's folder.
    pub fn read(dir: &Path) -> Result<Self> {
        let path = dir.join(RECORDING_FILE);
        let text = std::fs::read_to_string(&path).map_err(|e| match e.kind() {
            io::ErrorKind::NotFound => CaptureError::NotARecording { path: dir.to_owned() },
            _ => FormatError::io(&path, "read", &e).into(),
        })?;
        Ok(toml::from_str(&text).map_err(|e| FormatError::syntax(e.message().to_owned()).in_file(&path))?)
    }
}

/// A row of `recording.csv`: a frame that was written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct JournalRow {
    /// The frame's number in the video, from 0.
    pub index: u32,
    /// Time since the first frame.
    pub timestamp_nanos: i64,
    /// The driver's count.
    pub sequence: Option<u32>,
    /// The driver's time.
    pub driver_nanos: Option<i64>,
    /// When it reached the program, since the recording began.
    pub arrival_nanos: i64,
    /// Its size as it came.
    pub bytes: u32,
    /// Frames that the driver lost before this one.
    pub lost_before: u32,
    /// Frames that were let go before this one because the disk was too slow.
    pub discarded_before: u32,
    /// Broken frames before this one.
    pub corrupt_before: u32,
}

impl JournalRow {
    /// All frames that are missing before this one.
    pub fn missing_before(&self) -> u32 {
        self.lost_before.saturating_add(self.discarded_before).saturating_add(self.corrupt_before)
    }
}

/// Writes `recording.csv`.
#[derive(Debug)]
pub(super) struct Journal {
    writer: csv::Writer<File>,
    waiting: Vec<JournalRow>,
}

impl Journal {
    pub(super) fn create(dir: &Path) -> Result<Self> {
        let path = dir.join(JOURNAL_FILE);
        let file = File::create(&path).map_err(|e| FormatError::io(&path, "create", &e))?;
        Ok(Self { writer: csv::Writer::from_writer(file), waiting: Vec::new() })
    }

    /// Keeps a row until its frame is in the video.
    pub(super) fn push(&mut self, row: JournalRow) {
        self.waiting.push(row);
    }

    /// Writes the oldest `count` rows.
    pub(super) fn send(&mut self, count: usize) -> io::Result<()> {
        for row in self.waiting.drain(..count.min(self.waiting.len())) {
            self.writer.serialize(row).map_err(io::Error::other)?;
        }
        self.writer.flush()
    }
}

/// The whole rows of `recording.csv`; a cut last line is left out, and so is what comes after a wrong one.
pub(crate) fn read_journal(dir: &Path) -> Vec<JournalRow> {
    let Ok(bytes) = std::fs::read(dir.join(JOURNAL_FILE)) else { return Vec::new() };
    // A line without its end may lack digits.
    let whole = bytes.iter().rposition(|&b| b == b'\n').map_or(0, |last| last + 1);
    let mut reader = csv::Reader::from_reader(&bytes[..whole]);
    let mut rows: Vec<JournalRow> = Vec::new();
    for row in reader.deserialize::<JournalRow>() {
        match row {
            Ok(row)
                if row.index as usize == rows.len()
                    && rows.last().is_none_or(|r| r.timestamp_nanos < row.timestamp_nanos) =>
            {
                rows.push(row);
            }
            _ => break,
        }
    }
    rows
}

/// Sets room aside on the disk.
pub(super) fn reserve(dir: &Path, bytes: usize) -> Result<()> {
    let path = dir.join(RESERVE_FILE);
    // Not a hole in the file, which would set nothing aside.
    Ok(std::fs::write(&path, vec![0x55; bytes]).map_err(|e| FormatError::io(&path, "write", &e))?)
}

/// Gives the room back.
pub(super) fn release(dir: &Path) {
    let _ = std::fs::remove_file(dir.join(RESERVE_FILE));
}
