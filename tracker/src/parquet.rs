//! `track/track.parquet`: one row per frame, nulls where nothing is known.

use std::io::Write;
use std::path::Path;

use polars::prelude::{Column, DataFrame, ParquetCompression, ParquetWriter};
use risorius_formats::atomic::AtomicFile;
use risorius_formats::{FrameRecord, Track, TrackRow};

use crate::error::{Result, TrackerError};

/// Writes the table, whole or not at all.
///
/// Columns: `frame` (u32, from 0), `timestamp_nanos` (i64), `confidence` (f32), `success` (bool), `AUxx_r` (f32, 0–5),
/// `AUxx_c` (bool), `x_0`…`x_67`, `y_0`…`y_67` (f32, pixels, the centre of the first pixel at 0.5), `pose_Tx`… (f64, mm),
/// `pose_Rx`… (f64, radians). A row without success holds nulls behind `success`; frames without a row have
/// `success` = false and no confidence.
pub fn write(path: impl AsRef<Path>, track: &Track, frames: &[FrameRecord]) -> Result<()> {
    let path = path.as_ref();
    let encode = |e: polars::error::PolarsError| TrackerError::Encode { path: path.to_owned(), message: e.to_string() };
    let mut data = frame_of(track, frames).map_err(encode)?;
    let mut bytes = Vec::new();
    ParquetWriter::new(&mut bytes).with_compression(ParquetCompression::Snappy).finish(&mut data).map_err(encode)?;
    let mut file = AtomicFile::create(path)?;
    file.write_all(&bytes).map_err(|e| risorius_formats::FormatError::io(path, "write", &e))?;
    Ok(file.commit()?)
}

fn frame_of(track: &Track, frames: &[FrameRecord]) -> polars::error::PolarsResult<DataFrame> {
    let mut rows: Vec<Option<&TrackRow>> = vec![None; frames.len()];
    for row in &track.rows {
        if let Some(slot) = rows.get_mut(row.frame.0 as usize) {
            *slot = Some(row);
        }
    }
    let good: Vec<Option<&TrackRow>> = rows.iter().map(|r| r.filter(|r| r.success)).collect();
    let f32s = |name: String, value: &dyn Fn(&TrackRow) -> Option<f32>| {
        Column::new(name.into(), good.iter().map(|r| r.and_then(value)).collect::<Vec<Option<f32>>>())
    };
    let f64s = |name: &str, value: &dyn Fn(&TrackRow) -> Option<f64>| {
        Column::new(name.into(), good.iter().map(|r| r.and_then(value)).collect::<Vec<Option<f64>>>())
    };
    let mut columns = vec![
        Column::new("frame".into(), frames.iter().map(|f| f.index.0).collect::<Vec<u32>>()),
        Column::new("timestamp_nanos".into(), frames.iter().map(|f| f.timestamp_nanos).collect::<Vec<i64>>()),
        Column::new("confidence".into(), rows.iter().map(|r| r.map(|r| r.confidence)).collect::<Vec<Option<f32>>>()),
        Column::new("success".into(), rows.iter().map(|r| r.is_some_and(|r| r.success)).collect::<Vec<bool>>()),
    ];
    for (k, unit) in track.units.iter().enumerate() {
        columns.push(f32s(format!("{unit}_r"), &|r| r.intensities[k]));
    }
    for (k, unit) in track.presence_units.iter().enumerate() {
        let values: Vec<Option<bool>> = good.iter().map(|r| r.and_then(|r| r.presences[k])).collect();
        columns.push(Column::new(format!("{unit}_c").into(), values));
    }
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

#[cfg(test)]
mod tests {
    use super::*;
    use polars::prelude::{ParquetReader, SerReader};
    use risorius_formats::{ActionUnit, FrameIndex};

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
    }
}
