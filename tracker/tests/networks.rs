//! `tracker run` with networks that the tests make themselves (tiny ONNX graphs), and with the real ones where they are.
//!
//! All of it needs ONNX Runtime; without it these tests say so and pass. `tools/models` fetches it.

#![allow(clippy::unwrap_used, clippy::print_stderr, reason = "a test fails by panicking, and says when it is skipped")]

use std::path::{Path, PathBuf};

use glam::DVec3;
use risorius_formats::Hint;
use risorius_formats::openface::{self, ReadOptions};
use risorius_formats::report::Collected;
use risorius_tracker::aus::AuSource;
use risorius_tracker::aus::openface::HOG_NUMBERS;
use risorius_tracker::models::default_dir;
use risorius_tracker::models::runtime::{Runtime, library_places};
use risorius_tracker::run::follow::FirstFace;
use risorius_tracker::run::{RunOptions, RunSummary, run};
use risorius_tracker::weights::Weights;

#[path = "support/onnx.rs"]
mod onnx;
#[path = "../src/openface_install.rs"]
mod openface_install;
#[path = "../src/testing.rs"]
#[expect(dead_code, reason = "the crate's own tests use all of it")]
mod testing;

/// ONNX Runtime, or `None` with a loud word about it.
fn runtime() -> Option<Runtime> {
    let places = library_places(&[&default_dir()]);
    if places.iter().any(|p| p.is_file()) {
        return Some(Runtime::load(&places).unwrap());
    }
    eprintln!("SKIPPED: ONNX Runtime is not there; `tools/models` fetches it");
    None
}

/// A take of `frames` grey pictures of 64×48 pixels.
fn grey_take(dir: &Path, frames: u32) -> PathBuf {
    let take = testing::take_at(dir, 64, 48, frames, 30.0);
    let text = std::fs::read_to_string(take.join("take.toml")).unwrap();
    let text = text.replace("\"video.mp4\"", "\"pictures\"").replace("source = \"video\"", "source = \"images\"");
    std::fs::write(take.join("take.toml"), text).unwrap();
    std::fs::create_dir(take.join("pictures")).unwrap();
    for i in 0..frames {
        image::RgbImage::from_pixel(64, 48, image::Rgb([128; 3]))
            .save(take.join(format!("pictures/{i:03}.png")))
            .unwrap();
    }
    take
}

/// The 68 points of the tiny landmark network: a circle around the middle of its crop of 32 pixels, as wide as half of it.
fn circle() -> Vec<f32> {
    // Outer eye corners 36 and 45 lie level.
    (0..68)
        .flat_map(|i| {
            let angle = std::f32::consts::PI * (1.0 + (i as f32 - 36.0) / 9.0);
            [16.0 + 8.0 * angle.cos(), 16.0 + 8.0 * angle.sin()]
        })
        .collect()
}

/// A folder with a detector that always sees the middle of the picture, and a network with these points and this logit.
fn models(dir: &Path, points: &[f32], logit: f32) -> PathBuf {
    let dir = dir.join("models");
    std::fs::create_dir_all(&dir).unwrap();
    let detector = onnx::constants(
        &[1, 3, 48, 64],
        &[("boxes", &[1, 1, 4], &[0.25, 0.25, 0.75, 0.75]), ("scores", &[1, 1, 2], &[0.1, 0.9])],
    );
    let landmarks =
        onnx::constants(&[1, 32, 32, 3], &[("points", &[1, points.len() as i64], points), ("face", &[1, 1], &[logit])]);
    std::fs::write(dir.join("detector.onnx"), detector).unwrap();
    std::fs::write(dir.join("landmarks.onnx"), landmarks).unwrap();
    let manifest = r#"
        version = 1
        [detector]
        file = "detector.onnx"
        kind = "boxes"
        width = 64
        height = 48
        layout = "nchw"
        scale = 0.01
        boxes = "boxes"
        scores = "scores"
        [landmarks]
        file = "landmarks.onnx"
        kind = "points68"
        width = 32
        height = 32
        layout = "nhwc"
        scale = 0.01
        points = "points"
        presence = "face"
        margin = 2.0
    "#;
    std::fs::write(dir.join("models.toml"), manifest).unwrap();
    dir
}

