//! Hand-made takes for tests.

use std::path::{Path, PathBuf};

use risorius_formats::take::{SourceKind, TAKE_VERSION};
use risorius_formats::{FrameIndex, FrameRecord, Landmarks68, TakeManifest, TrackRow, frame};

/// A trusted row of a table without AUs.
pub(crate) fn row(frame: u32, points_px: &[[f32; 2]; 68]) -> TrackRow {
    TrackRow {
        frame: FrameIndex(frame),
        face_id: 0,
        timestamp_secs: None,
        confidence: 1.0,
        success: true,
        intensities: vec![],
        presences: vec![],
        landmarks: Some(Box::new(Landmarks68 { points_px: *points_px })),
        landmarks_in_camera_mm: None,
        head_pose: None,
    }
}

/// A take of `frames` frames at 25 frames/s without its video.
pub(crate) fn take(dir: &Path, width: u32, height: u32, frames: u32) -> PathBuf {
    take_at(dir, width, height, frames, 25.0)
}

/// A take of `frames` frames at `fps` without its video.
pub(crate) fn take_at(dir: &Path, width: u32, height: u32, frames: u32, fps: f64) -> PathBuf {
    let dir = dir.join("take");
    std::fs::create_dir_all(&dir).unwrap();
    let manifest = TakeManifest {
        version: TAKE_VERSION,
        subject: String::new(),
        consent: String::new(),
        source: SourceKind::Video,
        media: "video.mp4".into(),
        media_sha256: String::new(),
        original_name: "video.mp4".into(),
        device: None,
        width,
        height,
        rotation_degrees: 0,
        fps_asked: Some(fps),
        fps_measured: fps,
        frame_count: frames,
        dropped_frames: 0,
        repeated_frames: 0,
        written_by: "test".into(),
    };
    manifest.write(dir.join("take.toml")).unwrap();
    let records: Vec<FrameRecord> = (0..frames)
        .map(|i| FrameRecord {
            index: FrameIndex(i),
            timestamp_nanos: (f64::from(i) / fps * 1e9).round() as i64,
            ..FrameRecord::default()
        })
        .collect();
    frame::write_frames(dir.join("frames.csv"), &records).unwrap();
    dir
}
