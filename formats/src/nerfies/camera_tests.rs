use glam::DVec2;
use proptest::prelude::*;

use super::*;

/// The family's test camera with the older key `tangential`.
const OLD_SPELLING: &str = r#"{
  "orientation": [[0.9839451340309302, -0.09685694918727988, 0.14990231689666453],
    [-0.03503400050627939, -0.9284052253532321, -0.3699139850632039],
    [0.1749988343543504, 0.35872338776687934, -0.9168930903020656]],
  "position": [-0.3236620944132945, -3.2642885887491806, 5.416047612682676],
  "focal_length": 2691.1703975975283, "principal_point": [1220.9973265580372, 1652.4811427847815],
  "skew": 0.0, "pixel_aspect_ratio": 1.0010612377729717,
  "radial_distortion": [0.10042443556128597, -0.20908508396511707, 0.0],
  "tangential": [0.001109850269091041, -2.5733278797779516e-05], "image_size": [2448, 3264]
}"#;

fn check_rays(camera: &Camera, tolerance: f64) {
    for (pixel, ray) in [
        ((0.5, 0.5), (-0.20298207, 0.77654150, -0.59647429)),
        ((2447.5, 3263.5), (0.48342605, -0.19610507, -0.85313660)),
        ((612.0, 816.0), (-0.03250789, 0.62254499, -0.78190855)),
    ] {
        let got = camera.ray_direction(DVec2::from(pixel)).unwrap();
        assert!((got - DVec3::from(ray)).length() < tolerance, "{pixel:?}: {got}");
    }
}

#[test]
fn the_older_spelling_gives_the_known_rays() {
    let camera = parse_camera(OLD_SPELLING.as_bytes()).unwrap();
    check_rays(&camera, 2e-8);
    assert!((camera.project(DVec3::ZERO) - DVec2::new(867.903887, 1199.226711)).length() < 1e-6);
}

#[test]
fn a_camera_of_the_family_gives_the_known_rays_and_keeps_its_bits() {
    let Some(path) = risorius_tests::shared("data/colmap/nerfies_camera.json") else { return };
    let camera = read_camera(&path).unwrap();
    check_rays(&camera, 2e-8);
    // Writing rounds to 32-bit floats; from then on nothing changes any more.
    let dir = tempfile::tempdir().unwrap();
    let (first, second) = (dir.path().join("1.json"), dir.path().join("2.json"));
    write_camera(&first, &camera).unwrap();
    let rounded = read_camera(&first).unwrap();
    check_rays(&rounded, 1e-6);
    write_camera(&second, &rounded).unwrap();
    let bytes = std::fs::read(&first).unwrap();
    assert_eq!(bytes, std::fs::read(&second).unwrap());
    let text = String::from_utf8(bytes).unwrap();
    assert!(text.contains("tangential_distortion") && !text.contains("\"tangential\""));
    assert!(text.contains("0.0011098502436652780") || text.contains("0.001109850243665278"), "{text}");
}

#[test]
fn the_older_key_wins_and_both_spellings_agree() {
    let new = OLD_SPELLING.replace("\"tangential\"", "\"tangential_distortion\"");
    assert_eq!(parse_camera(new.as_bytes()).unwrap(), parse_camera(OLD_SPELLING.as_bytes()).unwrap());
    let both = OLD_SPELLING.replace("\"skew\"", "\"tangential_distortion\": [9, 9], \"skew\"");
    assert_eq!(parse_camera(both.as_bytes()).unwrap(), parse_camera(OLD_SPELLING.as_bytes()).unwrap());
}

#[test]
fn an_almost_orthonormal_rotation_is_repaired_and_a_wrong_one_refused() {
    let bent = OLD_SPELLING.replace("0.9839451340309302", "0.9850");
    let camera = parse_camera(bent.as_bytes()).unwrap();
    assert!(camera.camera_from_world.orthonormality_error() < 1e-12);
    let mirrored = OLD_SPELLING.replace(
        "[0.9839451340309302, -0.09685694918727988, 0.14990231689666453]",
        "[-0.9839451340309302, 0.09685694918727988, -0.14990231689666453]",
    );
    assert_eq!(parse_camera(mirrored.as_bytes()).unwrap_err().kind(), ErrorKind::Inconsistent);
}

#[test]
fn errors_name_the_line_or_the_key() {
    let error = parse_camera(b"{\n\"orientation\": [[1,0,0],\n[0,1,x]").unwrap_err();
    assert_eq!(error.line(), Some(3));
    for (from, to, word) in [
        ("[2448, 3264]", "[0, 3264]", "image_size"),
        ("[2448, 3264]", "[2448.5, 3264]", "image_size"),
        ("2691.1703975975283", "0", "focal_length"),
        ("[0.10042443556128597, -0.20908508396511707, 0.0]", "[1, 2, 3, 4]", "radial_distortion"),
    ] {
        let error = parse_camera(OLD_SPELLING.replace(from, to).as_bytes()).unwrap_err();
        assert!(error.to_string().contains(word), "{error}");
    }
}

#[test]
fn what_the_format_cannot_hold_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("c.json");
    let mut camera = parse_camera(OLD_SPELLING.as_bytes()).unwrap();
    camera.intrinsics.distortion.radial_denominator[0] = 0.1;
    assert_eq!(write_camera(&path, &camera).unwrap_err().kind(), ErrorKind::Unsupported);
    camera.intrinsics.distortion.radial_denominator[0] = 0.0;
    camera.intrinsics.cx = f64::NAN;
    assert!(write_camera(&path, &camera).is_err());
    assert!(!path.exists());
}

proptest! {
    #[test]
    fn bytes_survive_a_second_trip(q in prop::array::uniform4(-1f64..1.0), t in prop::array::uniform3(-50f64..50.0),
        f in 10f64..9000.0, aspect in 0.5f64..2.0, k in prop::array::uniform3(-0.2f64..0.2), skew in -3f64..3.0) {
        prop_assume!(q.iter().map(|v| v * v).sum::<f64>() > 1e-3);
        let mut intrinsics = Intrinsics::pinhole(640, 480, f);
        intrinsics.fy = f * aspect;
        intrinsics.skew = skew;
        intrinsics.distortion.radial = k;
        let camera = Camera { intrinsics, camera_from_world: Isometry::from_wxyz(q, DVec3::from(t)) };
        let first = serde_json::to_vec(&encode(&camera).unwrap()).unwrap();
        let back = parse_camera(&first).unwrap();
        prop_assert!((back.center() - camera.center()).length() < 1e-4);
        let second = serde_json::to_vec(&encode(&back).unwrap()).unwrap();
        prop_assert_eq!(first, second);
    }

    #[test]
    fn nothing_makes_the_parser_panic(bytes in prop::collection::vec(any::<u8>(), 0..200), cut in 0usize..700, put in any::<u8>()) {
        let _ = parse_camera(&bytes);
        let mut text = OLD_SPELLING.as_bytes().to_vec();
        let cut = cut.min(text.len() - 1);
        text[cut] = put;
        let _ = parse_camera(&text);
        let _ = parse_camera(&text[..cut]);
    }
}