#[expect(clippy::result_large_err, reason = "the error is looked at, not passed around")]
fn track(take: &Path, models: &Path, every: u32, threads: usize) -> risorius_tracker::Result<RunSummary> {
    let options = RunOptions { models: Some(models.to_owned()), every, threads, ..RunOptions::default() };
    run(take, &options, &Collected::default())
}

#[test]
fn another_landmark_network_is_a_file_not_a_code_change() {
    if runtime().is_none() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let (take, models) = (grey_take(dir.path(), 11), models(dir.path(), &circle(), 4.0));
    let mut tables = Vec::new();
    for (every, threads) in [(1, 1), (1, 3), (4, 2)] {
        let summary = track(&take, &models, every, threads).unwrap();
        assert_eq!((summary.quality.valid_frames, summary.frames), (11, 11));
        assert_eq!(summary.frames_interpolated, if every == 4 { 7 } else { 0 });
        tables.push(std::fs::read(take.join("track/openface.csv")).unwrap());
        assert!(take.join("track/track.parquet").is_file() && take.join("track/run.json").is_file());
        assert_eq!(std::fs::read_dir(take.join("track")).unwrap().count(), 3, "nothing else is left there");
    }
    assert!(tables[0] == tables[1], "the number of threads changes nothing");
    let table =
        openface::read(take.join("track/openface.csv"), &ReadOptions::default(), &Collected::default()).unwrap();
    let points = &table.rows[5].landmarks.as_ref().unwrap().points_px;
    let first = openface::parse(&tables[0], &ReadOptions::default(), &Collected::default()).unwrap();
    for (a, b) in first.rows.iter().zip(&table.rows) {
        let (a, b) = (a.landmarks.as_ref().unwrap(), b.landmarks.as_ref().unwrap());
        let far = a.points_px.iter().zip(&b.points_px).any(|(p, q)| (p[0] - q[0]).hypot(p[1] - q[1]) > 0.5);
        assert!(!far, "a still face stays where it is between tracked frames");
    }
    let middle = [0, 1].map(|axis| points.iter().map(|p| p[axis]).sum::<f32>() / 68.0);
    assert!((middle[0] - 32.0).abs() < 1.0 && (middle[1] - 24.0).abs() < 1.0, "{middle:?}");
    // This network has no mesh: landmarks, but no AUs.
    assert!(table.units.is_empty() || table.rows[5].intensities.iter().all(Option::is_none));
}

#[test]
fn another_au_network_is_a_file_not_a_code_change() {
    if runtime().is_none() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let (take, models) = (grey_take(dir.path(), 5), models(dir.path(), &circle(), 4.0));
    let network = onnx::constants(&[1, 3, 48, 48], &[("out", &[1, 3], &[0.9, 0.1, 1.4])]);
    std::fs::write(models.join("aus.onnx"), network).unwrap();
    let text = std::fs::read_to_string(models.join("models.toml")).unwrap();
    let with = |units: &str| {
        let aus = format!(
            "[aus]\nfile = \"aus.onnx\"\nwidth = 48\nheight = 48\nlayout = \"nchw\"\nscale = 0.01\nmargin = 1.2\n\
             intensities = \"out\"\nfactor = 5.0\nunits = [{units}]\n"
        );
        std::fs::write(models.join("models.toml"), format!("{text}\n{aus}")).unwrap();
    };
    with("\"AU26\", \"AU01\", \"AU12\"");
    let summary = track(&take, &models, 2, 2).unwrap();
    assert_eq!(summary.au_model, "aus.onnx");
    let path = take.join("track/openface.csv");
    let table = openface::read(&path, &ReadOptions::default(), &Collected::default()).unwrap();
    let value = |unit: u8| {
        // A column without any number is no column.
        table.unit_index(risorius_formats::ActionUnit(unit)).and_then(|column| table.rows[3].intensities[column])
    };
    // 0–1 becomes 0–5 and is clamped; AUs that the network does not know stay unknown.
    assert_eq!((value(26), value(1), value(12), value(4)), (Some(4.5), Some(0.5), Some(5.0), None));
    with("\"AU26\", \"AU01\"");
    let error = track(&take, &models, 1, 1).unwrap_err().to_string();
    assert!(error.contains("aus.onnx") && error.contains("has 3 numbers, but `units` names 2 AUs"), "{error}");
}

