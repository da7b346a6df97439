use std::path::PathBuf;

use binary::{binary_parts, parse_part};
use proptest::prelude::*;
use risorius_tests::shared;

use super::*;
use crate::camera::Distortion;
use crate::{Hint, Intrinsics};

mod binary;
mod text;

fn small_model() -> Model {
    let camera = |model: &str, params: &[f64]| ModelCamera {
        model: model.to_owned(),
        width: 540,
        height: 960,
        params: params.to_vec(),
    };
    let image = |camera_id, name: &str, points: Vec<Point2d>| ModelImage {
        camera_from_world: Isometry::from_wxyz([0.9, 0.1, -0.2, 0.3], DVec3::new(0.1, -2e-17, 3e20)),
        camera_id,
        name: name.to_owned(),
        points,
    };
    let points = vec![
        Point2d { position_px: [1.5, 2.25], point3d: Some(7) },
        Point2d { position_px: [0.1, 959.9], point3d: None },
    ];
    let point = |error_px, track| Point3d { position: DVec3::new(0.1, 0.2, -0.3), rgb: [0, 128, 255], error_px, track };
    Model {
        cameras: [
            (1, camera("PINHOLE", &[1152.0, 1150.5, 270.0, 480.0])),
            (9, camera("OPENCV", &[1.0, 2.0, 3.0, 4.0, 5e-300, 6.0, 7.0, 8.0])),
        ]
        .into(),
        images: [(3, image(9, "frame with spaces 000001.png", vec![])), (12, image(1, "a/b.png", points))].into(),
        points: [(7, point(0.5, vec![(12, 0), (3, 5)])), (u64::MAX - 1, point(-1.0, vec![]))].into(),
    }
}

#[test]
fn text_and_binary_of_the_same_model_agree() {
    let Some(dir) = shared("data/colmap/synthetic") else { return };
    let (text, binary) = (read_model(dir.join("txt")).unwrap(), read_model(dir.join("bin")).unwrap());
    assert_eq!((text.cameras.len(), text.images.len(), text.points.len()), (1, 6, 60));
    // Text has 17 digits, so that nothing is lost.
    assert_eq!(text, binary);
    let image = &text.images[&1];
    assert_eq!(image.points[0], Point2d { position_px: [450.1131246211396, 146.5719600343279], point3d: Some(44) });
    assert_eq!(image.points[1].point3d, None);
    let intrinsics = text.cameras[&1].intrinsics().unwrap();
    assert_eq!((intrinsics.fx, intrinsics.cx, intrinsics.distortion.radial[0]), (1280.0, 512.0, 0.05));
    // Points project onto their features: axes, pose and pixel convention are COLMAP's.
    let mut seen = 0;
    for image in text.images.values() {
        let camera = crate::Camera { intrinsics, camera_from_world: image.camera_from_world };
        for point in &image.points {
            let Some(id) = point.point3d else { continue };
            let offset = camera.project(text.points[&id].position) - glam::DVec2::from_array(point.position_px);
            assert!(offset.length() < 1e-6, "{offset}");
            seen += 1;
        }
    }
    assert!(seen > 300);
}

#[test]
fn the_captures_truth_reads() {
    let Some(dir) = shared("data/captures/ada/truth_colmap") else { return };
    let model = read_model(dir).unwrap();
    assert_eq!(model.images.len(), 2400);
    assert_eq!(model.images[&1].name, "frame_000000.png");
    assert!(model.images[&2].points.is_empty() && !model.images[&1].points.is_empty());
    let i = model.cameras[&1].intrinsics().unwrap();
    assert_eq!((i.width, i.height, i.fx, i.cy), (540, 960, 1152.0, 480.0));
    assert_eq!(model.points[&12].track.len(), 12);
}

#[test]
fn models_come_back_as_written() {
    let model = small_model();
    let dir = tempfile::tempdir().unwrap();
    for (name, write) in [("text", write_text as fn(PathBuf, &Model) -> Result<()>), ("binary", write_binary)] {
        write(dir.path().join(name), &model).unwrap();
        let back = read_model(dir.path().join(name)).unwrap();
        assert_same(&back, &model).unwrap();
    }
}

