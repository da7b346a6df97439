use super::*;
use risorius_formats::similarity::umeyama;

fn lens() -> Intrinsics {
    Intrinsics::pinhole(640, 480, 700.0)
}

/// Ten points of a face, metres: a flat part and a nose.
fn face() -> Vec<DVec3> {
    [
        (-45.0, -30.0, 20.0),
        (-15.0, -30.0, 15.0),
        (15.0, -30.0, 15.0),
        (45.0, -30.0, 20.0),
        (0.0, -32.0, 5.0),
        (0.0, -15.0, -5.0),
        (0.0, 0.0, -18.0),
        (0.0, 12.0, -8.0),
        (-12.0, 12.0, 2.0),
        (12.0, 12.0, 2.0),
    ]
    .map(|(x, y, z)| DVec3::new(x, y, z) * 1e-3)
    .to_vec()
}

fn points() -> Vec<RigidPoint> {
    (0..10).map(|landmark| RigidPoint { landmark, sigma_px: 1.0 }).collect()
}

fn pose(t: f64) -> Isometry {
    let rotation = se3::rotation_exp(DVec3::new(0.25 * (1.3 * t).sin(), 0.5 * t.sin(), 0.1 * (0.7 * t).cos()));
    Isometry::new(rotation, DVec3::new(0.03 * t.cos(), 0.02 * (2.0 * t).sin(), 0.55 + 0.03 * (0.5 * t).sin()))
}

fn view(pose: &Isometry, shape: &[DVec3], noise: impl Fn(usize) -> DVec2) -> FrameView {
    let pixels = shape.iter().enumerate().map(|(k, &p)| lens().project(pose.transform_point(p)) + noise(k)).collect();
    FrameView { pixels }
}

#[test]
fn one_pose_is_found_from_exact_points_in_spite_of_a_wild_one() {
    let truth = pose(0.8);
    let start = moved(&truth, &Vector6::new(0.1, -0.15, 0.08, 0.01, -0.02, 0.05));
    let exact = view(&truth, &face(), |_| DVec2::ZERO);
    let found = refine_pose(&lens(), start, &face(), &points(), &exact, None);
    assert!((found.translation - truth.translation).length() < 1e-6);
    assert!(se3::rotation_angle(&(found.rotation * truth.rotation.transpose())) < 1e-6);
    let wild = view(&truth, &face(), |k| if k == 3 { DVec2::new(40.0, -30.0) } else { DVec2::ZERO });
    let found = refine_pose(&lens(), start, &face(), &points(), &wild, None);
    let angle = se3::rotation_angle(&(found.rotation * truth.rotation.transpose()));
    assert!(angle < 0.01, "{angle}");
}

#[test]
fn a_prior_holds_what_the_points_cannot_tell() {
    let truth = pose(0.8);
    let exact = view(&truth, &face(), |_| DVec2::ZERO);
    let off = moved(&truth, &Vector6::new(0.0, 0.02, 0.0, 0.0, 0.0, 0.01));
    // One point fixes two of six numbers; a firm prior keeps the others.
    let one = FrameView { pixels: exact.pixels[..1].to_vec() };
    let prior = Prior { pose: off, sigma: [1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3] };
    let found = refine_pose(&lens(), off, &face()[..1], &points()[..1], &one, Some(&prior));
    assert!((found.translation.z - off.translation.z).abs() < 2e-3);
    // A loose one gives way to ten exact points.
    let prior = Prior { pose: off, sigma: [10.0; 6] };
    let found = refine_pose(&lens(), off, &face(), &points(), &exact, Some(&prior));
    assert!((found.translation - truth.translation).length() < 1e-5);
}

#[test]
fn the_derivatives_agree_with_finite_differences() {
    let (pose, point, pixel) = (pose(0.4), face()[6], DVec2::new(300.0, 250.0));
    let l = residual(&lens(), &pose, point, pixel, 2.0).unwrap();
    let value = |pose: &Isometry, point| residual(&lens(), pose, point, pixel, 2.0).unwrap().value;
    let e = 1e-6;
    for i in 0..6 {
        let mut step = Vector6::zeros();
        step[i] = e;
        let numeric = (value(&moved(&pose, &step), point) - value(&moved(&pose, &-step), point)) / (2.0 * e);
        assert!((numeric - l.by_pose.column(i)).norm() < 1e-4 * (1.0 + numeric.norm()), "pose {i}");
    }
    for i in 0..3 {
        let mut step = DVec3::ZERO;
        step[i] = e;
        let numeric = (value(&pose, point + step) - value(&pose, point - step)) / (2.0 * e);
        assert!((numeric - l.by_point.column(i)).norm() < 1e-4 * (1.0 + numeric.norm()), "point {i}");
    }
}

#[test]
fn the_adjustment_finds_shape_and_poses_from_a_generic_shape() {
    let truth_poses: Vec<Isometry> = (0..150).map(|i| pose(f64::from(i) * 0.1)).collect();
    let views: Vec<FrameView> = truth_poses.iter().map(|p| view(p, &face(), |_| DVec2::ZERO)).collect();
    // A generic shape: 3 mm off here and there; poses that fit it.
    let mut shape: Vec<DVec3> = face()
        .iter()
        .enumerate()
        .map(|(k, p)| *p + DVec3::new((k as f64).sin(), (k as f64 * 2.0).cos(), (k as f64 * 3.0).sin()) * 3e-3)
        .collect();
    let points = points();
    let lens = lens();
    let mut poses: Vec<Isometry> =
        truth_poses.iter().zip(&views).map(|(p, v)| refine_pose(&lens, *p, &shape, &points, v, None)).collect();
    let bundle = Bundle { lens: &lens, points: &points, views: &views, shape_sigma: 0.02 };
    let before = bundle.loss(&poses, &shape, &shape);
    bundle.adjust(&mut poses, &mut shape, 40);
    let after = bundle.loss(&poses, &shape, &shape);
    assert!(after < before * 1e-3, "{before} {after}");
    // The shape is right up to place, turn and size, which the prior chose.
    let pairs: Vec<_> = face().into_iter().zip(shape.iter().copied()).collect();
    let similarity = umeyama(&pairs, true).unwrap().a_from_b;
    let worst = pairs.iter().map(|(a, b)| a.distance(similarity.transform_point(*b))).fold(0.0, f64::max);
    assert!(worst < 2e-4, "{worst}");
    assert!((similarity.scale - 1.0).abs() < 0.05);
}