#[test]
fn frames_without_a_face_are_rows_without_success() {
    if runtime().is_none() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let (take, models) = (grey_take(dir.path(), 6), models(dir.path(), &circle(), -4.0));
    assert_eq!(track(&take, &models, 1, 2).unwrap().quality.valid_frames, 0);
    let text = std::fs::read_to_string(take.join("track/openface.csv")).unwrap();
    assert_eq!(text.lines().count(), 7);
    assert!(text.lines().skip(1).all(|l| l.split(',').nth(4) == Some("0")));
}

#[test]
fn networks_that_do_not_fit_are_named_and_nothing_is_written() {
    if runtime().is_none() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let take = grey_take(dir.path(), 3);
    let error = |models: &Path| {
        let e = track(&take, models, 1, 1).unwrap_err();
        assert!(e.hint().is_some() && !take.join("track").exists(), "{e}");
        e.to_string()
    };
    let mut points = circle();
    points[7] = f32::NAN;
    let found = error(&models(dir.path(), &points, 4.0));
    assert!(
        found.contains("landmarks.onnx") && found.contains("`points` holds numbers that are not finite"),
        "{found}"
    );
    let found = error(&models(dir.path(), &points[..100], 4.0));
    assert!(found.contains("`points` has 100 numbers, expected 136"), "{found}");
    let good = models(dir.path(), &circle(), 4.0);
    let text = std::fs::read_to_string(good.join("models.toml")).unwrap();
    std::fs::write(good.join("models.toml"), text.replace("presence = \"face\"", "presence = \"nose\"")).unwrap();
    let found = error(&good);
    assert!(found.contains("landmarks.onnx: has no output `nose`; it has `points`, `face`"), "{found}");
    std::fs::write(
        good.join("models.toml"),
        text.replace("width = 32", "width = 24").replace("height = 32", "height = 24"),
    )
    .unwrap();
    assert!(error(&good).contains("its input has the shape [1, 32, 32, 3], expected [1, 24, 24, 3]"));
    std::fs::write(good.join("models.toml"), &text).unwrap();
    std::fs::write(good.join("detector.onnx"), b"not a network").unwrap();
    let found = error(&good);
    assert!(found.contains("detector.onnx: cannot be loaded as a network") && !found.contains('\n'), "{found}");
}

/// The default models, or `None` with a loud word about it.
fn default_models() -> Option<PathBuf> {
    let models = default_dir();
    if runtime().is_some() && models.join("models.toml").is_file() {
        return Some(models);
    }
    eprintln!("SKIPPED: the default models are not there; `tools/models` fetches them");
    None
}