/// Everything bit by bit, except rotations, which pass through quaternions.
fn assert_same(a: &Model, b: &Model) -> Result<(), TestCaseError> {
    prop_assert_eq!(&a.cameras, &b.cameras);
    prop_assert_eq!(a.points.len(), b.points.len());
    for ((ia, pa), (ib, pb)) in a.points.iter().zip(&b.points) {
        prop_assert_eq!((ia, pa.position, pa.rgb, &pa.track), (ib, pb.position, pb.rgb, &pb.track));
        prop_assert_eq!(pa.error_px.to_bits(), pb.error_px.to_bits());
    }
    prop_assert_eq!(a.images.len(), b.images.len());
    for ((ia, a), (ib, b)) in a.images.iter().zip(&b.images) {
        prop_assert_eq!((ia, a.camera_id, &a.name, &a.points), (ib, b.camera_id, &b.name, &b.points));
        prop_assert_eq!(a.camera_from_world.translation, b.camera_from_world.translation);
        let turn = a.camera_from_world.rotation - b.camera_from_world.rotation;
        prop_assert!(turn.to_cols_array().iter().all(|v| v.abs() < 1e-14));
    }
    Ok(())
}

#[test]
fn intrinsics_follow_the_model() {
    let camera = |model: &str, params: &[f64]| ModelCamera {
        model: model.to_owned(),
        width: 8,
        height: 6,
        params: params.to_vec(),
    };
    let full =
        camera("FULL_OPENCV", &[1.0, 2.0, 3.0, 4.0, 0.1, 0.2, 0.5, 0.6, 0.3, 0.7, 0.8, 0.9]).intrinsics().unwrap();
    let distortion =
        Distortion { radial: [0.1, 0.2, 0.3], radial_denominator: [0.7, 0.8, 0.9], tangential: [0.5, 0.6] };
    assert_eq!(full, Intrinsics { width: 8, height: 6, fx: 1.0, fy: 2.0, cx: 3.0, cy: 4.0, skew: 0.0, distortion });
    for model in CAMERA_MODELS {
        assert_eq!(CameraModel::by_id(model.id), Some(model));
        assert_eq!(CameraModel::by_name(model.name), Some(model));
        let result = camera(model.name, &vec![0.5; model.param_count]).intrinsics();
        let perspective = matches!(model.id, 0..=4 | 6);
        assert_eq!(result.is_ok(), perspective, "{}", model.name);
        match result {
            // What is read can be written again and means the same.
            Ok(intrinsics) => assert_eq!(ModelCamera::from_intrinsics(&intrinsics).intrinsics().unwrap(), intrinsics),
            Err(error) => {
                assert_eq!(error.kind(), ErrorKind::Unsupported);
                assert!(error.hint().unwrap().contains("image_undistorter"));
            }
        }
        let short = camera(model.name, &vec![0.5; model.param_count - 1]);
        assert!(short.intrinsics().is_err());
        assert!(cameras_to_binary(&[(1, short)].into()).is_err());
    }
    for broken in [
        ModelCamera { width: 0, ..camera("PINHOLE", &[1.0; 4]) },
        ModelCamera { height: 1 << 40, ..camera("PINHOLE", &[1.0; 4]) },
        camera("PINHOLE", &[0.0, 1.0, 1.0, 1.0]),
        camera("PINHOLE", &[1.0, 1.0, f64::NAN, 1.0]),
    ] {
        assert_eq!(broken.intrinsics().unwrap_err().kind(), ErrorKind::Inconsistent);
    }
}

