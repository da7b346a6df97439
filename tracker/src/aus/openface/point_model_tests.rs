use super::*;
use crate::openface_install::wave;

/// A model of three modes over the project's own mean face, 90 units between the outer eye corners.
fn model() -> PointModel {
    let mean = &crate::weights::Weights::get().shape.mean;
    let unit = 90.0 / mean[36].distance(mean[45]);
    let mode = |j: usize| {
        std::array::from_fn(|i| DVec3::new(wave(i + 100 * j), wave(i + 100 * j + 31), wave(i + 100 * j + 67)) * 0.1)
    };
    PointModel {
        mean: std::array::from_fn(|i| mean[i] * unit),
        modes: (0..3).map(mode).collect(),
        variances: vec![400.0, 100.0, 25.0],
    }
}

#[test]
fn a_face_that_was_projected_is_found_again() {
    let model = model();
    let rotation = rotation_exp(DVec3::new(0.1, -0.3, 0.2));
    let truth =
        Fit { scale: 1.7, rotation, translation: DVec2::new(300.0, 200.0), coefficients: vec![15.0, -8.0, 4.0] };
    let seen = model.project(&truth);
    let found = model.fit(&seen, 1e-6).unwrap();
    assert!((found.scale - truth.scale).abs() < 1e-3 && found.translation.distance(truth.translation) < 0.1);
    for (a, b) in found.coefficients.iter().zip(&truth.coefficients) {
        assert!((a - b).abs() < 0.1, "{:?}", found.coefficients);
    }
    let again = model.project(&found);
    assert!(again.iter().zip(&seen).all(|(a, b)| a.distance(*b) < 0.05));
    // V p by hand.
    let moved = model.displacements(&truth.coefficients);
    let by_hand: f64 = (0..3).map(|j| model.modes[j][5].y * truth.coefficients[j]).sum();
    assert!((moved[POINTS + 5] - by_hand).abs() < 1e-12 && moved.len() == COORDINATES);
}

#[test]
fn a_stiff_model_keeps_the_mean_shape_and_nothing_is_fitted_to_one_point() {
    let model = model();
    let truth =
        Fit { scale: 1.0, rotation: DMat3::IDENTITY, translation: DVec2::ZERO, coefficients: vec![15.0, -8.0, 4.0] };
    let seen = model.project(&truth);
    let [soft, stiff] = [1e-6, 1e6].map(|k| model.fit(&seen, k).unwrap().coefficients[0].abs());
    assert!(stiff < 0.05 * soft, "{stiff} {soft}");
    assert!(model.fit(&[DVec2::ONE; POINTS], 1.0).is_none());
}

#[test]
fn the_file_is_read_and_sizes_have_to_fit() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("pdm.txt");
    let model = model();
    let text = crate::openface_install::point_model_text(&model.mean, &model.modes, &model.variances);
    std::fs::write(&path, &text).unwrap();
    let read = PointModel::read(&path).unwrap();
    assert!(read.mean[17].distance(model.mean[17]) < 1e-9 && read.modes[2][40].distance(model.modes[2][40]) < 1e-9);
    std::fs::write(&path, text.replacen("204\n1\n", "203\n1\n", 1)).unwrap();
    assert!(PointModel::read(&path).unwrap_err().to_string().contains("pdm.txt"));
}
