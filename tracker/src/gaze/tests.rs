use super::*;
use crate::se3::rotation_exp;
use crate::weights::Weights;

/// A resting face in a picture whose irises lie `across` and `down` of their places, with lids open by `opening`.
fn frame(across: f32, down: f32, opening: f32) -> [f32; EYE_NUMBERS] {
    let weights = Weights::get();
    let mut mesh: Mesh = std::array::from_fn(|i| {
        let [x, y, z] = weights.canonical[i];
        [100.0 * x + 300.0, 100.0 * y + 200.0, 100.0 * z]
    });
    for eye in &EYES {
        let [left, right] = eye.corners.map(|i| mesh[i]);
        let middle = [0, 1, 2].map(|k| 0.5 * (left[k] + right[k]));
        mesh[eye.iris] = [middle[0] + 100.0 * across, middle[1] + 100.0 * down, middle[2]];
        for (k, (x, y)) in [(6.0, 0.0), (0.0, 6.0), (-6.0, 0.0), (0.0, -6.0)].into_iter().enumerate() {
            let iris = mesh[eye.iris];
            mesh[eye.iris + 1 + k] = [iris[0] + x, iris[1] + y, iris[2]];
        }
        for (i, sign) in eye.middle.into_iter().zip([-0.5, 0.5]) {
            mesh[i] = [middle[0], middle[1] + sign * opening * (right[0] - left[0]), middle[2]];
        }
    }
    numbers(&mesh, &crate::run::mesh::alignment(&mesh, weights).unwrap())
}

#[test]
fn the_person_looks_ahead_most_of_the_time_and_then_aside() {
    let ahead = frame(0.01, -0.02, 0.3);
    let model = EyeModel::learn(&[ahead; 9]);
    let still = model.gaze(&ahead, &DMat3::IDENTITY);
    assert!((still.directions[0] - DVec3::NEG_Z).length() < 1e-4 && still.open == [true; 2], "{still:?}");
    // An apparent radius of 0.06 × 3.5 outer-eye distances across, 0.06 × 4.8 down.
    let aside = model.gaze(&frame(0.01 + 0.021, -0.02 + 0.0288, 0.3), &DMat3::IDENTITY);
    assert!((aside.directions[1].x - 0.1).abs() < 2e-3 && (aside.directions[1].y - 0.1).abs() < 2e-3, "{aside:?}");
    assert!((aside.angles[0] - 0.1).abs() < 3e-3 && (aside.angles[1] - 0.1).abs() < 3e-3);
    // A head that nods by 0.2 rad takes the gaze along: R[1][2] = −sin, as OpenFace has it.
    let nodding = model.gaze(&ahead, &rotation_exp(DVec3::X * 0.2));
    assert!((nodding.angles[1] - 0.2).abs() < 1e-3, "{nodding:?}");
}

#[test]
fn a_closed_eye_says_so_and_a_wild_iris_stays_in_the_eye() {
    let model = EyeModel::learn(&[frame(0.0, 0.0, 0.3); 5]);
    assert_eq!(model.gaze(&frame(0.0, 0.0, 0.05), &DMat3::IDENTITY).open, [false; 2]);
    let wild = model.gaze(&frame(5.0, 0.0, 0.3), &DMat3::IDENTITY);
    assert!(wild.directions.iter().all(|d| (d.length() - 1.0).abs() < 1e-9 && d.z < 0.0), "{wild:?}");
    assert!(EyeModel::learn(&[]).gaze(&frame(0.0, 0.0, 0.3), &DMat3::IDENTITY).open == [true; 2]);
}

#[test]
fn landmarks_lie_around_the_iris_in_openfaces_order() {
    let numbers = frame(0.0, 0.0, 0.3);
    let points = EyeModel::learn(&[numbers]).gaze(&numbers, &DMat3::IDENTITY).landmarks_px;
    for eye in points.chunks_exact(28) {
        let [left, top, right, bottom] = [eye[0], eye[2], eye[4], eye[6]];
        assert!((right[0] - left[0] - 14.4).abs() < 0.1 && (bottom[1] - top[1] - 14.4).abs() < 0.1, "{eye:?}");
        assert!(eye[8][0] < left[0] && eye[14][0] > right[0] && eye[11][1] < eye[17][1]);
        let pupil_centre = (20..28).map(|k| eye[k][0]).sum::<f32>() / 8.0;
        assert!((pupil_centre - 0.5 * (left[0] + right[0])).abs() < 0.1 && eye[21][1] > eye[25][1]);
    }
}