#[test]
fn the_simplest_model_is_chosen() {
    let base = Intrinsics::pinhole(8, 6, 5.0);
    let with = |fy: f64, radial: [f64; 3], k4: f64, p1: f64| {
        let distortion = Distortion { radial, radial_denominator: [k4, 0.0, 0.0], tangential: [p1, 0.0] };
        ModelCamera::from_intrinsics(&Intrinsics { fy, distortion, ..base }).model
    };
    assert_eq!(with(5.0, [0.0; 3], 0.0, 0.0), "SIMPLE_PINHOLE");
    assert_eq!(with(6.0, [0.0; 3], 0.0, 0.0), "PINHOLE");
    assert_eq!(with(5.0, [0.1, 0.0, 0.0], 0.0, 0.0), "SIMPLE_RADIAL");
    assert_eq!(with(5.0, [0.0, 0.1, 0.0], 0.0, 0.0), "RADIAL");
    assert_eq!(with(6.0, [0.1, 0.0, 0.0], 0.0, 0.0), "OPENCV");
    assert_eq!(with(5.0, [0.0; 3], 0.0, 0.1), "OPENCV");
    assert_eq!(with(5.0, [0.0, 0.0, 0.1], 0.0, 0.0), "FULL_OPENCV");
    assert_eq!(with(5.0, [0.0; 3], 0.1, 0.0), "FULL_OPENCV");
}

#[test]
fn folders_without_a_whole_model_are_errors_with_advice() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path();
    assert_eq!(read_model(root.join("nowhere")).unwrap_err().kind(), ErrorKind::Io);
    let error = read_model(root).unwrap_err();
    assert_eq!((error.kind(), error.path()), (ErrorKind::Missing, Some(root)));
    assert!(error.hint().unwrap().contains("sparse/0"));
    let model = small_model();
    write_binary(root.join("sparse/0"), &model).unwrap();
    assert!(read_model(root).unwrap_err().hint().unwrap().contains("there is a model in"));
    std::fs::remove_file(root.join("sparse/0/points3D.bin")).unwrap();
    let error = read_model(root.join("sparse/0")).unwrap_err();
    assert_eq!((error.kind(), error.path()), (ErrorKind::Io, Some(root.join("sparse/0/points3D.bin").as_path())));
    // Text wins where both are, and an error names the file and the line.
    write_text(root.join("sparse/0"), &model).unwrap();
    read_model(root.join("sparse/0")).unwrap();
    std::fs::write(root.join("sparse/0/points3D.txt"), "oops\n").unwrap();
    let error = read_model(root.join("sparse/0")).unwrap_err();
    assert!(
        error.to_string().ends_with("points3D.txt:1: column `POINT3D_ID`: expected a whole number, found `oops`"),
        "{error}"
    );

    let write = |name: &str, model: &Model| {
        write_text(root.join(name), model).unwrap();
        read_model(root.join(name)).unwrap_err()
    };
    let error = write("empty", &Model { images: BTreeMap::new(), ..model.clone() });
    assert_eq!(error.kind(), ErrorKind::Empty);
    let mut dangling = model.clone();
    dangling.cameras.remove(&9);
    let error = write("dangling", &dangling);
    assert_eq!(error.kind(), ErrorKind::Inconsistent);
    assert!(error.to_string().contains("camera `9`"), "{error}");
    // Observations of what is not there are harmless.
    let mut thinned = model;
    thinned.points.clear();
    write_text(root.join("thinned"), &thinned).unwrap();
    assert_eq!(read_model(root.join("thinned")).unwrap().images.len(), 2);
}

#[test]
fn names_that_a_file_cannot_hold_leave_nothing_behind() {
    let dir = tempfile::tempdir().unwrap();
    let mut model = small_model();
    for name in ["", "a\nb", " a", "a\0"] {
        model.images.get_mut(&3).unwrap().name = name.to_owned();
        assert_eq!(write_text(dir.path().join("m"), &model).unwrap_err().kind(), ErrorKind::Unsupported, "{name:?}");
    }
    assert_eq!(write_binary(dir.path().join("m"), &model).unwrap_err().kind(), ErrorKind::Unsupported);
    assert!(!dir.path().join("m").exists());
}

