use super::*;
use crate::testing;
use risorius_formats::report::Collected;

fn model(width: u64, height: u64, names: &[&str]) -> Model {
    let camera = ModelCamera { model: "PINHOLE".into(), width, height, params: vec![120.0, 130.0, 40.0, 30.0] };
    let image = |(i, name): (usize, &&str)| {
        let points = vec![
            Point2d { position_px: [10.0, 20.0], point3d: Some(5) },
            Point2d { position_px: [1.0, 2.0], point3d: None },
        ];
        let pose = Isometry::new(glam::DMat3::IDENTITY, DVec3::new(i as f64, 0.0, 0.0));
        (i as u32 + 11, ModelImage { camera_from_world: pose, camera_id: 3, name: (*name).to_owned(), points })
    };
    let images: BTreeMap<u32, ModelImage> = names.iter().enumerate().map(image).collect();
    let track = images.keys().map(|&id| (id, 0)).collect();
    let point = Point3d { position: DVec3::new(0.1, 0.2, 4.0), rgb: [1, 2, 3], error_px: 0.5, track };
    Model { cameras: BTreeMap::from([(3, camera)]), images, points: BTreeMap::from([(5, point)]) }
}

fn write(dir: &Path, model: &Model) {
    std::fs::create_dir_all(dir).unwrap();
    colmap::write_text(dir, model).unwrap();
}

fn take(dir: &Path) -> Take {
    Take::open(testing::take(dir, 80, 60, 10)).unwrap()
}

#[test]
fn images_are_matched_by_their_digits_and_tracks_follow() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path().join("model");
    // Frame 7 twice, one image beyond the take, one without a number.
    write(
        &at,
        &model(80, 60, &["frame_000007.png", "a/frame_000002.png", "frame_000012.png", "face.png", "b/0007.png"]),
    );
    let heard = Collected::default();
    let found = load(&at, &take(dir.path()), 0, &heard).unwrap();
    assert_eq!(found.model.frames.keys().copied().collect::<Vec<_>>(), [2, 7]);
    assert_eq!((found.foreign_images, heard.count("duplicate-image")), (2, 1));
    assert_eq!(found.model.points[&5].track, [(8, 0), (3, 0)]);
    let out = found.model.to_colmap();
    assert_eq!(out.images[&8].name, "000007.png");
    assert_eq!(out.images[&3].camera_from_world.translation.x, 1.0);
    // Counted from 1, the same names mean the frames before.
    let found = load(&at, &take(dir.path()), 1, &heard).unwrap();
    assert_eq!(found.model.frames.keys().copied().collect::<Vec<_>>(), [1, 6]);
}

#[test]
fn the_largest_sub_model_is_taken() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path().join("colmap");
    write(&at.join("sparse/0"), &model(80, 60, &["1.png"]));
    write(&at.join("sparse/1"), &model(80, 60, &["2.png", "3.png", "4.png"]));
    write(&at.join("sparse/10"), &model(80, 60, &["5.png", "6.png"]));
    let found = load(&at, &take(dir.path()), 0, &Collected::default()).unwrap();
    assert!(found.dir.ends_with("sparse/1"));
    assert_eq!((found.candidates, found.model.frames.len()), (3, 3));
}

#[test]
fn another_resolution_is_scaled_and_another_shape_refused() {
    let dir = tempfile::tempdir().unwrap();
    let (half, wide, turned) = (dir.path().join("half"), dir.path().join("wide"), dir.path().join("turned"));
    write(&half, &model(40, 30, &["1.png"]));
    let heard = Collected::default();
    let found = load(&half, &take(dir.path()), 0, &heard).unwrap();
    let lens = found.model.lenses[&3];
    assert_eq!((lens.width, lens.fx, lens.fy, lens.cx, lens.cy), (80, 240.0, 260.0, 80.0, 60.0));
    assert_eq!(found.model.frames[&1].points[0].position_px, [20.0, 40.0]);
    assert_eq!((found.model.points[&5].error_px, heard.count("model-scaled")), (1.0, 1));
    write(&wide, &model(80, 45, &["1.png"]));
    let error = load(&wide, &take(dir.path()), 0, &heard).unwrap_err();
    assert!(matches!(error, TrackerError::CameraSize { camera: 3, width: 80, height: 45, .. }), "{error}");
    write(&turned, &model(60, 80, &["1.png"]));
    let error = load(&turned, &take(dir.path()), 0, &heard).unwrap_err();
    assert!(risorius_formats::Hint::hint(&error).unwrap().contains("rotation"), "{error}");
}

#[test]
fn folders_without_a_model_or_images_say_so() {
    let dir = tempfile::tempdir().unwrap();
    let take = take(dir.path());
    let load = |at: &Path| load(at, &take, 0, &Collected::default()).unwrap_err();
    assert!(load(&dir.path().join("nowhere")).to_string().contains("does not exist"));
    let empty = dir.path().join("empty");
    std::fs::create_dir(&empty).unwrap();
    assert!(matches!(load(&empty), TrackerError::NoModel { .. }));
    let foreign = dir.path().join("foreign");
    write(&foreign, &model(80, 60, &["100.png", "101.png"]));
    assert!(matches!(load(&foreign), TrackerError::NoModelFrame { images: 2, frames: 10, .. }));
    let none = dir.path().join("none");
    write(&none, &model(80, 60, &[]));
    // A model without images is empty whoever finds it: the codec or the matching.
    let error = load(&none);
    assert!(matches!(error, TrackerError::NoModelFrame { images: 0, .. } | TrackerError::Format(_)), "{error}");
}

#[test]
fn errors_and_depths_come_from_the_observations() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path().join("model");
    write(&at, &model(80, 60, &["0.png"]));
    let found = load(&at, &take(dir.path()), 0, &Collected::default()).unwrap();
    // (0.1, 0.2, 4) projects to (120 · 0.025 + 40, 130 · 0.05 + 30) = (43, 36.5); it was seen at (10, 20).
    let expected = 33f64.hypot(16.5);
    assert!((found.model.reprojection_error_px().unwrap() - expected).abs() < 1e-9);
    assert_eq!(found.model.point_depths(), [4.0]);
}
