//! COLMAP models that went to the wrong frames, with the right ones: names, numbers, gaps, steps, folders, lenses.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use risorius_formats::colmap::{self, Model};
use risorius_formats::pose_report::PoseReport;
use risorius_formats::report::Collected;
use risorius_formats::take::SourceKind;
use risorius_formats::{FrameIndex, Hint, TakeManifest};
use risorius_tracker::TrackerError;
use risorius_tracker::import::{ImportOptions, import};
use risorius_tracker::poses::{self, Numbering, PosesOptions, Source, interpolate::MAX_GAP_SECS};
use testing::take_at;

#[path = "../src/testing.rs"]
#[expect(dead_code, reason = "the crate's own tests use all of it")]
mod testing;

fn shared(path: &str) -> Option<PathBuf> {
    risorius_tests::shared(&format!("data/{path}"))
}

fn options(dir: &Path, numbering: Numbering) -> PosesOptions {
    PosesOptions {
        source: Source::Model { dir: dir.to_owned(), numbering },
        min_confidence: 0.8,
        max_gap_secs: MAX_GAP_SECS,
        accept_poor: false,
        eye_distance_mm: None,
        follow: false,
        correct_by_landmarks: false,
    }
}

#[expect(clippy::result_large_err, reason = "the error is looked at, not passed around")]
fn find(take: &Path, model: &Path, numbering: Numbering) -> Result<PoseReport, TrackerError> {
    poses::find(take, &options(model, numbering), &Collected::default())
}

/// Every 40th frame of `ada` at 30 a second, 60 of them, with the table `name` of the field data.
fn mini(dir: &Path, frames: u32, table: &str) -> Option<PathBuf> {
    let table = shared(&format!("field/{table}"))?;
    let take = take_at(dir, 540, 960, frames, 30.0);
    import(&take, &ImportOptions::new(table), &Collected::default()).unwrap();
    Some(take)
}

/// The largest distance between cameras of the take and those of `truth`, by frame, as far as they were placed.
fn worst(take: &Path, truth: &BTreeMap<u32, [f64; 3]>) -> (f64, usize) {
    let own = colmap::read_model(take.join("poses/sparse")).unwrap();
    let mut most = 0.0f64;
    for image in own.images.values() {
        let frame = FrameIndex::from_image_name(&image.name, 0).unwrap().0;
        if let Some(there) = truth.get(&frame) {
            let here = image.camera_from_world.camera_center().to_array();
            most = here.iter().zip(there).map(|(a, b)| (a - b).abs()).fold(most, f64::max);
        }
    }
    (most, own.images.len())
}

/// The places of a model's cameras, by the frame that `frame_of` makes of an image's name.
fn places(model: &Model, frame_of: impl Fn(&str) -> u32) -> BTreeMap<u32, [f64; 3]> {
    model.images.values().map(|i| (frame_of(&i.name), i.camera_from_world.camera_center().to_array())).collect()
}

fn number(name: &str) -> u32 {
    FrameIndex::from_image_name(name, 0).unwrap().0
}

#[test]
fn numbers_from_1_and_a_camera_s_counter_are_understood() {
    for (name, first) in [("ffmpeg1", 1), ("dsc", 451)] {
        let dir = tempfile::tempdir().unwrap();
        let Some(model) = shared(&format!("field/colmap-names/{name}")) else { return };
        let Some(take) = mini(dir.path(), 60, "colmap-names/openface.csv") else { return };
        let report = find(&take, &model, Numbering::default()).unwrap();
        let truth = places(&colmap::read_model(&model).unwrap(), |n| number(n) - first);
        let exact = |(off, placed): (f64, usize)| off < 1e-9 && placed == 60;
        assert!(exact(worst(&take, &truth)), "{name}");
        assert!((report.landmark_error_px.unwrap() - 0.96).abs() < 0.05, "{name}: {:?}", report.landmark_error_px);
        assert!(report.notes.iter().any(|n| n.contains(&format!("counted from {first}"))), "{:?}", report.notes);
        // What is stated counts: the same by a stated first number, and a wrong one does not go through.
        find(&take, &model, Numbering::from_first(first)).unwrap();
        let error = find(&take, &model, Numbering::from_first(first - 1)).unwrap_err();
        assert!(matches!(error, TrackerError::WorsePoses { .. } | TrackerError::PoorPoses { .. }), "{name}: {error}");
        assert!(exact(worst(&take, &truth)), "{name}: good poses are kept");
    }
}