fn finite() -> impl Strategy<Value = f64> {
    any::<f64>().prop_filter("finite", |v| v.is_finite())
}

fn any_model() -> impl Strategy<Value = Model> {
    let camera = (0usize..18, any::<u64>(), any::<u64>(), prop::collection::vec(finite(), 16)).prop_map(
        |(m, width, height, mut params)| {
            params.truncate(CAMERA_MODELS[m].param_count);
            ModelCamera { model: CAMERA_MODELS[m].name.to_owned(), width, height, params }
        },
    );
    let feature = ([finite(), finite()], prop::option::of(0..u64::MAX))
        .prop_map(|(position_px, point3d)| Point2d { position_px, point3d });
    let wxyz =
        prop::array::uniform4(-1.0f64..1.0).prop_filter("long enough", |q| q.iter().map(|v| v * v).sum::<f64>() > 0.01);
    let image = (
        wxyz,
        [finite(), finite(), finite()],
        any::<u32>(),
        "[a-z0-9_/.äß]{1,9}( [a-z]{1,3})?",
        prop::collection::vec(feature, 0..5),
    )
        .prop_map(|(q, t, camera_id, name, points)| ModelImage {
            camera_from_world: Isometry::from_wxyz(q, DVec3::from_array(t)),
            camera_id,
            name,
            points,
        });
    let point =
        ([finite(), finite(), finite()], any::<[u8; 3]>(), finite(), prop::collection::vec(any::<(u32, u32)>(), 0..5))
            .prop_map(|(p, rgb, error_px, track)| Point3d { position: DVec3::from_array(p), rgb, error_px, track });
    (
        prop::collection::btree_map(any::<u32>(), camera, 0..4),
        prop::collection::btree_map(any::<u32>(), image, 0..4),
        prop::collection::btree_map(any::<u64>(), point, 0..4),
    )
        .prop_map(|(cameras, images, points)| Model { cameras, images, points })
}

proptest! {
    #[test]
    fn any_model_comes_back_from_text_and_binary(model in any_model()) {
        let text = Model {
            cameras: parse_cameras_text(&cameras_to_text(&model.cameras)).unwrap(),
            images: parse_images_text(&images_to_text(&model.images).unwrap()).unwrap(),
            points: parse_points_text(&points_to_text(&model.points)).unwrap(),
        };
        assert_same(&text, &model)?;
        let [cameras, images, points] = binary_parts(&model);
        let binary = Model {
            cameras: parse_cameras_binary(&cameras).unwrap(),
            images: parse_images_binary(&images).unwrap(),
            points: parse_points_binary(&points).unwrap(),
        };
        // Both go through the same quaternion, so that here even rotations agree bit by bit.
        prop_assert_eq!(text, binary);
    }

    #[test]
    fn no_bytes_make_it_panic(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        (0..3).for_each(|part| drop(parse_part(part, &bytes)));
        let _ = (parse_cameras_text(&bytes), parse_images_text(&bytes), parse_points_text(&bytes));
    }

    #[test]
    fn damaged_models_parse_or_say_where(
        damage in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..8), text in any::<bool>(),
    ) {
        let model = small_model();
        let spoil = |mut bytes: Vec<u8>| {
            for (at, byte) in &damage {
                let at = at.index(bytes.len());
                bytes[at] = *byte;
            }
            bytes
        };
        if text {
            let error = [
                parse_cameras_text(&spoil(cameras_to_text(&model.cameras))).err(),
                parse_images_text(&spoil(images_to_text(&model.images).unwrap())).err(),
                parse_points_text(&spoil(points_to_text(&model.points))).err(),
            ];
            prop_assert!(error.iter().flatten().all(|e| e.line().is_some()));
        } else {
            for (part, bytes) in binary_parts(&model).into_iter().enumerate() {
                if let Err(error) = parse_part(part, &spoil(bytes)) {
                    prop_assert!(error.to_string().starts_with("byte "), "{}", error);
                }
            }
        }
    }
}