#[test]
fn of_several_faces_the_one_that_was_asked_for_is_followed() {
    let Some(models) = default_models() else { return };
    let Some(still) = risorius_tests::shared("data/stills/pyfeat_multi_face.jpg") else { return };
    let dir = tempfile::tempdir().unwrap();
    let take = grey_take(dir.path(), 6);
    let text = std::fs::read_to_string(take.join("take.toml")).unwrap();
    let text = text.replace("width = 64", "width = 1000").replace("height = 48", "height = 667");
    std::fs::write(take.join("take.toml"), text).unwrap();
    for i in 0..6 {
        std::fs::remove_file(take.join(format!("pictures/{i:03}.png"))).unwrap();
        std::fs::copy(&still, take.join(format!("pictures/{i:03}.jpg"))).unwrap();
    }
    let nose = |face: FirstFace| {
        let options = RunOptions { models: Some(models.clone()), threads: 2, face, ..RunOptions::default() };
        assert_eq!(run(&take, &options, &Collected::default()).unwrap().quality.valid_frames, 6);
        let table = openface::read(take.join("track/openface.csv"), &ReadOptions::default(), &Collected::default());
        let noses: Vec<[f32; 2]> =
            table.unwrap().rows.iter().map(|r| r.landmarks.as_ref().unwrap().points_px[30]).collect();
        assert!(noses.iter().all(|n| (n[0] - noses[0][0]).hypot(n[1] - noses[0][1]) < 3.0), "{noses:?}");
        noses[0]
    };
    // The face on the right is nearest to the camera.
    let [x, y] = nose(FirstFace::Largest);
    assert!((x - 730.0).hypot(y - 362.0) < 10.0, "{x} {y}");
    let [x, y] = nose(FirstFace::First);
    assert!((x - 730.0).hypot(y - 362.0) > 50.0, "{x} {y}");
}

#[test]
fn a_clip_without_a_face_has_none() {
    let Some(models) = default_models() else { return };
    let Some(video) = risorius_tests::shared("data/video/pyfeat_no_face.mp4") else { return };
    let dir = tempfile::tempdir().unwrap();
    let take = testing::take_at(dir.path(), 960, 540, 95, 24.0);
    std::fs::copy(video, take.join("video.mp4")).unwrap();
    let options = RunOptions { models: Some(models), every: 5, threads: 2, ..RunOptions::default() };
    assert_eq!(run(&take, &options, &Collected::default()).unwrap().quality.valid_frames, 0);
    assert!(std::fs::read_to_string(take.join("track/run.json")).unwrap().contains("\"landmark_runs\""));
}

#[test]
fn the_real_networks_keep_their_accuracy_on_ada() {
    let Some(models) = default_models() else { return };
    let Some(video) = risorius_tests::shared("data/captures/ada/video.mp4") else { return };
    let dir = tempfile::tempdir().unwrap();
    let take = testing::take_at(dir.path(), 540, 960, 240, 120.0);
    std::fs::copy(video, take.join("video.mp4")).unwrap();
    let summary = track(&take, &models, 4, 2).unwrap();
    assert_eq!(summary.quality.valid_frames, 240);
    assert!(summary.effort.landmark_runs < 75, "{:?}", summary.effort);
    let read = |path: &Path| openface::read(path, &ReadOptions::default(), &Collected::default()).unwrap();
    let (own, noisy) =
        (read(&take.join("track/openface.csv")), risorius_tests::shared("data/captures/ada/openface.csv").unwrap());
    // The capture's own table is the truth with 0.6 px of noise.
    let (mut sum, mut count) = (0.0, 0.0);
    for (a, b) in own.rows.iter().zip(&read(&noisy).rows).filter(|(_, b)| b.success) {
        let (a, b) = (a.landmarks.as_ref().unwrap(), b.landmarks.as_ref().unwrap());
        for i in 17..68 {
            let [dx, dy] = [0, 1].map(|k| a.points_px[i][k] - b.points_px[i][k]);
            sum += f64::from(dx.hypot(dy) / b.outer_eye_distance_px());
            count += 1.0;
        }
    }
    assert!(sum / count < 0.022, "{}", sum / count);
}

/// An AU model of OpenFace's kind over the tests' point model, with these weights.
fn au_model(kind: i32, weights: &[(usize, f64)], bias: f64) -> openface_install::ModelFile {
    let count = HOG_NUMBERS + 204 + 3;
    let mut all = vec![0.0; count];
    for (i, w) in weights {
        all[*i] = *w;
    }
    openface_install::ModelFile { kind, cutoff: 0.5, mean: vec![0.1; count], weights: all, bias }
}

