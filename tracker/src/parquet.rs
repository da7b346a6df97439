//! `track/track.parquet`: one row per frame, nulls where nothing is known.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use polars::io::parquet::write::BatchedWriter;
use polars::prelude::{Column, DataFrame, ParquetCompression, ParquetReader, ParquetWriter, SerReader};
use risorius_formats::atomic::AtomicFile;
use risorius_formats::au::OPENFACE_INTENSITIES;
use risorius_formats::{ActionUnit, FormatError, FrameRecord, Take, Track, TrackRow};

use crate::aus::UNITS;
use crate::error::{Result, TrackerError};
use crate::gaze::{EYE_LANDMARKS, Gaze};

/// What is known of a frame beside its row.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Extra {
    /// Whether the row lies between two tracked frames.
    pub interpolated: bool,
    /// How sure each intensity of [`OPENFACE_INTENSITIES`] is, 0–1.
    pub au_confidences: Option<[f32; UNITS]>,
    /// Gaze and eye landmarks.
    pub gaze: Option<Gaze>,
}

/// Where the table of a take lies.
pub fn path(take: &Take) -> PathBuf {
    take.dir.join("track").join("track.parquet")
}

/// Rows of a row group: what a writer holds in memory.
pub const ROWS_PER_GROUP: usize = 4096;

/// Writes the table, whole or not at all; see [`Writer`].
pub fn write(path: impl AsRef<Path>, track: &Track, frames: &[FrameRecord]) -> Result<()> {
    let mut by_frame: Vec<Option<&TrackRow>> = vec![None; frames.len()];
    for row in &track.rows {
        if let Some(slot) = by_frame.get_mut(row.frame.0 as usize) {
            *slot = Some(row);
        }
    }
    let mut writer = Writer::create(path, &track.units, &track.presence_units)?;
    for (rows, frames) in by_frame.chunks(ROWS_PER_GROUP).zip(frames.chunks(ROWS_PER_GROUP)) {
        writer.push(rows, frames, &[])?;
    }
    writer.finish()
}

/// A table under construction, written in row groups, so that memory does not grow with the video.
///
/// Columns: `frame` (u32, from 0), `timestamp_nanos` (i64), `confidence` (f32), `success` (bool), `interpolated` (bool:
/// between two tracked frames, not tracked itself), `AUxx_r` (f32, 0–5), `AUxx_c` (bool), `AUxx_confidence` (f32, 0–1; null
/// where the AUs do not come from the tracker's own readout), `gaze_0_x`… (f32, unit vectors), `gaze_angle_x`, `…_y` (f32,
/// radians), `eye_lmk_x_0`… (f32, pixels; gaze is null where the eye is closed), `x_0`…`x_67`, `y_0`…`y_67` (f32,
/// pixels, the centre of the first pixel at 0.5), `pose_Tx`… (f64, mm), `pose_Rx`… (f64, radians). A row without success
/// holds nulls behind `interpolated`; frames without a row have `success` = false and no confidence.
pub struct Writer {
    path: PathBuf,
    units: Vec<ActionUnit>,
    presence_units: Vec<ActionUnit>,
    file: AtomicFile,
    encoder: Option<BatchedWriter<std::fs::File>>,
}

impl Writer {
    /// Begins a table with these AUs.
    pub fn create(path: impl AsRef<Path>, units: &[ActionUnit], presence_units: &[ActionUnit]) -> Result<Self> {
        let path = path.as_ref().to_owned();
        let file = AtomicFile::create(&path)?;
        Ok(Self { path, units: units.to_vec(), presence_units: presence_units.to_vec(), file, encoder: None })
    }

    /// Appends frames, each with its row if it has one and what else is known of it (nothing where `extras` is empty).
    pub fn push(&mut self, rows: &[Option<&TrackRow>], frames: &[FrameRecord], extras: &[Extra]) -> Result<()> {
        let path = &self.path;
        let encode =
            |e: polars::error::PolarsError| TrackerError::Encode { path: path.clone(), message: e.to_string() };
        let table = table(&self.units, &self.presence_units, rows, frames, extras).map_err(encode)?;
        if self.encoder.is_none() {
            let staging = self.file.staging_path();
            let out = std::fs::File::create(staging).map_err(|e| FormatError::io(path, "write", &e))?;
            let writer = ParquetWriter::new(out).with_compression(ParquetCompression::Snappy).set_parallel(false);
            self.encoder = Some(writer.batched(table.schema()).map_err(encode)?);
        }
        match &mut self.encoder {
            Some(encoder) => encoder.write_batch(&table).map_err(encode),
            None => Ok(()),
        }
    }

