//! Poison through `risorius-tracker`: triangulation, pose from points, shapes, interpolation and smoothing of cameras.

use std::collections::BTreeMap;

use glam::{DMat3, DVec2, DVec3};
use risorius_formats::{
    ActionUnit, Camera, FrameIndex, FrameRecord, Intrinsics, Isometry, Landmarks68, Track, TrackRow,
};
use risorius_tracker::head_pose::shape::{self, ShapeModel};
use risorius_tracker::head_pose::{Lens, pnp};
use risorius_tracker::poses::triangulate::{View, triangulate};
use risorius_tracker::poses::{depths, focal, interpolate, keyframes, smooth};
use risorius_tracker::quality;

use crate::support::{Ledger, POISON, check, finite, finite_32};

fn camera(x: f64) -> Camera {
    let rotation = DMat3::from_rotation_y(-0.3 * x);
    Camera {
        intrinsics: Intrinsics::pinhole(640, 480, 700.0),
        camera_from_world: Isometry::new(rotation, -(rotation * DVec3::new(x, 0.1 * x, -2.0))),
    }
}

fn face() -> Vec<DVec3> {
    (0..68u32)
        .map(f64::from)
        .map(|t| DVec3::new(65.0 * (t * 1.9).sin(), 60.0 * (t * 0.7).cos(), 40.0 * (t * 1.1).sin()))
        .collect()
}

fn rigid(pose: &Isometry) -> crate::support::Verdict {
    finite(pose.translation.to_array())?;
    check(pose.orthonormality_error() < 1e-6, || format!("{pose:?}"))
}

#[test]
fn points_and_poses_are_found_or_not() {
    let mut ledger = Ledger::default();
    let truth = DVec3::new(0.1, -0.2, 0.3);
    let views: Vec<View> = (-4..=4)
        .map(|i| 0.1 * f64::from(i))
        .map(|x| View::new(&camera(x), camera(x).project(truth)).unwrap())
        .collect();
    ledger.poke("triangulate", [0.1, 0.2, 2.0, 0.05, -0.1, 700.0], |a| {
        let mut views = views.clone();
        views[3].camera_from_world.translation = DVec3::new(a[0], a[1], a[2]);
        (views[3].normalised, views[3].focal_px) = (DVec2::new(a[3], a[4]), a[5]);
        let Some(t) = triangulate(&views) else { return Ok(()) };
        finite(t.point.to_array()).and(finite([t.median_error_px, t.parallax_rad]))
    });
    for (name, v) in POISON {
        ledger.one("triangulate, all views", name, || {
            let broken: Vec<View> = views
                .iter()
                .map(|view| View {
                    camera_from_world: Isometry::new(view.camera_from_world.rotation * v, DVec3::splat(v)),
                    ..*view
                })
                .collect();
            let Some(t) = triangulate(&broken) else { return Ok(()) };
            finite(t.point.to_array()).and(finite([t.median_error_px, t.parallax_rad]))
        });
    }
    let points = face();
    let pose = Isometry::new(DMat3::from_rotation_y(0.2), DVec3::new(10.0, -5.0, 600.0));
    let seen: Vec<DVec2> = points.iter().map(|&p| pose.transform_point(p)).map(|p| p.truncate() / p.z).collect();
    ledger.poke("pnp::solve", [0.01, 0.02, 1.0, 0.01, 10.0, 20.0, 30.0], |a| {
        let (mut seen, mut points, mut weights) = (seen.clone(), points.clone(), [1.0; 68]);
        (seen[30], weights[31]) = (DVec2::new(a[0], a[1]), a[2]);
        points[33] = DVec3::new(a[4], a[5], a[6]);
        let Some((found, error)) = pnp::solve(&points, &seen, &weights, a[3], None) else { return Ok(()) };
        rigid(&found).and(finite([error]))
    });
    ledger.poke("pnp::solve, start", [0.1, 0.0, 600.0], |a| {
        let start = Isometry::new(DMat3::IDENTITY, DVec3::from(a));
        let Some((found, error)) = shape::pose(&points, &seen, Some(&start)) else { return Ok(()) };
        rigid(&found).and(finite([error]))
    });
    for (name, v) in POISON {
        ledger.one("shape::pose, all alike", name, || {
            let Some((found, error)) = shape::pose(&[DVec3::splat(v); 68], &[DVec2::splat(v); 68], None) else {
                return Ok(());
            };
            rigid(&found).and(finite([error]))
        });
    }
    let model = ShapeModel {
        modes: vec![points.iter().map(|p| DVec3::new(0.0, 0.0, 3.0 * (p.x * 0.05).sin())).collect()],
        mean: points.clone(),
    };
    ledger.poke_32("ShapeModel::fit", [320.0, 240.0, 700.0], |a| {
        let lens = Lens { focal_px: f64::from(a[2]), center_px: DVec2::new(320.0, 240.0) };
        let picture = |shift: f32| {
            let mut p: [[f32; 2]; 68] =
                std::array::from_fn(|i| [320.0 + shift + 700.0 * seen[i].x as f32, 240.0 + 700.0 * seen[i].y as f32]);
            p[30] = [a[0], a[1]];
            p
        };
        let person = model.fit(&lens, &[picture(0.0), picture(3.0)]);
        finite(person.coefficients.iter().copied().chain([person.error]))
            .and(finite(person.points.iter().flat_map(DVec3::to_array)))
    });
    ledger.close("points and poses");
}

