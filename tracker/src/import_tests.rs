use std::fmt::Write as _;

use super::*;
use crate::testing;
use risorius_formats::report::Collected;

fn options(path: PathBuf) -> ImportOptions {
    ImportOptions::new(path)
}

/// Writes a table for `frames` (0-based) whose AU12 is the frame number / 10.
fn table(dir: &Path, frames: impl Iterator<Item = u32>) -> PathBuf {
    let path = dir.join("table.csv");
    let mut text = String::from("frame, face_id, timestamp, confidence, success, AU12_r");
    for axis in ["x", "y"] {
        for i in 0..68 {
            write!(text, ", {axis}_{i}").unwrap();
        }
    }
    for f in frames {
        write!(
            text,
            "\n{}, 0, {:.3}, {}, 1, {:.2}",
            f + 1,
            f64::from(f) / 30.0,
            if f == 3 { 0.4 } else { 0.98 },
            f64::from(f) / 10.0
        )
        .unwrap();
        for i in 0..136 {
            let start = if i < 68 { 20.0 } else { 30.0 };
            write!(text, ", {:.1}", start + f64::from(i) * 0.2).unwrap();
        }
    }
    std::fs::write(&path, text).unwrap();
    path
}

#[test]
fn rows_join_by_number_with_missing_extra_and_doubtful_ones() {
    let dir = tempfile::tempdir().unwrap();
    let take = testing::take(dir.path(), 100, 80, 20);
    // 5 and 6 are missing, 20..24 do not exist in the video, 3 is doubtful.
    let path = table(dir.path(), (0..24).filter(|f| *f != 5 && *f != 6));
    let heard = Collected::default();
    let summary = import(&take, &options(path), &heard).unwrap();
    assert_eq!((summary.rows, summary.rows_beyond_video), (22, 4));
    assert_eq!((summary.frames_without_row, summary.frames_below_confidence), (2, 1));
    assert_eq!((summary.quality.valid_frames, summary.quality.lost_runs.clone()), (17, vec![[3, 3], [5, 6]]));
    assert_eq!((heard.count("rows-beyond-video"), heard.count("frames-without-row")), (1, 1));
    let written =
        openface::read(take.join("track/openface.csv"), &ReadOptions::default(), &Collected::default()).unwrap();
    assert_eq!(written.rows.len(), 20);
    let unit = written.unit_index(risorius_formats::ActionUnit(12)).unwrap();
    for (i, row) in written.rows.iter().enumerate() {
        assert_eq!(row.frame.0 as usize, i);
        assert_eq!(row.success, ![3, 5, 6].contains(&i), "{i}");
        if row.success {
            // Shifted rows, as a join by place would give them, differ here.
            assert!((row.intensities[unit].unwrap() - i as f32 / 10.0).abs() < 1e-5, "{i}");
        }
        // The take runs at 25 frames/s; the table claimed 30.
        assert!((row.timestamp_secs.unwrap() - i as f64 / 25.0).abs() < 1e-3);
    }
    assert!(take.join("track/track.parquet").is_file());
}

#[test]
fn a_table_of_another_video_is_an_error_or_a_warning() {
    let dir = tempfile::tempdir().unwrap();
    let take = testing::take(dir.path(), 100, 80, 20);
    let path = table(dir.path(), 100..120);
    let error = import(&take, &options(path), &Collected::default()).unwrap_err();
    assert!(matches!(error, TrackerError::NoCommonFrame { rows: 20, frames: 20, .. }), "{error}");
    assert!(!take.join("track").exists());
    // A picture of 20×12 cannot hold landmarks from (20, 44) to (33, 57).
    let small = testing::take(&dir.path().join("small"), 20, 12, 20);
    let heard = Collected::default();
    import(&small, &options(table(dir.path(), 0..20)), &heard).unwrap();
    assert_eq!(heard.count("landmarks-outside"), 1);
    assert!(!heard.warnings()[0].message.contains("turned"));
    // 60×36 cannot hold them, but turned to 36×60 it can.
    let turned = testing::take(&dir.path().join("turned"), 60, 36, 20);
    let heard = Collected::default();
    import(&turned, &options(table(dir.path(), 0..20)), &heard).unwrap();
    assert!(heard.warnings().iter().any(|w| w.kind == "landmarks-outside" && w.message.contains("turned")));
}

#[test]
fn nothing_but_doubtful_rows_is_an_error_that_leaves_the_old_track() {
    let dir = tempfile::tempdir().unwrap();
    let take = testing::take(dir.path(), 100, 80, 20);
    import(&take, &options(table(dir.path(), 0..20)), &Collected::default()).unwrap();
    let before = std::fs::read(take.join("track/openface.csv")).unwrap();
    let error = import(&take, &options(table(dir.path(), 3..4)), &Collected::default()).unwrap_err();
    assert!(matches!(error, TrackerError::NoValidFrame { .. }), "{error}");
    assert_eq!(std::fs::read(take.join("track/openface.csv")).unwrap(), before);
}
