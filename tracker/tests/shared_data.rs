//! Import and poses on the development data: a capture with exact truth and two real clips.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]
#![allow(clippy::print_stderr, reason = "a skipped test says so")]

use std::fs;
use std::path::PathBuf;

use risorius_formats::report::Collected;
use risorius_formats::{FrameIndex, colmap};
use risorius_tracker::check::{self, Reference};
use risorius_tracker::import::{ImportOptions, import};
use risorius_tracker::poses::colmap::ColmapOptions;
use risorius_tracker::poses::head::{HeadOptions, SMOOTH_SECS};
use risorius_tracker::poses::{self, Numbering, PosesOptions, Source, interpolate::MAX_GAP_SECS};
use testing::take_at;

#[path = "../src/testing.rs"]
#[expect(dead_code, reason = "the crate's own tests use all of it")]
mod testing;

fn shared(path: &str) -> Option<PathBuf> {
    risorius_tests::shared(&format!("data/{path}"))
}

fn options(source: Source, correct_by_landmarks: bool) -> PosesOptions {
    PosesOptions {
        source,
        min_confidence: 0.8,
        max_gap_secs: MAX_GAP_SECS,
        accept_poor: false,
        eye_distance_mm: None,
        follow: true,
        correct_by_landmarks,
    }
}

fn head_options(refine: bool) -> HeadOptions {
    HeadOptions { focal_px: None, smooth_secs: SMOOTH_SECS, refine, min_confidence: 0.8 }
}

#[test]
fn key_frames_and_landmarks_place_every_frame_of_ada() {
    let Some(ada) = shared("captures/ada") else { return };
    let dir = tempfile::tempdir().unwrap();
    let take = take_at(dir.path(), 540, 960, 2400, 120.0);
    let summary = import(&take, &ImportOptions::new(ada.join("openface.csv")), &Collected::default()).unwrap();
    // The README names the ten lost frames.
    assert_eq!(summary.quality.lost_runs, [[85, 87], [1244, 1244], [1723, 1723], [1974, 1976], [2222, 2223]]);
    assert!(summary.quality.still_units.is_empty());
    assert!((summary.table_focal_px.unwrap() - 1152.0).abs() < 5.0);
    // Every 30th pose of the truth, a quarter of a second apart, as from COLMAP.
    let mut model = colmap::read_model(ada.join("truth_colmap")).unwrap();
    model.images.retain(|_, image| FrameIndex::from_image_name(&image.name, 0).unwrap().0.is_multiple_of(30));
    for image in model.images.values_mut() {
        image.points.clear();
    }
    model.points.clear();
    let keys = dir.path().join("keys");
    fs::create_dir(&keys).unwrap();
    colmap::write_text(&keys, &model).unwrap();
    let truth = Reference { dir: ada.join("truth_colmap"), numbering: Numbering::default() };
    let errors = |correct| {
        let source = Source::Model { dir: keys.clone(), numbering: Numbering::default() };
        let report = poses::find(&take, &options(source, correct), &Collected::default()).unwrap();
        // The last key frame is 2370; nothing is extrapolated.
        assert_eq!((report.frames_registered, report.frames_interpolated), (80, 2371 - 80));
        check::check(&take, Some(&truth), &Collected::default()).unwrap().reference.unwrap().interpolated.unwrap()
    };
    let (spline, corrected) = (errors(false), errors(true));
    assert!(spline.rotation_deg.mean < 0.3 && spline.position.mean < 0.003, "{spline:?}");
    assert!(corrected.rotation_deg.mean < 0.2 && corrected.face_shift_px.mean < 0.6, "{corrected:?}");
    assert!(corrected.face_shift_px.mean < 0.25 * spline.face_shift_px.mean, "{spline:?} {corrected:?}");
}

/// A take of ada with its video; `None` without the data.
fn ada_with_video(dir: &std::path::Path) -> Option<(PathBuf, Reference)> {
    let ada = shared("captures/ada")?;
    let take = take_at(dir, 540, 960, 2400, 120.0);
    std::os::unix::fs::symlink(ada.join("video.mp4"), take.join("video.mp4")).unwrap();
    import(&take, &ImportOptions::new(ada.join("openface.csv")), &Collected::default()).unwrap();
    Some((take, Reference { dir: ada.join("truth_colmap"), numbering: Numbering::default() }))
}

