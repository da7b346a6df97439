use super::*;
use crate::se3::{rotation_angle, rotation_exp};
use crate::testing;
use glam::DMat3;
use risorius_formats::polygon::{hull_contains, projected_hull};
use risorius_formats::report::Collected;
use risorius_formats::track::HeadPose;

const FOCAL: f64 = 700.0;

/// A person's 68 points, metres, head frame: jaw, brows, nose, eyes, mouth.
fn person() -> Vec<DVec3> {
    let mm = |x: f64, y: f64, z: f64| DVec3::new(x, y, z) * 1e-3;
    (0..68usize)
        .map(|i| {
            let t = i as f64;
            match i {
                0..17 => {
                    let a = std::f64::consts::PI * t / 16.0;
                    mm(-70.0 * a.cos(), 10.0 + 75.0 * a.sin(), 80.0 - 70.0 * a.sin())
                }
                17..27 => mm(-55.0 + (t - 17.0) * 12.0, -38.0, 12.0),
                27..31 => mm(0.0, -25.0 + (t - 27.0) * 12.0, 2.0 - (t - 27.0) * 7.0),
                31..36 => mm((t - 33.0) * 7.0, 20.0, -2.0 - 5.0 * (2.0 - (t - 33.0).abs())),
                36..42 => mm(-45.0 + (t - 36.0) * 6.0, -25.0 + 3.0 * (t * 2.0).sin(), 18.0),
                42..48 => mm(15.0 + (t - 42.0) * 6.0, -25.0 + 3.0 * (t * 2.0).sin(), 18.0),
                _ => mm(25.0 * (t * 0.6).cos(), 42.0 + 8.0 * (t * 0.6).sin(), 2.0),
            }
        })
        .collect()
}

fn truth(i: u32) -> Isometry {
    let t = f64::from(i) / 30.0;
    let rotation = rotation_exp(DVec3::new(0.2 * (1.7 * t).sin(), 0.45 * t.sin(), 0.1 * (0.8 * t).cos()));
    Isometry::new(rotation, DVec3::new(0.02 * t.cos(), 0.01 * t.sin(), 0.6 + 0.02 * (0.6 * t).sin()))
}

/// Landmarks with an open jaw now and then; poses that are a few degrees and centimetres off, as from a generic face.
fn row(i: u32) -> TrackRow {
    let lens = Intrinsics::pinhole(480, 480, FOCAL);
    let open = if i % 40 < 8 { 0.02 } else { 0.0 };
    let points_px = std::array::from_fn(|k| {
        let jaw = if (4..13).contains(&k) || (55..60).contains(&k) { DVec3::Y * open } else { DVec3::ZERO };
        let p = lens.project(truth(i).transform_point(person()[k] + jaw));
        let noise = |s: u64| {
            ((u64::from(i) * 977 + k as u64 * 31 + s).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 40) as f64
                / f64::from(1u32 << 24)
                - 0.5
        };
        [(p.x + noise(1)) as f32, (p.y + noise(2)) as f32]
    });
    let off = rotation_exp(DVec3::new(0.05 * f64::from(i).sin(), 0.07 * (f64::from(i) * 0.7).cos(), 0.02));
    let pose =
        Isometry::new(truth(i).rotation * off, (truth(i).translation * 1.02 + DVec3::new(0.002, -0.003, 0.0)) * 1e3);
    TrackRow { head_pose: Some(HeadPose::from_isometry(&pose)), ..testing::row(i, &points_px) }
}

fn options(refine: bool) -> HeadOptions {
    HeadOptions { focal_px: Some(FOCAL), smooth_secs: 0.0, refine, min_confidence: 0.8 }
}

/// Mean angle between found and true relative rotations (the frame's own turn does not count).
fn mean_angle(route: &HeadRoute) -> f64 {
    let offset = |i: u32| route.model.frames[&i].camera_from_world.rotation.transpose() * truth(i).rotation;
    let reference = offset(0);
    (1..240).map(|i| rotation_angle(&(offset(i) * reference.transpose()))).sum::<f64>() / 239.0
}

#[test]
fn refined_poses_are_much_closer_to_the_truth_than_the_tables() {
    let dir = tempfile::tempdir().unwrap();
    let take = Take::open(testing::take_at(dir.path(), 480, 480, 240, 30.0)).unwrap();
    let track = Track { rows: (0..240).map(row).collect(), ..Track::default() };
    let before = find(&take, &track, &options(false), None, &Collected::default()).unwrap();
    let after = find(&take, &track, &options(true), None, &Collected::default()).unwrap();
    let (b, a) = (mean_angle(&before), mean_angle(&after));
    assert!(a < 0.25 * b && a < 0.02, "{b} {a}");
    assert!(after.head.landmark_error_px < 0.6 * before.head.landmark_error_px);
    // The hull holds the open jaw's chin in every frame.
    let lens = after.model.lenses[&1];
    for i in (0..240).step_by(5) {
        let camera = Camera { intrinsics: lens, camera_from_world: after.model.frames[&i].camera_from_world };
        let outline = projected_hull(&after.hull, &camera);
        let points = track.rows[i as usize].landmarks.as_ref().unwrap();
        for p in &points.points_px {
            assert!(hull_contains(&outline, DVec2::new(p[0].into(), p[1].into())), "frame {i}");
        }
    }
    // Rotations stay rotations.
    assert!(after.model.frames.values().all(|f| f.camera_from_world.orthonormality_error() < 1e-9));
    assert!(after.model.frames.values().all(|f| f.camera_from_world.rotation != DMat3::IDENTITY));
}

#[test]
fn a_table_without_landmarks_or_poses_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let take = Take::open(testing::take(dir.path(), 480, 480, 40)).unwrap();
    let without = |change: fn(&mut TrackRow)| {
        let mut rows: Vec<TrackRow> = (0..40).map(row).collect();
        rows.iter_mut().for_each(change);
        find(&take, &Track { rows, ..Track::default() }, &options(true), None, &Collected::default())
            .unwrap_err()
            .to_string()
    };
    assert!(without(|r| r.landmarks = None).contains("no landmarks"));
    assert!(without(|r| r.head_pose = None).contains("no head pose"));
    assert!(without(|r| r.success = false).contains("fewer than 10"));
}
