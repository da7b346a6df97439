use super::*;
use crate::se3::{self, Twist};
use crate::testing;
use glam::DVec2;
use risorius_formats::colmap::{Model, ModelCamera, ModelImage};
use risorius_formats::report::Collected;
use risorius_formats::{Camera, FrameIndex, Intrinsics, Isometry, Landmarks68, TrackRow};

fn lens() -> Intrinsics {
    Intrinsics::pinhole(320, 240, 300.0)
}

/// A camera on a constant twist around a head at the world's origin.
fn pose(i: u32) -> Isometry {
    let start = Isometry::new(glam::DMat3::IDENTITY, DVec3::new(0.0, 0.0, 0.6));
    let t = (f64::from(i) - 30.0) / 25.0;
    // A turn of the world, seen by the camera: an orbit.
    start.compose(&se3::exp(Twist::from_array([0.05 * t, 0.3 * t, 0.0, 0.0, 0.0, 0.0])))
}

fn face(k: usize) -> DVec3 {
    let t = k as f64;
    DVec3::new((t * 1.7).sin() * 0.07, (t * 0.9).cos() * 0.08, (t * 2.3).sin() * 0.04)
}

fn take(dir: &Path, landmarks: bool) -> PathBuf {
    let path = testing::take(dir, 320, 240, 61);
    let row = |i: u32| TrackRow {
        frame: FrameIndex(i),
        face_id: 0,
        timestamp_secs: Some(f64::from(i) / 25.0),
        confidence: 0.98,
        success: true,
        intensities: vec![Some(1.0)],
        presences: vec![],
        landmarks: landmarks.then(|| {
            let camera = Camera { intrinsics: lens(), camera_from_world: pose(i) };
            let points_px = std::array::from_fn(|k| {
                let p: DVec2 = camera.project(face(k));
                [p.x as f32, p.y as f32]
            });
            Box::new(Landmarks68 { points_px })
        }),
        landmarks_in_camera_mm: None,
        head_pose: None,
    };
    let track = Track {
        units: vec![risorius_formats::ActionUnit(12)],
        presence_units: vec![],
        rows: (0..61).map(row).collect(),
    };
    openface::write(path.join("track/openface.csv"), &track).unwrap();
    path
}

fn write_model(dir: &Path, frames: impl Iterator<Item = u32>) {
    let image = |i: u32| ModelImage {
        camera_from_world: pose(i),
        camera_id: 1,
        name: format!("frame_{i:06}.png"),
        points: vec![],
    };
    let images = frames.map(|i| (i + 1, image(i))).collect();
    fs::create_dir_all(dir).unwrap();
    let model = Model { cameras: [(1, ModelCamera::from_intrinsics(&lens()))].into(), images, points: [].into() };
    colmap_format::write_text(dir, &model).unwrap();
}

fn options(dir: PathBuf) -> PosesOptions {
    PosesOptions {
        source: Source::Model { dir, numbering: Numbering::default() },
        min_confidence: 0.8,
        max_gap_secs: interpolate::MAX_GAP_SECS,
        accept_poor: false,
        eye_distance_mm: None,
        follow: false,
        correct_by_landmarks: false,
    }
}

#[test]
fn a_sparse_model_becomes_poses_for_all_frames() {
    let dir = tempfile::tempdir().unwrap();
    let take = take(dir.path(), true);
    let model = dir.path().join("model");
    write_model(&model, (0..61).step_by(10));
    let report = find(&take, &options(model), &Collected::default()).unwrap();
    assert_eq!((report.frames_registered, report.frames_interpolated, report.frames), (7, 54, 61));
    assert_eq!(report.interpolated_runs.len(), 6);
    // Landmarks are stored with a tenth of a pixel: 0.2 mm here.
    for (k, p) in report.landmarks_in_world.iter().enumerate() {
        assert!(p.distance(face(k)) < 1e-3, "{k}: {p}");
    }
    assert!((report.head_radius - 0.1).abs() < 0.03);
    let [lo, hi] = report.head_depth;
    assert!(lo > 0.45 && hi < 0.75 && (report.near - 0.8 * lo).abs() < 1e-12 && report.far > hi);
    let written = colmap_format::read_model(take.join("poses/sparse")).unwrap();
    assert_eq!(written.images.len(), 61);
    let worst = written.images.values().map(|image| {
        let frame = FrameIndex::from_image_name(&image.name, 0).unwrap().0;
        image.camera_from_world.camera_center().distance(pose(frame).camera_center())
    });
    assert!(worst.fold(0.0, f64::max) < 1e-6);
    let read = PoseReport::read(take.join("poses/report.json")).unwrap();
    assert!((read.near - report.near).abs() < 1e-15 && read.interpolated_runs == report.interpolated_runs);
    assert!(read.landmarks_in_world.iter().zip(&report.landmarks_in_world).all(|(a, b)| a.distance(*b) < 1e-15));
}

#[test]
fn failures_leave_older_poses_alone() {
    let dir = tempfile::tempdir().unwrap();
    let take = take(dir.path(), true);
    let model = dir.path().join("model");
    write_model(&model, 0..61);
    find(&take, &options(model), &Collected::default()).unwrap();
    let before = fs::read(take.join("poses/report.json")).unwrap();
    let error = find(&take, &options(dir.path().join("nowhere")), &Collected::default()).unwrap_err();
    assert!(error.to_string().contains("nowhere"));
    assert_eq!(fs::read(take.join("poses/report.json")).unwrap(), before);
    let names: Vec<_> = fs::read_dir(&take).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert!(names.iter().all(|n| !n.to_string_lossy().ends_with(".part")), "{names:?}");
}

#[test]
fn a_camera_that_does_not_move_or_a_missing_track_is_told() {
    let dir = tempfile::tempdir().unwrap();
    let model = dir.path().join("model");
    write_model(&model, 29..31);
    let error = find(take(dir.path(), true), &options(model.clone()), &Collected::default()).unwrap_err();
    assert!(matches!(error, TrackerError::TooLittleParallax { .. }), "{error}");
    let bare = testing::take(&dir.path().join("bare"), 320, 240, 61);
    assert!(matches!(find(&bare, &options(model), &Collected::default()).unwrap_err(), TrackerError::NoTrack { .. }));
}

#[test]
fn what_colmap_said_is_kept_when_it_failed_and_older_poses_stay() {
    use std::os::unix::fs::PermissionsExt;
    let dir = tempfile::tempdir().unwrap();
    let take = take(dir.path(), true);
    let model = dir.path().join("model");
    write_model(&model, 0..61);
    find(&take, &options(model), &Collected::default()).unwrap();
    let program = dir.path().join("colmap");
    fs::write(&program, "#!/bin/sh\necho 'COLMAP 3.8 -- fake'\n").unwrap();
    fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).unwrap();
    // The take has no video: the key frames cannot be extracted.
    let source = Source::Colmap(ColmapOptions { program, ..ColmapOptions::default() });
    let options = PosesOptions { source, ..options(PathBuf::new()) };
    let error = find(&take, &options, &Collected::default()).unwrap_err();
    assert!(matches!(error, TrackerError::Video(_)), "{error}");
    assert!(fs::read_to_string(take.join("poses/colmap.log")).unwrap().contains("COLMAP 3.8"));
    assert!(take.join("poses/report.json").is_file() && take.join("poses/sparse/images.txt").is_file());
}