#[test]
fn real_colmap_and_patches_place_every_frame_of_ada_to_a_twentieth_of_a_degree() {
    if std::process::Command::new("colmap").arg("help").output().is_err() {
        eprintln!("SKIPPED: there is no `colmap` here");
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let Some((take, truth)) = ada_with_video(dir.path()) else { return };
    let source = Source::Auto(ColmapOptions::default(), head_options(true));
    let mut options = options(source, true);
    options.eye_distance_mm = Some(63.0);
    let report = poses::find(&take, &options, &Collected::default()).unwrap();
    assert_eq!(report.frames_registered + report.frames_followed, 2400, "{report:?}");
    assert!(report.problems.is_empty() && report.notes[0].contains("the camera moves"), "{:?}", report.notes);
    let errors = check::check(&take, Some(&truth), &Collected::default()).unwrap().reference.unwrap();
    // 0.2 % of the path's radius, 281 mm, is 0.56 mm.
    assert!(errors.all.rotation_deg.mean < 0.05 && errors.all.position.mean < 0.000_56, "{errors:?}");
    let own = colmap::read_model(take.join("poses/sparse")).unwrap();
    let focal = own.cameras.values().next().unwrap().intrinsics().unwrap().fx;
    assert!((focal / 1152.0 - 1.0).abs() < 0.005, "{focal}");
    // By the pupils' distance the world is in metres: a person's differs from 63 mm by some percent.
    assert!(report.units_per_metre == Some(1.0) && (errors.scale - 1.0).abs() < 0.15, "{errors:?}");
    let svg = fs::read_to_string(take.join("poses/report.svg")).unwrap();
    assert!(svg.contains("from above") && svg.contains("image/jpeg") && !take.join(".poses-work").exists());
}

#[test]
fn the_skin_places_the_head_of_ada() {
    let dir = tempfile::tempdir().unwrap();
    let Some((take, truth)) = ada_with_video(dir.path()) else { return };
    let report = poses::find(&take, &options(Source::Head(head_options(true)), true), &Collected::default()).unwrap();
    assert!(report.notes.iter().any(|n| n.contains("on the skin")), "{:?}", report.notes);
    let errors = check::check(&take, Some(&truth), &Collected::default()).unwrap().reference.unwrap().all;
    assert!(errors.rotation_deg.mean < 2.0, "{errors:?}");
}

#[test]
fn the_head_route_beats_the_tables_own_poses_on_ada() {
    let Some(ada) = shared("captures/ada") else { return };
    let dir = tempfile::tempdir().unwrap();
    let take = take_at(dir.path(), 540, 960, 2400, 120.0);
    import(&take, &ImportOptions::new(ada.join("openface.csv")), &Collected::default()).unwrap();
    let truth = Reference { dir: ada.join("truth_colmap"), numbering: Numbering::default() };
    let errors = |refine| {
        poses::find(&take, &options(Source::Head(head_options(refine)), true), &Collected::default()).unwrap();
        check::check(&take, Some(&truth), &Collected::default()).unwrap().reference.unwrap().all
    };
    let (table, refined) = (errors(false), errors(true));
    assert!(
        refined.rotation_deg.mean < 0.6 && refined.rotation_deg.mean < table.rotation_deg.mean,
        "{table:?} {refined:?}"
    );
}

#[test]
fn the_head_route_fits_real_clips_better_than_the_tables_poses() {
    for (name, size, frames) in [("d6", 480, 1008), ("d3", 512, 354)] {
        let Some(table) = shared(&format!("video/liveportrait_driving_{name}.openface.csv")) else { return };
        let dir = tempfile::tempdir().unwrap();
        let take = take_at(dir.path(), size, size, frames, 30.0);
        let summary = import(&take, &ImportOptions::new(table), &Collected::default()).unwrap();
        let still: Vec<String> = summary.quality.still_units.iter().map(ToString::to_string).collect();
        assert!(still.contains(&"AU06".to_owned()) && still.contains(&"AU09".to_owned()), "{still:?}");
        let error = |refine| {
            let source = Source::Head(head_options(refine));
            poses::find(&take, &options(source, true), &Collected::default()).unwrap().landmark_error_px.unwrap()
        };
        let (before, after) = (error(false), error(true));
        assert!(after < before, "{name}: {before} {after}");
    }
}
