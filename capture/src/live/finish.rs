//! From a recording to a take: the same way after a proper end, and after none.

use std::fs;
use std::path::Path;

use risorius_formats::frame::{self, FrameIndex, FrameRecord};
use risorius_formats::take::{SourceKind, TAKE_VERSION};
use risorius_formats::{FormatError, Reporter, Take, TakeManifest, Warning, atomic};
use risorius_video::{Reader, fragmented};

use super::journal::{self, JournalRow, Recording, VIDEO_FILE};
use crate::script::{MARKS_FILE, Mark};
use crate::{CaptureError, Result, measure, media, timing};

/// A recording that has become a take.
#[derive(Clone, Debug)]
pub struct Finished {
    /// `take.toml`.
    pub manifest: TakeManifest,
    /// `frames.csv`.
    pub frames: Vec<FrameRecord>,
    /// How many marks of a script there are.
    pub marks: usize,
    /// Bytes of a torn fragment that were cut off.
    pub cut_bytes: u64,
    /// Frames of the video whose rows were missing.
    pub rows_restored: usize,
}

/// Writes the tables of a take from what a recording left: cuts a torn fragment off the video, and makes rows, drops and
/// marks from the journal. Where the journal is short, the video's own times stand in.
pub fn finish(dir: &Path, reporter: &dyn Reporter) -> Result<Finished> {
    let recording = Recording::read(dir)?;
    journal::release(dir);
    let video = dir.join(VIDEO_FILE);
    let fragments = fragmented::whole_fragments(&video)?;
    let cut_bytes = fragments.file_bytes - fragments.whole_bytes;
    if cut_bytes > 0 {
        super::cut(&video, fragments.whole_bytes)?;
    }
    let timeline = fragmented::timeline(&video).map_err(|_| CaptureError::NothingRecorded { path: dir.to_owned() })?;
    let times = timeline.nanos();
    if times.is_empty() {
        return Err(CaptureError::NothingRecorded { path: dir.to_owned() });
    }
    let rows = agreeing_rows(journal::read_journal(dir), times);
    let rows_restored = times.len() - rows.len();
    let frames = frames(&rows, times);
    let marks = recording.script.as_ref().map(|s| s.marks(&frames)).unwrap_or_default();
    if !marks.is_empty() {
        write_marks(&dir.join(MARKS_FILE), &marks)?;
    }
    reporter.stage("hashing the video", None);
    let media_sha256 = media::copy(&video, None, reporter)?;
    let manifest = manifest(&recording, &frames, media_sha256);
    frame::write_frames(dir.join("frames.csv"), &frames)?;
    manifest.write(dir.join("take.toml"))?;
    Ok(Finished { manifest, frames, marks: marks.len(), cut_bytes, rows_restored })
}

/// The journal's rows as far as they are those of the video; an MP4 file has whole microseconds.
fn agreeing_rows(mut rows: Vec<JournalRow>, times: &[i64]) -> Vec<JournalRow> {
    let agree = rows.iter().zip(times).take_while(|(row, time)| (row.timestamp_nanos - **time).abs() <= 1000).count();
    rows.truncate(agree);
    rows
}

fn frames(rows: &[JournalRow], times: &[i64]) -> Vec<FrameRecord> {
    let times: Vec<i64> =
        rows.iter().map(|r| r.timestamp_nanos).chain(times.iter().skip(rows.len()).copied()).collect();
    // Without the driver's count, the times tell.
    let by_time = timing::dropped_before(&times);
    let dropped = |i: usize| match rows.get(i) {
        Some(row) if row.sequence.is_some() => row.missing_before(),
        Some(row) => row.missing_before().max(by_time[i]),
        None => by_time[i],
    };
    times
        .iter()
        .enumerate()
        .map(|(i, &timestamp_nanos)| FrameRecord {
            index: FrameIndex(i as u32),
            timestamp_nanos,
            dropped_before: dropped(i),
            ..FrameRecord::default()
        })
        .collect()
}

fn write_marks(path: &Path, marks: &[Mark]) -> Result<()> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    let fail = |e: &dyn std::fmt::Display| FormatError::syntax(format!("cannot encode: {e}")).in_file(path);
    for mark in marks {
        writer.serialize(mark).map_err(|e| fail(&e))?;
    }
    let bytes = writer.into_inner().map_err(|e| fail(&e))?;
    Ok(atomic::write_file(path, &bytes)?)
}

fn manifest(recording: &Recording, frames: &[FrameRecord], media_sha256: String) -> TakeManifest {
    let times: Vec<i64> = frames.iter().map(|f| f.timestamp_nanos).collect();
    TakeManifest {
        version: TAKE_VERSION,
        subject: recording.subject.clone(),
        consent: recording.consent.clone(),
        source: SourceKind::Camera,
        media: VIDEO_FILE.into(),
        media_sha256,
        original_name: recording.name.clone(),
        device: Some(recording.device.clone()),
        width: recording.width,
        height: recording.height,
        rotation_degrees: 0,
        fps_asked: recording.fps_asked.or(recording.fps_promised),
        fps_measured: timing::measured_fps(&times),
        frame_count: frames.len() as u32,
        dropped_frames: frames.iter().map(|f| f.dropped_before).fold(0, u32::saturating_add),
        repeated_frames: 0,
        written_by: concat!("capture ", env!("CARGO_PKG_VERSION")).to_owned(),
    }
}

/// Fills in the quality columns of a take by decoding its video once; the tables are replaced whole, at the end.
pub fn measure_take(dir: &Path, reporter: &dyn Reporter) -> Result<Take> {
    let mut take = Take::open(dir)?;
    let reader = Reader::open_take(&take)?;
    reporter.stage("measuring the frames", Some(take.frames.len() as u64));
    let measured = measure::measure_all(reader, reporter)?.frames;
    if measured.len() != take.frames.len() {
        let message = format!(
            "{}: {} of {} frames could be decoded; sharpness and exposure are left out",
            take.media_path().display(),
            measured.len(),
            take.frames.len()
        );
        reporter.warn(Warning::new("undecodable-frames", message));
        return Ok(take);
    }
    for (frame, found) in take.frames.iter_mut().zip(measured) {
        let (timestamp_nanos, dropped_before) = (frame.timestamp_nanos, frame.dropped_before);
        *frame = FrameRecord { timestamp_nanos, dropped_before, ..found };
    }
    take.manifest.repeated_frames = take.frames.iter().filter(|f| f.repeated).count() as u32;
    frame::write_frames(dir.join("frames.csv"), &take.frames)?;
    take.manifest.write(dir.join("take.toml"))?;
    Ok(take)
}

/// Repairs a take whose recording was cut off; `None` when the take is whole already.
pub fn recover(dir: &Path, reporter: &dyn Reporter) -> Result<Option<Finished>> {
    if !dir.is_dir() {
        // The usual words about what is not there.
        Take::open(dir)?;
    }
    let is_recording = fs::exists(dir.join(journal::RECORDING_FILE)).unwrap_or(false);
    if let Ok(take) = Take::open(dir)
        && (!is_recording
            || fragmented::timeline(&take.media_path()).is_ok_and(|t| t.nanos().len() == take.frames.len()))
    {
        journal::release(dir);
        return Ok(None);
    }
    finish(dir, reporter).map(Some)
}