#[test]
fn models_of_openface_take_the_place_of_the_readout() {
    if runtime().is_none() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    // Grey pictures; every third block of eight has stripes, which change the skin's FHOG.
    let mean = &Weights::get().shape.mean;
    // The box around the points is half of the crop and in its middle, so that the next crop is the same.
    let bounds = |axis: usize| mean.iter().fold([f64::MAX, f64::MIN], |[l, h], p| [l.min(p[axis]), h.max(p[axis])]);
    let [x, y] = [bounds(0), bounds(1)];
    let scale = 16.0 / (x[1] - x[0]).max(y[1] - y[0]);
    let place = |v: f64, [low, high]: [f64; 2]| (16.0 + (v - 0.5 * (low + high)) * scale) as f32;
    let points: Vec<f32> = mean.iter().flat_map(|p| [place(p.x, x), place(p.y, y)]).collect();
    let (take, models) = (grey_take(dir.path(), 48), models(dir.path(), &points, 4.0));
    let is_striped = |i: usize| i % 24 >= 16;
    for i in (0..48).filter(|i| is_striped(*i)) {
        let striped = image::RgbImage::from_fn(64, 48, |x, _| image::Rgb([if x % 8 < 4 { 90 } else { 170 }; 3]));
        striped.save(take.join(format!("pictures/{i:03}.png"))).unwrap();
    }
    // The signed horizontal gradients of the cells in the middle of the face.
    let cells = (4..8).flat_map(|row| (4..8).map(move |column| (row * 12 + column) * 31));
    let weights: Vec<(usize, f64)> = cells.flat_map(|at| [(at, 0.2), (at + 9, 0.2)]).collect();
    let faces: [DVec3; 68] = std::array::from_fn(|i| mean[i] * 90.0 / mean[36].distance(mean[45]));
    let install = dir.path().join("OpenFace");
    let files = [
        ("AU01", au_model(1, &weights, 0.3)),
        ("AU12", au_model(0, &[(0, 0.0)], 2.5)),
        ("AU12", au_model(5, &weights, -0.3)),
    ];
    openface_install::write_openface_install(&install, &faces, &files);
    let mut tables = Vec::new();
    for threads in [1, 3] {
        let options = RunOptions {
            models: Some(models.clone()),
            threads,
            aus: AuSource::OpenFace(install.join("model")),
            ..RunOptions::default()
        };
        let summary = run(&take, &options, &Collected::default()).unwrap();
        assert_eq!((summary.quality.valid_frames, summary.au_model.as_str()), (48, "OpenFace's models"));
        tables.push(std::fs::read(take.join("track/openface.csv")).unwrap());
    }
    assert!(tables[0] == tables[1], "the number of threads changes nothing");
    let table = openface::parse(&tables[0], &ReadOptions::default(), &Collected::default()).unwrap();
    let slot = |unit: u8| table.units.iter().position(|u| u.0 == unit).unwrap();
    let curve: Vec<f32> = table.rows.iter().map(|r| r.intensities[slot(1)].unwrap()).collect();
    for (i, row) in table.rows.iter().enumerate() {
        // Means of three and of seven frames: only those far from a change are clear.
        let is_clear = (i.saturating_sub(3)..(i + 4).min(48)).all(|k| is_striped(k) == is_striped(i));
        let au01 = row.intensities[slot(1)].unwrap();
        assert_eq!(row.intensities[slot(12)], Some(2.5), "a static model of nothing but its bias");
        if is_clear {
            assert_eq!(au01 > 0.5, is_striped(i), "frame {i}: {curve:?}");
            assert!(is_striped(i) || au01 < 0.02, "frame {i}: {curve:?}");
            let present = table.presence_units.iter().position(|u| u.0 == 12).and_then(|k| row.presences[k]);
            assert_eq!(present, Some(is_striped(i)), "frame {i}");
        }
    }
    let options = RunOptions { aus: AuSource::OpenFace(dir.path().to_owned()), ..RunOptions::default() };
    let error = run(&take, &options, &Collected::default()).unwrap_err();
    assert!(error.to_string().contains("AU_all_best.txt") && error.hint().unwrap().contains("OpenFace 2.x"), "{error}");
}