fn frames(times: &[i64]) -> Vec<FrameRecord> {
    times
        .iter()
        .zip(0..)
        .map(|(&t, i)| FrameRecord { index: FrameIndex(i), timestamp_nanos: t, ..FrameRecord::default() })
        .collect()
}

#[test]
fn cameras_between_and_around_stay_rigid() {
    let mut ledger = Ledger::default();
    let times: Vec<i64> = (0..60).map(|i| i * 8_333_333).collect();
    ledger.poke("poses::interpolate", [0.5, 0.1, 0.2, 2.0], |a| {
        let mut placed: BTreeMap<u32, Isometry> =
            (0..6u32).map(|i| (i * 10, camera(0.02 * f64::from(i)).camera_from_world)).collect();
        placed.insert(30, Isometry::new(DMat3::from_rotation_x(0.1), DVec3::new(a[1], a[2], a[3])));
        let found = interpolate::interpolate(&placed, &frames(&times), a[0]);
        let sound = a.iter().all(|v| v.is_finite() && v.abs() < 1e100);
        if sound { found.poses.values().try_for_each(rigid) } else { Ok(()) }
    });
    // Times that stand still, go back or leap.
    for (name, times) in [
        ("still", vec![0i64; 60]),
        ("back", (0..60).rev().map(|i| i * 1_000).collect()),
        ("leap", (0..60).map(|i| if i > 30 { 31_000_000_000_000_000 } else { i }).collect()),
    ] {
        ledger.one("poses::interpolate", name, || {
            let placed: BTreeMap<u32, Isometry> =
                (0..6u32).map(|i| (i * 10, camera(0.02 * f64::from(i)).camera_from_world)).collect();
            let found = interpolate::interpolate(&placed, &frames(&times), interpolate::MAX_GAP_SECS);
            found.poses.values().try_for_each(rigid)
        });
        for count in [0, 1, 2, 3, 40, 59, 60, usize::MAX] {
            ledger.one("keyframes::choose", &format!("{name}, {count}"), || {
                let chosen = keyframes::choose(&frames(&times), &Track::default(), count);
                let _ = keyframes::default_count(&frames(&times));
                check(chosen.windows(2).all(|w| w[0] < w[1]), || format!("{chosen:?}"))
            });
        }
    }
    ledger.poke("poses::smooth", [0.3, 0.0, 0.1, 2.0], |a| {
        let mut poses: Vec<Isometry> = (0..20).map(|i| camera(0.01 * f64::from(i)).camera_from_world).collect();
        poses[9].translation = DVec3::new(a[1], a[2], a[3]);
        let secs: Vec<f64> = (0..20).map(|i| f64::from(i) / 30.0).collect();
        let out = smooth::smooth(&poses, &secs, a[0]);
        let sound = a.iter().all(|v| v.is_finite() && v.abs() < 1e100);
        if sound { out.iter().try_for_each(rigid) } else { Ok(()) }
    });
    ledger.poke("depths::range", [0.5, 0.7, 0.1, 3.0], |a| {
        let mut points: Vec<f64> = (0..100).map(|i| 0.5 + 0.03 * f64::from(i)).collect();
        points[50] = a[3];
        let range = depths::range([a[0], a[1]], a[2], points);
        let sound = a.iter().all(|v| v.is_finite() && v.abs() < 1e100);
        if sound { finite([range.near, range.far]) } else { Ok(()) }
    });
    ledger.poke_32("focal::table_camera", [10.0, 20.0, 500.0, 330.0, 240.0], |a| {
        let solid: [[f32; 3]; 68] = std::array::from_fn(|i| {
            let t = i as f32;
            if i == 7 {
                [a[0], a[1], a[2]]
            } else {
                [70.0 * t.sin(), 90.0 * (0.7 * t).cos(), 500.0 + 40.0 * (0.4 * t).sin()]
            }
        });
        let mut flat = solid.map(|[x, y, z]| [900.0 * x / z + 320.0, 900.0 * y / z + 240.0]);
        flat[9] = [a[3], a[4]];
        let row = TrackRow {
            landmarks: Some(Box::new(Landmarks68 { points_px: flat })),
            landmarks_in_camera_mm: Some(Box::new(solid)),
            ..row(0, 1.0)
        };
        let rows = [row.clone(), row.clone(), row];
        let Some(c) = focal::table_camera(&rows) else { return Ok(()) };
        finite([c.focal_px, c.cx, c.cy, c.median_error_px])
    });
    ledger.poke_32("quality::measure", [1.0, 0.9], |[intensity, confidence]| {
        let mut rows: Vec<TrackRow> = (0..20).map(|i| row(i, 1.0)).collect();
        rows[5] = TrackRow { confidence, ..row(5, intensity) };
        let track = Track { units: vec![ActionUnit(12)], presence_units: Vec::new(), rows };
        let q = quality::measure(&track, 20, 0.5);
        finite(q.au_jitter.into_iter().chain(q.landmark_jitter_px).chain(q.outer_eye_distance_px))
            .and(finite_32(q.units.iter().filter_map(|u| u.max)))
    });
    ledger.close("cameras between");
}

fn row(frame: u32, intensity: f32) -> TrackRow {
    TrackRow {
        frame: FrameIndex(frame),
        face_id: 0,
        timestamp_secs: None,
        confidence: 0.9,
        success: true,
        intensities: vec![Some(intensity)],
        presences: Vec::new(),
        landmarks: None,
        landmarks_in_camera_mm: None,
        head_pose: None,
    }
}