#[test]
fn every_eighth_picture_and_one_picture_s_shift_of_ada_are_found() {
    let Some(ada) = shared("captures/ada") else { return };
    let exact = colmap::read_model(ada.join("truth_colmap")).unwrap();
    let truth = places(&exact, number);
    for (step, name) in [(8u32, "every eighth"), (1, "all, from 1"), (30, "every thirtieth")] {
        let dir = tempfile::tempdir().unwrap();
        let take = take_at(dir.path(), 540, 960, 2400, 120.0);
        import(&take, &ImportOptions::new(ada.join("openface.csv")), &Collected::default()).unwrap();
        let mut model = exact.clone();
        model.points.clear();
        model.images.retain(|_, image| number(&image.name).is_multiple_of(step));
        for image in model.images.values_mut() {
            image.name = format!("frame_{:05}.png", number(&image.name) / step + 1);
            image.points.clear();
        }
        let at = dir.path().join("model");
        fs::create_dir(&at).unwrap();
        colmap::write_text(&at, &model).unwrap();
        let report = find(&take, &at, Numbering::default()).unwrap();
        assert_eq!(report.frames_registered, 2400 / step, "{name}");
        let (off, placed) = worst(&take, &truth);
        // Frames between are interpolated.
        let bound = if step == 1 { 1e-9 } else { 0.01 };
        assert!(off < bound && placed as u32 >= 2400 - step, "{name}: {off} {placed}");
        assert!(report.landmark_error_px.unwrap() < 1.3, "{name}: {:?}", report.landmark_error_px);
        // The step can be stated; a wrong one is refused and leaves the poses alone.
        let stated = Numbering { first: Some(1), step: Some(f64::from(step)), folder: None };
        find(&take, &at, stated).unwrap();
        let wrong = Numbering { first: Some(1), step: Some(f64::from(step + 3)), folder: None };
        let before = fs::read(take.join("poses/report.json")).unwrap();
        assert!(find(&take, &at, wrong).is_err(), "{name}");
        assert_eq!(fs::read(take.join("poses/report.json")).unwrap(), before, "{name}");
    }
}

#[test]
fn pictures_of_a_folder_with_gaps_get_the_cameras_of_their_files() {
    let dir = tempfile::tempdir().unwrap();
    let Some(model) = shared("field/image-gaps/model") else { return };
    let numbers: Vec<u32> = (0..60).filter(|n| ![3, 4, 20, 21, 22, 40].contains(n)).collect();
    let Some(take) = mini(dir.path(), numbers.len() as u32, "image-gaps/gaps.csv") else { return };
    let mut manifest = TakeManifest::parse(&fs::read_to_string(take.join("take.toml")).unwrap()).unwrap();
    (manifest.source, manifest.media) = (SourceKind::Images, "images".into());
    manifest.write(take.join("take.toml")).unwrap();
    fs::create_dir(take.join("images")).unwrap();
    for n in &numbers {
        image::RgbImage::new(54, 96).save(take.join(format!("images/frame_{n:06}.jpg"))).unwrap();
    }
    let report = find(&take, &model, Numbering::default()).unwrap();
    let frame_of = |name: &str| numbers.iter().position(|n| *n == number(name)).unwrap() as u32;
    let truth = places(&colmap::read_model(&model).unwrap(), frame_of);
    let (off, placed) = worst(&take, &truth);
    assert!(off < 1e-9 && placed == 54, "{off} {placed}");
    assert_eq!((report.frames_registered, report.frames_interpolated), (54, 0));
    assert!(report.landmark_error_px.unwrap() < 1.3, "{:?}", report.landmark_error_px);
}