    /// Ends the table and puts it in its place.
    pub fn finish(mut self) -> Result<()> {
        if self.encoder.is_none() {
            self.push(&[], &[], &[])?;
        }
        if let Some(encoder) = self.encoder.take() {
            encoder.finish().map_err(|e| TrackerError::Encode { path: self.path.clone(), message: e.to_string() })?;
        }
        Ok(self.file.commit()?)
    }
}

/// Reads those of the 32-bit columns `names` that a table has, one value per frame; none of a file that does not exist.
pub fn read_floats(path: &Path, names: &[String]) -> Result<BTreeMap<String, Vec<Option<f32>>>> {
    if !path.is_file() {
        return Ok(BTreeMap::new());
    }
    let damaged = |e: polars::error::PolarsError| {
        let hint = "track the take again: `tracker run` or `tracker import`";
        FormatError::syntax(format!("is not a table of frames: {e}")).in_file(path).with_hint(hint)
    };
    let open = || std::fs::File::open(path).map_err(|e| FormatError::io(path, "open", &e));
    let schema = ParquetReader::new(open()?).schema().map_err(damaged)?;
    let there: Vec<String> = names.iter().filter(|n| schema.contains(n.as_str())).cloned().collect();
    if there.is_empty() {
        return Ok(BTreeMap::new());
    }
    let table = ParquetReader::new(open()?).with_columns(Some(there.clone())).finish().map_err(damaged)?;
    let column = |name: String| {
        let values = table.column(&name).and_then(|c| c.f32().cloned()).map_err(damaged)?;
        Ok((name, values.iter().collect()))
    };
    there.into_iter().map(column).collect()
}

fn table(
    units: &[ActionUnit],
    presence_units: &[ActionUnit],
    rows: &[Option<&TrackRow>],
    frames: &[FrameRecord],
    extras: &[Extra],
) -> polars::error::PolarsResult<DataFrame> {
    let good: Vec<Option<&TrackRow>> = rows.iter().map(|r| r.filter(|r| r.success)).collect();
    let f32s = |name: String, value: &dyn Fn(&TrackRow) -> Option<f32>| {
        Column::new(name.into(), good.iter().map(|r| r.and_then(value)).collect::<Vec<Option<f32>>>())
    };
    let f64s = |name: &str, value: &dyn Fn(&TrackRow) -> Option<f64>| {
        Column::new(name.into(), good.iter().map(|r| r.and_then(value)).collect::<Vec<Option<f64>>>())
    };
    let between: Vec<bool> = (0..frames.len()).map(|i| extras.get(i).is_some_and(|e| e.interpolated)).collect();
    let mut columns = vec![
        Column::new("frame".into(), frames.iter().map(|f| f.index.0).collect::<Vec<u32>>()),
        Column::new("timestamp_nanos".into(), frames.iter().map(|f| f.timestamp_nanos).collect::<Vec<i64>>()),
        Column::new("confidence".into(), rows.iter().map(|r| r.map(|r| r.confidence)).collect::<Vec<Option<f32>>>()),
        Column::new("success".into(), rows.iter().map(|r| r.is_some_and(|r| r.success)).collect::<Vec<bool>>()),
        Column::new("interpolated".into(), between),
    ];
    for (k, unit) in units.iter().enumerate() {
        columns.push(f32s(format!("{unit}_r"), &|r| r.intensities[k]));
    }
    for (k, unit) in presence_units.iter().enumerate() {
        let values: Vec<Option<bool>> = good.iter().map(|r| r.and_then(|r| r.presences[k])).collect();
        columns.push(Column::new(format!("{unit}_c").into(), values));
    }
    for (k, unit) in OPENFACE_INTENSITIES.iter().enumerate() {
        let confidence = |i: usize| good[i].and_then(|_| extras.get(i)?.au_confidences.map(|c| c[k]));
        let values: Vec<Option<f32>> = (0..good.len()).map(confidence).collect();
        columns.push(Column::new(format!("{unit}_confidence").into(), values));
    }
    columns.extend(gaze_columns(&good, extras));
    for (axis, name) in ["x", "y"].into_iter().enumerate() {
        for i in 0..68 {
            columns.push(f32s(format!("{name}_{i}"), &|r| r.landmarks.as_ref().map(|l| l.points_px[i][axis])));
        }
    }
    for (axis, name) in ["pose_Tx", "pose_Ty", "pose_Tz"].into_iter().enumerate() {
        columns.push(f64s(name, &|r| r.head_pose.map(|p| p.translation_mm[axis])));
    }
    for (axis, name) in ["pose_Rx", "pose_Ry", "pose_Rz"].into_iter().enumerate() {
        columns.push(f64s(name, &|r| r.head_pose.map(|p| p.rotation_rad[axis])));
    }
    DataFrame::new(frames.len(), columns)
}

