use glam::{DMat3, DVec3};

use super::predictors::Purpose;
use super::*;
use crate::openface_install::{ModelFile, wave, write_openface_install};
use crate::weights::Weights;

/// Numbers of x with the three modes of the tests' point model.
const NUMBERS: usize = HOG_NUMBERS + 204 + 3;

/// The project's own mean face, 90 units between the outer eye corners.
fn mean() -> [DVec3; POINTS] {
    let mean = &Weights::get().shape.mean;
    let unit = 90.0 / mean[36].distance(mean[45]);
    std::array::from_fn(|i| mean[i] * unit)
}

fn model(kind: i32, seed: usize) -> ModelFile {
    let numbers = |from: usize| (0..NUMBERS).map(|i| wave(seed + from + i)).collect();
    ModelFile { kind, cutoff: 0.5, mean: numbers(0), weights: numbers(NUMBERS), bias: 0.25 }
}

#[test]
fn an_install_is_read_from_its_root_or_its_folders() {
    let dir = tempfile::tempdir().unwrap();
    let kinds = [("AU01", 1), ("AU12", 0), ("AU12", 4), ("AU28", 5)];
    let models = kinds.map(|(unit, kind)| (unit, model(kind, 7 * kind as usize)));
    write_openface_install(dir.path(), &mean(), &models);
    for place in ["", "AU_predictors", "model"] {
        let read = OpenFaceModels::open(&dir.path().join(place)).unwrap();
        assert_eq!((read.numbers(), read.predictors.len(), read.triangles.len()), (NUMBERS, 4, 27), "{place}");
        let [au01, au12, present, au28] = &read.predictors.0[..] else { panic!("four") };
        assert_eq!((au01.unit.0, au01.is_dynamic, au01.purpose), (1, true, Purpose::Intensity { cutoff: Some(0.5) }));
        assert_eq!((au12.unit.0, au12.is_dynamic, au12.purpose), (12, false, Purpose::Intensity { cutoff: None }));
        assert_eq!((present.is_dynamic, present.purpose), (false, Purpose::Presence { positive: 1.0, negative: 0.0 }));
        assert_eq!((au28.unit.0, au28.is_dynamic), (28, true));
        // (x − mean)·w + bias, slowly.
        let x: Vec<f32> = (0..NUMBERS).map(|i| wave(3 * i) as f32).collect();
        let file = &models[1].1;
        let slow: f64 =
            (0..NUMBERS).map(|i| (f64::from(x[i]) - file.mean[i]) * file.weights[i]).sum::<f64>() + file.bias;
        assert!((au12.product(&x) + au12.constant - slow).abs() < 1e-9);
    }
}

#[test]
fn errors_name_the_file_and_what_was_looked_for() {
    let dir = tempfile::tempdir().unwrap();
    let said = |dir: &Path| OpenFaceModels::open(dir).unwrap_err().to_string();
    let nothing = said(dir.path());
    assert!(nothing.contains("AU_predictors/AU_all_best.txt") && nothing.contains("lib/local"), "{nothing}");
    write_openface_install(dir.path(), &mean(), &[("AU12", model(0, 1))]);
    let folder = dir.path().join("AU_predictors");
    let file = folder.join("svr_combined/AU_0_comb.dat");
    let whole = std::fs::read(&file).unwrap();
    for (bytes, expected) in [
        (whole[..whole.len() - 3].to_vec(), "ends early"),
        (7i32.to_le_bytes().to_vec(), "of the kind 7"),
        (ModelFile { mean: vec![0.0; 9], weights: vec![0.0; 9], ..model(0, 1) }.bytes(), "mean of 9"),
        (ModelFile { bias: f64::NAN, ..model(0, 1) }.bytes(), "not finite"),
        (ModelFile { kind: 1, cutoff: 7.0, ..model(1, 1) }.bytes(), "cut-off 7"),
    ] {
        std::fs::write(&file, bytes).unwrap();
        let said = said(dir.path());
        assert!(said.contains("AU_0_comb.dat") && said.contains(expected), "{said}");
    }
    std::fs::write(&file, &whole).unwrap();
    std::fs::write(folder.join("AU_all_best.txt"), "svr_combined/AU_0_comb.dat smile\n").unwrap();
    assert!(said(dir.path()).contains("AU_all_best.txt"));
    std::fs::remove_file(folder.join("In-the-wild_aligned_PDM_68.txt")).unwrap();
    std::fs::write(folder.join("AU_all_best.txt"), "svr_combined/AU_0_comb.dat AU12\n").unwrap();
    assert!(said(dir.path()).contains("model/pdms"), "the usual places of the point model are named");
}

#[test]
fn the_face_lies_upright_in_its_place_and_the_outside_is_black() {
    let dir = tempfile::tempdir().unwrap();
    write_openface_install(dir.path(), &mean(), &[("AU12", model(0, 1))]);
    let models = OpenFaceModels::open(dir.path()).unwrap();
    // Ramps tell which pixel of the picture each pixel of the face shows.
    let picture = RgbImage::from_fn(250, 250, |x, y| image::Rgb([x as u8, y as u8, 200]));
    let rotation = DMat3::from_rotation_z(0.3);
    let truth = Fit { scale: 1.1, rotation, translation: DVec2::new(128.0, 120.0), coefficients: vec![0.0; 3] };
    let points = models.point_model.project(&truth);
    let face = aligned::face(&picture, &points, &truth, &models.point_model, &models.triangles).unwrap();
    let plane = face.levels.len() / 3;
    let side = 112;
    for (row, column) in [(56, 56), (50, 60), (70, 45)] {
        let at = row * side + column;
        // 0.7 px per unit of the model here, 1.1 px there.
        let off = DVec2::new(column as f64 - 56.0, row as f64 - 56.0) / 0.7;
        let there = (rotation * off.extend(0.0)).truncate() * 1.1 + truth.translation;
        assert!((f64::from(face.levels[at]) - there.x).abs() < 1.0, "{} {there}", face.levels[at]);
        assert!((f64::from(face.levels[plane + at]) - there.y).abs() < 1.0 && face.levels[2 * plane + at] == 200.0);
    }
    for corner in [0, side - 1, plane - side, plane - 1] {
        assert_eq!(face.levels[corner], 0.0);
    }

    // The tracker's points are where the first pixel's centre is at 0.5.
    let ours = points.map(|p| [p.x as f32 + 0.5, p.y as f32 + 0.5]);
    let x = models.describe(&picture, &ours).unwrap();
    assert_eq!(x.len(), NUMBERS);
    assert!(x[..HOG_NUMBERS].iter().any(|v| *v > 0.1) && x[..HOG_NUMBERS].iter().all(|v| (0.0..=1.0).contains(v)));
    assert!(models.describe(&picture, &[[5.0; 2]; POINTS]).is_none());
}

#[test]
fn texture_energies_come_in_dlib_s_order() {
    let ours: Vec<f32> = (0..62).map(|i| i as f32).collect();
    let dlib = dlib_order(&ours);
    assert_eq!(dlib[..27], ours[..27]);
    assert_eq!(dlib[27..31], [30.0, 28.0, 29.0, 27.0]);
    assert_eq!(dlib[58..], [61.0, 59.0, 60.0, 58.0]);
}