#[test]
fn of_two_captures_in_one_model_the_one_that_fits_is_taken() {
    let dir = tempfile::tempdir().unwrap();
    let Some(model) = shared("field/two-captures/model") else { return };
    let Some(take) = mini(dir.path(), 60, "colmap-names/openface.csv") else { return };
    let report = find(&take, &model, Numbering::default()).unwrap();
    assert_eq!(report.frames_registered, 60);
    assert!(report.landmark_error_px.unwrap() < 1.5, "{:?}", report.landmark_error_px);
    assert!(report.notes.iter().any(|n| n.contains("`DJI_0286`")), "{:?}", report.notes);
    let wrong = Numbering { folder: Some("DJI_0238".into()), ..Numbering::from_first(0) };
    assert!(find(&take, &model, wrong).is_err());
}

#[test]
fn lenses_that_datasets_cannot_hold_are_refused_by_name() {
    let dir = tempfile::tempdir().unwrap();
    let (Some(full), Some(images)) = (shared("field/full-opencv/cameras.txt"), shared("field/colmap-names/ffmpeg1"))
    else {
        return;
    };
    let Some(take) = mini(dir.path(), 60, "colmap-names/openface.csv") else { return };
    let model = dir.path().join("model");
    fs::create_dir(&model).unwrap();
    fs::write(model.join("cameras.txt"), fs::read(full).unwrap()).unwrap();
    for name in ["images.txt", "points3D.txt"] {
        fs::write(model.join(name), fs::read(images.join(name)).unwrap()).unwrap();
    }
    let error = find(&take, &model, Numbering::default()).unwrap_err();
    assert!(error.to_string().contains("FULL_OPENCV") && error.to_string().contains("k4 to k6"), "{error}");
    assert!(error.hint().unwrap().contains("--ImageReader.camera_model OPENCV"));
    // Without k4 to k6 it is OPENCV with k3.
    let text = fs::read_to_string(model.join("cameras.txt")).unwrap();
    let harmless = text.trim().rsplitn(4, ' ').last().unwrap().to_owned() + " 0 0 0\n";
    fs::write(model.join("cameras.txt"), harmless).unwrap();
    let outcome = find(&take, &model, Numbering::default());
    assert!(!matches!(outcome, Err(TrackerError::LensModel { .. })), "{outcome:?}");
}

#[test]
fn the_newer_of_two_models_in_a_folder_is_read() {
    let dir = tempfile::tempdir().unwrap();
    let Some(good) = shared("field/colmap-names/ffmpeg1") else { return };
    let Some(take) = mini(dir.path(), 60, "colmap-names/openface.csv") else { return };
    let model = dir.path().join("model");
    fs::create_dir(&model).unwrap();
    let whole = colmap::read_model(&good).unwrap();
    let mut stale = whole.clone();
    stale.images.retain(|id, _| *id <= 30);
    colmap::write_text(&model, &stale).unwrap();
    colmap::write_binary(&model, &whole).unwrap();
    let age = |ending: &str, secs: u64| {
        for name in ["cameras", "images", "points3D"] {
            let file = fs::File::options().write(true).open(model.join(format!("{name}.{ending}"))).unwrap();
            file.set_modified(std::time::UNIX_EPOCH + std::time::Duration::from_secs(secs)).unwrap();
        }
    };
    for (text, binary, images) in [(1000, 2000, 60), (2000, 1000, 30)] {
        age("txt", text);
        age("bin", binary);
        let heard = Collected::default();
        let mut options = options(&model, Numbering::default());
        options.accept_poor = true;
        let report = poses::find(&take, &options, &heard).unwrap();
        assert_eq!((report.frames_registered, heard.count("two-models")), (images, 1));
    }
}
