use super::*;
use crate::poses::model::PlacedFrame;
use crate::se3::Twist;
use risorius_formats::{FrameIndex, Intrinsics};

fn lens() -> Intrinsics {
    Intrinsics::pinhole(540, 960, 1150.0)
}

/// An orbit with a shake of 4 Hz, which key frames every quarter of a second cannot follow.
fn truth(i: u32) -> Isometry {
    let t = f64::from(i) / 120.0;
    let shake = 0.004 * (std::f64::consts::TAU * 4.0 * t).sin();
    let turn = [0.1 * (0.9 * t).sin() + shake, 0.3 * (0.6 * t).cos(), 0.0, shake * 0.3, 0.0, 0.0];
    Isometry::new(glam::DMat3::IDENTITY, DVec3::Z * 0.5).compose(&se3::exp(Twist::from_array(turn)))
}

fn face() -> Vec<DVec3> {
    (0..68)
        .map(f64::from)
        .map(|t| DVec3::new((t * 1.7).sin() * 0.07, (t * 0.9).cos() * 0.08, (t * 2.3).sin() * 0.03))
        .collect()
}

fn row(i: u32) -> TrackRow {
    let uniform = |n: u64| {
        let n = (n + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
        let n = (n ^ (n >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        ((n ^ (n >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB) >> 40) as f64 / f64::from(1u32 << 24) - 0.5
    };
    let points_px = std::array::from_fn(|k| {
        let p = lens().project(truth(i).transform_point(face()[k]));
        // A mouth that opens slowly and half a pixel of noise.
        let open = if k >= 48 { 8.0 * (f64::from(i) / 90.0).sin() } else { 0.0 };
        let at = (u64::from(i) * 68 + k as u64) * 2;
        [(p.x + 1.7 * uniform(at)) as f32, (p.y + open + 1.7 * uniform(at + 1)) as f32]
    });
    crate::testing::row(i, &points_px)
}

/// Mean shift of the face in the picture.
fn shift(poses: &BTreeMap<u32, Isometry>) -> f64 {
    let one = |(&i, pose): (&u32, &Isometry)| {
        let pixel = |pose: &Isometry, p: &DVec3| lens().project(pose.transform_point(*p));
        face().iter().map(|p| pixel(pose, p).distance(pixel(&truth(i), p))).sum::<f64>() / 68.0
    };
    poses.iter().map(one).sum::<f64>() / poses.len() as f64
}

#[test]
fn landmarks_recover_the_shake_that_the_spline_cannot_know() {
    let frames: Vec<FrameRecord> = (0..961)
        .map(|i| FrameRecord {
            index: FrameIndex(i),
            timestamp_nanos: i64::from(i) * 8_333_333,
            ..FrameRecord::default()
        })
        .collect();
    let rows: Vec<TrackRow> = (0..961).map(row).collect();
    // A stretch without landmarks keeps the spline's poses.
    let by_frame: BTreeMap<u32, &TrackRow> =
        rows.iter().filter(|r| !(500..530).contains(&r.frame.0)).map(|r| (r.frame.0, r)).collect();
    let placed = TakeModel {
        lenses: BTreeMap::from([(1, lens())]),
        frames: (0..961)
            .step_by(32)
            .map(|i| (i, PlacedFrame { lens: 1, camera_from_world: truth(i), points: vec![] }))
            .collect(),
        points: BTreeMap::new(),
    };
    let mut result = interpolate(&placed.poses(), &frames, 0.5);
    let before = shift(&result.poses);
    let face = face();
    let between = Between { placed: &placed, frames: &frames, rows: &by_frame, face: &face, max_gap_secs: 0.5 };
    let spline = result.poses.clone();
    let count = between.correct(&mut result).unwrap();
    assert_eq!(count, 961 - 31 - 29);
    let after = shift(&result.poses);
    assert!(before > 1.5 && after < 0.4 * before, "{before} {after}");
    let unseen = se3::rotation_angle(&(result.poses[&515].rotation * spline[&515].rotation.transpose()));
    assert!(unseen < 1e-4, "{unseen}");
    // Too few placed frames say nothing about the errors.
    let few = TakeModel { frames: placed.frames.into_iter().take(5).collect(), ..placed };
    let between = Between { placed: &few, frames: &frames, rows: &by_frame, face: &face, max_gap_secs: 0.5 };
    assert_eq!(between.correct(&mut result), None);
}
