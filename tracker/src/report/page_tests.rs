use risorius_formats::{ActionUnit, FrameIndex, Silent, Track, report::Collected};

use super::*;
use crate::check::check;
use crate::parquet::Extra;
use crate::testing::take_at;

/// A track of 300 frames: AU12 smiles at 4 s, AU05 is unsure, the face is gone in frames 200–209.
fn track() -> Track {
    let face = Landmarks68 { points_px: std::array::from_fn(|i| [100.0 + i as f32, 80.0 + (i % 10) as f32]) };
    let row = |i: u32| {
        let t = f64::from(i) / 30.0;
        TrackRow {
            frame: FrameIndex(i),
            face_id: 0,
            timestamp_secs: Some(t),
            confidence: 0.98,
            success: !(200..210).contains(&i),
            intensities: vec![Some(0.7), Some((4.0 * (-(t - 4.0).powi(2)).exp()) as f32)],
            presences: vec![],
            landmarks: Some(Box::new(face.clone())),
            landmarks_in_camera_mm: None,
            head_pose: None,
        }
    };
    let units = vec![ActionUnit(5), ActionUnit(12)];
    Track { units, presence_units: vec![], rows: (0..300).map(row).collect() }
}

#[test]
fn the_page_stands_alone_and_says_what_is_not_sure() {
    let dir = tempfile::tempdir().unwrap();
    let take_dir = take_at(dir.path(), 320, 240, 300, 30.0);
    let take = Take::open(&take_dir).unwrap();
    let track = track();
    std::fs::create_dir_all(take_dir.join("track")).unwrap();
    std::fs::write(take.openface_path(), risorius_formats::openface::to_bytes(&track).unwrap()).unwrap();
    let mut writer = parquet::Writer::create(parquet::path(&take), &track.units, &[]).unwrap();
    let confidences = std::array::from_fn(|k| if k == 8 { 0.8 } else { 0.1 });
    let extra = Extra { au_confidences: Some(confidences), ..Extra::default() };
    let rows: Vec<_> = track.rows.iter().map(Some).collect();
    writer.push(&rows, &take.frames, &vec![extra; 300]).unwrap();
    writer.finish().unwrap();

    let report = check(&take_dir, None, &Silent).unwrap();
    let out = default_path(&take_dir);
    let collected = Collected::default();
    write(&take_dir, &report, &out, &collected).unwrap();
    assert_eq!(collected.count("no-pictures"), 1, "this take has no video");
    let page = std::fs::read_to_string(&out).unwrap();
    assert!(!page.contains("http") && !page.contains("<script"), "nothing from elsewhere, no script");
    assert_eq!(page.matches("<svg").count(), 2, "one curve per AU, no gaze");
    assert!(page.contains("<span class=\"not-sure\">Not sure:</span> AU05."), "{page}");
    assert!(page.contains("AU12 lip corner puller <span class=\"sure\">sure</span>"));
    assert!(page.contains("10 of 300 frames, in 1 run: 200–209 (6.67–6.97 s)"));
    assert_eq!(page.matches("<circle").count(), 1, "one peak of AU12, none of the level AU05");
}
