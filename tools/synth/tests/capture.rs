//! A small capture from end to end, read back through the formats.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::fs;
use std::path::Path;

use glam::DVec2;
use risorius_formats::au::OPENFACE_INTENSITIES;
use risorius_formats::mask::LabelImage;
use risorius_formats::views::ViewList;
use risorius_formats::{Camera, FrameIndex, Silent, colmap, openface};
use risorius_synth::{Person, Scene, Script, Settings, SynthError, capture_shots, generate, landmarks_in_camera};

fn settings() -> Settings {
    Settings { frames: 36, width: 90, height: 160, driver: true, ..Settings::default() }
}

fn bytes_of(dir: &Path, into: &mut Vec<(String, Vec<u8>)>, prefix: &str) {
    let mut entries: Vec<_> = fs::read_dir(dir).unwrap().map(|e| e.unwrap().path()).collect();
    entries.sort();
    for path in entries {
        let name = format!("{prefix}/{}", path.file_name().unwrap().to_string_lossy());
        if path.is_dir() {
            bytes_of(&path, into, &name);
        } else {
            into.push((name, fs::read(&path).unwrap()));
        }
    }
}

#[test]
fn a_capture_reads_back_and_repeats() {
    let dir = tempfile::tempdir().unwrap();
    let (settings, out) = (settings(), dir.path().join("one"));
    let summary = generate(&settings, &out, &Silent).unwrap();
    assert_eq!((summary.frames, summary.stills, summary.driver_frames, summary.transfer_views), (36, 12, 36, 8));

    cameras_reproject(&out, &settings);
    table_matches_the_truth(&out, &settings);
    stills_are_there(&out);

    let again = dir.path().join("two");
    generate(&settings, &again, &Silent).unwrap();
    let (mut a, mut b) = (Vec::new(), Vec::new());
    bytes_of(&out, &mut a, "");
    bytes_of(&again, &mut b, "");
    assert_eq!(a.len(), b.len());
    for ((name, one), (_, two)) in a.iter().zip(&b) {
        // The encoder of the videos runs in threads whose timing shows in its bytes; the pictures are compared elsewhere.
        let is_video = Path::new(name).extension().is_some_and(|e| e == "mp4");
        assert!(is_video || one == two, "{name} differs between two runs");
    }
}

fn cameras_reproject(out: &Path, settings: &Settings) {
    let model = colmap::read_model(out.join("truth_colmap")).unwrap();
    assert_eq!(model.images.len(), settings.frames as usize);
    assert!(model.points.len() > 100);
    let shots = capture_shots(settings, &Script::capture(settings.frames, settings.seed));
    let mut worst = 0.0f64;
    let mut seen = 0;
    for image in model.images.values() {
        let camera = Camera {
            intrinsics: model.cameras[&image.camera_id].intrinsics().unwrap(),
            camera_from_world: image.camera_from_world,
        };
        let frame = FrameIndex::from_image_name(&image.name, 0).unwrap().0 as usize;
        assert!((camera.center() - shots[frame].camera.center()).length() < 1e-9);
        for point in &image.points {
            let at = camera.project(model.points[&point.point3d.unwrap()].position);
            worst = worst.max((at - DVec2::from_array(point.position_px)).length());
            seen += 1;
        }
    }
    assert!(seen > 1000, "only {seen} observations");
    assert!(worst < 0.01, "a point reprojects {worst} px away");
}

fn table_matches_the_truth(out: &Path, settings: &Settings) {
    let track = openface::read(out.join("openface.csv"), &openface::ReadOptions::default(), &Silent).unwrap();
    assert_eq!(track.rows.len(), settings.frames as usize);
    assert_eq!(track.rows.iter().filter(|r| !r.success).count(), 1, "one lost frame of 36");
    let script = Script::capture(settings.frames, settings.seed);
    let shots = capture_shots(settings, &script);
    let scene = Scene::new(Person::subject(settings.seed as u32), settings.seed as u32);
    let (mut squares, mut count, mut au_squares, mut aus) = (0.0, 0, 0.0, 0);
    for (row, shot) in track.rows.iter().zip(&shots).filter(|(r, _)| r.success) {
        let points = landmarks_in_camera(&scene, shot);
        for (i, (found, truth)) in row.landmarks.as_ref().unwrap().points_px.iter().zip(points).enumerate() {
            let error = shot.camera.intrinsics.project(truth) - DVec2::new(found[0].into(), found[1].into());
            squares += error.length_squared();
            count += 2;
            // The head pose carries the 3-D landmarks of the table into the same pixels.
            let millimetres = row.landmarks_in_camera_mm.as_ref().unwrap()[i].map(f64::from);
            let projected = shot.camera.intrinsics.project(millimetres.into());
            assert!((projected - shot.camera.intrinsics.project(truth)).length() < 0.05);
        }
        let pose = row.head_pose.unwrap().camera_from_head();
        let expected = risorius_synth::openface_pose(&shot.camera.camera_from_world, &shot.world_from_head);
        assert!((pose.translation - expected.translation).length() < 0.1);
        assert!((pose.rotation - expected.rotation).abs_diff_eq(glam::DMat3::ZERO, 2e-3));
        for (unit, value) in track.units.iter().zip(&row.intensities) {
            let truth = shot.expression.intensity(*unit);
            // At rest only the upper half of the noise is seen: the lower one is cut at 0.
            if truth == 0.0 {
                au_squares += 2.0 * f64::from(value.unwrap()).powi(2);
                aus += 1;
            }
        }
    }
    let sigma = (squares / f64::from(count)).sqrt();
    assert!((sigma - 0.3).abs() < 0.03, "landmark noise is {sigma} px");
    let au_sigma = (au_squares / f64::from(aus)).sqrt();
    assert!(aus > 300 && (au_sigma - 0.1).abs() < 0.015, "AU noise is {au_sigma} over {aus} values");
    let driver = openface::read(out.join("driver_openface.csv"), &openface::ReadOptions::default(), &Silent).unwrap();
    assert_eq!(driver.rows.len(), 36);
    assert!(OPENFACE_INTENSITIES.iter().all(|&u| driver.unit_index(u).is_some()));
}

fn stills_are_there(out: &Path) {
    for folder in ["test", "transfer"] {
        let views = ViewList::read(out.join(folder).join("views.json")).unwrap();
        for view in &views.views {
            let image = image::open(out.join(folder).join(view.image.as_ref().unwrap())).unwrap();
            assert_eq!((image.width(), image.height()), (view.camera.width, view.camera.height));
            assert_eq!(view.aus.len(), 17);
        }
    }
    for frame in [0, 30] {
        let mask = LabelImage::read_png(out.join("masks").join(FrameIndex(frame).image_name())).unwrap();
        assert!((1..=3).all(|label| mask.share(label) > 0.01));
    }
    assert!(fs::metadata(out.join("video.mp4")).unwrap().len() > 1000);
}

#[test]
fn senseless_settings_are_refused_and_leave_nothing() {
    let dir = tempfile::tempdir().unwrap();
    for settings in [
        Settings { frames: 0, ..Settings::default() },
        Settings { fps: f64::NAN, ..Settings::default() },
        Settings { width: 3, ..Settings::default() },
    ] {
        let error = generate(&settings, dir.path().join("x"), &Silent).unwrap_err();
        assert!(matches!(error, SynthError::Setting { .. }), "{error}");
    }
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0);
}