/// Gaze and eye landmarks; a closed eye has no gaze.
fn gaze_columns(good: &[Option<&TrackRow>], extras: &[Extra]) -> Vec<Column> {
    let column = |name: String, value: &dyn Fn(&Gaze) -> Option<f32>| {
        let of = |i: usize| good[i].and_then(|_| value(extras.get(i)?.gaze.as_ref()?));
        Column::new(name.into(), (0..good.len()).map(of).collect::<Vec<Option<f32>>>())
    };
    let mut columns = Vec::new();
    for eye in 0..2 {
        for (axis, name) in ["x", "y", "z"].into_iter().enumerate() {
            let value = |g: &Gaze| g.open[eye].then_some(g.directions[eye][axis] as f32);
            columns.push(column(format!("gaze_{eye}_{name}"), &value));
        }
    }
    for (axis, name) in ["x", "y"].into_iter().enumerate() {
        let value = |g: &Gaze| (g.open == [true; 2]).then_some(g.angles[axis] as f32);
        columns.push(column(format!("gaze_angle_{name}"), &value));
    }
    for (axis, name) in ["x", "y"].into_iter().enumerate() {
        for i in 0..EYE_LANDMARKS {
            columns.push(column(format!("eye_lmk_{name}_{i}"), &|g| Some(g.landmarks_px[i][axis])));
        }
    }
    columns
}

#[cfg(test)]
mod tests {
    use super::*;
    use risorius_formats::FrameIndex;

    #[test]
    fn missing_and_lost_frames_come_back_as_nulls() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("track.parquet");
        let row = |frame, success| TrackRow {
            frame: FrameIndex(frame),
            face_id: 0,
            timestamp_secs: None,
            confidence: 0.5,
            success,
            intensities: vec![Some(1.5)],
            presences: vec![Some(true)],
            landmarks: None,
            landmarks_in_camera_mm: None,
            head_pose: None,
        };
        let track = Track {
            units: vec![ActionUnit(12)],
            presence_units: vec![ActionUnit(12)],
            rows: vec![row(0, true), row(2, false)],
        };
        let frames: Vec<FrameRecord> = (0..3)
            .map(|i| FrameRecord { index: FrameIndex(i), timestamp_nanos: i64::from(i) * 7, ..FrameRecord::default() })
            .collect();
        write(&path, &track, &frames).unwrap();
        let read = ParquetReader::new(std::fs::File::open(&path).unwrap()).finish().unwrap();
        assert_eq!(read.height(), 3);
        let f32s = |name: &str| (0..3).map(|i| read.column(name).unwrap().f32().unwrap().get(i)).collect::<Vec<_>>();
        assert_eq!(f32s("AU12_r"), [Some(1.5), None, None]);
        assert_eq!(f32s("confidence"), [Some(0.5), None, Some(0.5)]);
        assert_eq!(read.column("x_67").unwrap().null_count(), 3);
        assert_eq!(read.column("timestamp_nanos").unwrap().i64().unwrap().get(2), Some(14));
        let names = ["AU12_r", "AU99_r"].map(str::to_owned);
        assert_eq!(read_floats(&path, &names).unwrap(), [("AU12_r".to_owned(), vec![Some(1.5), None, None])].into());
        assert!(read_floats(&dir.path().join("none.parquet"), &names).unwrap().is_empty());
        std::fs::write(&path, "no table").unwrap();
        let said = read_floats(&path, &names).unwrap_err().to_string();
        assert!(said.contains("track.parquet") && said.contains("is not a table"), "{said}");
    }
}
