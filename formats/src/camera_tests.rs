use glam::{DMat3, DVec2, DVec3};
use proptest::prelude::*;

use super::*;

/// The test camera of the Nerfies family (fact sheet §3.6).
fn nerfies_camera() -> Camera {
    let rotation = DMat3::from_cols(
        DVec3::new(0.9839451340309302, -0.09685694918727988, 0.14990231689666453),
        DVec3::new(-0.03503400050627939, -0.9284052253532321, -0.3699139850632039),
        DVec3::new(0.1749988343543504, 0.35872338776687934, -0.9168930903020656),
    )
    .transpose();
    let position = DVec3::new(-0.3236620944132945, -3.2642885887491806, 5.416047612682676);
    let f = 2691.1703975975283;
    Camera {
        intrinsics: Intrinsics {
            width: 2448,
            height: 3264,
            fx: f,
            fy: f * 1.0010612377729717,
            cx: 1220.9973265580372,
            cy: 1652.4811427847815,
            skew: 0.0,
            distortion: Distortion {
                radial: [0.10042443556128597, -0.20908508396511707, 0.0],
                radial_denominator: [0.0; 3],
                tangential: [0.001109850269091041, -2.5733278797779516e-05],
            },
        },
        camera_from_world: Isometry::new(rotation, -(rotation * position)),
    }
}

#[test]
fn rays_match_the_check_vectors() {
    let camera = nerfies_camera();
    for (pixel, undistorted, ray) in [
        ((0.5, 0.5), (-0.46123398, -0.62433417), (-0.20298207, 0.77654150, -0.59647429)),
        ((2447.5, 3263.5), (0.46048697, 0.60354537), (0.48342605, -0.19610507, -0.85313660)),
        ((612.0, 816.0), (-0.22416312, -0.30773465), (-0.03250789, 0.62254499, -0.78190855)),
    ] {
        let pixel = DVec2::from(pixel);
        assert!((camera.intrinsics.unproject(pixel).unwrap() - DVec2::from(undistorted)).length() < 2e-8);
        assert!((camera.ray_direction(pixel).unwrap() - DVec3::from(ray)).length() < 2e-8);
    }
}

#[test]
fn projections_match_the_check_vectors() {
    let camera = nerfies_camera();
    let local = camera.camera_from_world.transform_point(DVec3::ZERO);
    assert!((local - DVec3::new(-0.80958138, -1.03845001, 6.19355378)).length() < 2e-8);
    assert!((camera.project(DVec3::ZERO) - DVec2::new(867.903887, 1199.226711)).length() < 1e-6);
    let point = DVec3::new(0.13173689, -2.37084646, 3.67123446);
    assert!((camera.project(point) - DVec2::new(1355.689283, 1382.846972)).length() < 1e-4);
}

#[test]
fn a_pixel_beyond_the_fold_has_no_ray() {
    let mut camera = nerfies_camera();
    camera.intrinsics.distortion.radial = [-0.9, 0.0, 0.0];
    assert!(camera.ray_direction(DVec2::new(0.5, 0.5)).is_none());
    assert!(camera.ray_direction(DVec2::new(1220.0, 1652.0)).is_some());
}

#[test]
fn reducing_keeps_the_ray_of_the_same_spot() {
    let camera = nerfies_camera();
    let full = camera.ray_direction(DVec2::new(1000.0, 2000.0)).unwrap();
    let quarter = camera.reduced(4).ray_direction(DVec2::new(250.0, 500.0)).unwrap();
    assert!((full - quarter).length() < 1e-12);
    assert_eq!((camera.reduced(4).intrinsics.width, camera.reduced(4).intrinsics.height), (612, 816));
}

proptest! {
    #[test]
    fn undistorting_undoes_distorting(x in -0.5f64..0.5, y in -0.5f64..0.5, k1 in -0.1f64..0.1, k2 in -0.05f64..0.05, p1 in -0.01f64..0.01) {
        let d = Distortion { radial: [k1, k2, 0.0], radial_denominator: [0.01, 0.0, 0.0], tangential: [p1, -p1] };
        let p = DVec2::new(x, y);
        let back = d.undistort(d.distort(p)).unwrap();
        prop_assert!((back - p).length() < 1e-9);
    }

    #[test]
    fn an_isometry_and_its_inverse_cancel(q in prop::array::uniform4(-1f64..1.0), t in prop::array::uniform3(-5f64..5.0)) {
        prop_assume!(q.iter().map(|v| v * v).sum::<f64>() > 1e-3);
        let a = Isometry::from_wxyz(q, DVec3::from(t));
        let id = a.compose(&a.inverse());
        prop_assert!(id.translation.length() < 1e-12 && id.orthonormality_error() < 1e-12);
        let b = Isometry::from_wxyz(a.to_wxyz(), a.translation);
        prop_assert!((a.rotation - b.rotation).to_cols_array().iter().all(|v| v.abs() < 1e-12));
        prop_assert_eq!(Isometry::from_rows(a.to_rows()), a);
    }
}
