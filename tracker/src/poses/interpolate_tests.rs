use super::*;
use glam::DVec3;
use risorius_formats::FrameIndex;

fn frames(n: u32, nanos: impl Fn(u32) -> i64) -> Vec<FrameRecord> {
    (0..n).map(|i| FrameRecord { index: FrameIndex(i), timestamp_nanos: nanos(i), ..FrameRecord::default() }).collect()
}

fn difference(a: &Isometry, b: &Isometry) -> (f64, f64) {
    (se3::rotation_angle(&(a.rotation * b.rotation.transpose())), (a.camera_center() - b.camera_center()).length())
}

#[test]
fn a_constant_twist_is_met_exactly_whatever_the_clock() {
    let start = se3::exp(Twist::from_array([0.4, -0.2, 0.1, 3.0, 1.0, -2.0]));
    let twist = [0.3, -0.9, 0.5, 0.2, 0.1, -0.4];
    // An uneven clock: interpolation by frame number would miss.
    let frames = frames(90, |i| i64::from(i) * 8_000_000 + i64::from(i % 7) * 900_000);
    let pose = |i: u32| {
        let t = frames[i as usize].timestamp_nanos as f64 * 1e-9;
        start.compose(&se3::exp(Twist::from_array(twist.map(|v| v * t)))).inverse()
    };
    let placed: BTreeMap<u32, Isometry> = [0, 11, 20, 37, 60, 89].into_iter().map(|i| (i, pose(i))).collect();
    let result = interpolate(&placed, &frames, MAX_GAP_SECS);
    assert_eq!(result.poses.len(), 90 - 6);
    for (&i, got) in &result.poses {
        let (angle, distance) = difference(got, &pose(i));
        assert!(angle < 1e-12 && distance < 1e-12, "frame {i}: {angle} rad, {distance}");
    }
    assert_eq!(result.runs.first(), Some(&[1, 10]));
}

#[test]
fn a_swaying_camera_is_met_to_fourth_order() {
    let frames = frames(481, |i| i64::from(i) * 8_333_333);
    let pose = |i: u32| {
        let t = f64::from(i) / 120.0;
        let sway =
            [0.3 * (2.0 * t).sin(), 0.5 * (1.3 * t).cos(), 0.0, 0.1 * (2.0 * t).cos(), 0.0, 0.05 * (1.7 * t).sin()];
        se3::exp(Twist::from_array(sway)).inverse()
    };
    let worst = |step: usize| {
        let placed: BTreeMap<u32, Isometry> = (0..481).step_by(step).map(|i| (i, pose(i))).collect();
        let result = interpolate(&placed, &frames, MAX_GAP_SECS);
        // The ends are left out: a natural end has no curvature.
        result
            .poses
            .iter()
            .filter(|(i, _)| (120..360).contains(*i))
            .map(|(&i, p)| difference(p, &pose(i)).0)
            .fold(0.0, f64::max)
    };
    let (coarse, fine) = (worst(40), worst(20));
    assert!(coarse < 1e-3 && fine < coarse / 8.0, "{coarse} {fine}");
}

#[test]
fn long_gaps_and_the_ends_stay_empty() {
    let frames = frames(200, |i| i64::from(i) * 10_000_000);
    let pose = Isometry::new(glam::DMat3::IDENTITY, DVec3::ONE);
    let placed = BTreeMap::from([(10, pose), (40, pose), (100, pose), (120, pose)]);
    let result = interpolate(&placed, &frames, MAX_GAP_SECS);
    assert_eq!(result.runs, [[11, 39], [101, 119]]);
    assert_eq!(result.gaps, [[41, 99]]);
    assert!(result.poses.keys().all(|f| (11..40).contains(f) || (101..120).contains(f)));
    assert!(interpolate(&BTreeMap::from([(5, pose)]), &frames, MAX_GAP_SECS).poses.is_empty());
}
