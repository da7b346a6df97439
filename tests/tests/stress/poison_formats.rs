//! Poison through `risorius-formats`: cameras, alignments, attributes, smoothing, hulls, curves, writers.

use glam::{DMat3, DVec2, DVec3};
use risorius_formats::camera::Distortion;
use risorius_formats::colmap::ModelCamera;
use risorius_formats::nerfies::{self, Polygon, Polygons};
use risorius_formats::similarity::umeyama;
use risorius_formats::track::HeadPose;
use risorius_formats::{
    ActionUnit, Attribute, AttributeSpec, Camera, Curves, FrameIndex, Intensity, Intrinsics, Isometry, Landmarks68,
    SceneBounds, Silent, Track, TrackRow, colmap, curves, head_hull, openface, polygon, smooth,
};

use crate::support::{Ledger, POISON, POISON_32, check, finite, finite_32};

fn lens(a: &[f64]) -> Intrinsics {
    Intrinsics { fx: a[0], fy: a[1], cx: a[2], cy: a[3], skew: a[4], ..Intrinsics::pinhole(640, 480, 500.0) }
}

fn rows(a: &[f64]) -> Isometry {
    Isometry::from_rows([[a[0], a[1], a[2], a[3]], [a[4], a[5], a[6], a[7]], [a[8], a[9], a[10], a[11]]])
}

const POSE: [f64; 12] = [1.0, 0.0, 0.0, 0.1, 0.0, 1.0, 0.0, -0.2, 0.0, 0.0, 1.0, 2.0];

#[test]
fn cameras_give_a_right_ray_or_none() {
    let mut ledger = Ledger::default();
    ledger.poke("Distortion::undistort", [-0.1, 0.02, 0.01, 0.01, 0.0, 0.0, 0.001, -0.001, 0.3, -0.2], |a| {
        let lens =
            Distortion { radial: [a[0], a[1], a[2]], radial_denominator: [a[3], a[4], a[5]], tangential: [a[6], a[7]] };
        let p = DVec2::new(a[8], a[9]);
        let _ = lens.distort(p);
        match lens.undistort(p) {
            None => Ok(()),
            Some(q) => check((lens.distort(q) - p).length() <= 2e-5, || format!("{p} came from {q}")),
        }
    });
    ledger.poke("Camera::ray_direction", [500.0, 500.0, 320.0, 240.0, 0.0, 100.0, 50.0], |a| {
        let camera = Camera { intrinsics: lens(&a), camera_from_world: rows(&POSE) };
        let Some(d) = camera.ray_direction(DVec2::new(a[5], a[6])) else { return Ok(()) };
        check((d.length() - 1.0).abs() < 1e-9, || format!("{d}"))
    });
    ledger.poke("Camera::ray_direction, pose", POSE, |a| {
        let camera = Camera { intrinsics: Intrinsics::pinhole(640, 480, 500.0), camera_from_world: rows(&a) };
        let _ = (camera.center(), camera.camera_from_world.inverse(), camera.camera_from_world.to_wxyz());
        let Some(d) = camera.ray_direction(DVec2::new(10.0, 20.0)) else { return Ok(()) };
        check((d.length() - 1.0).abs() < 1e-9, || format!("{d}"))
    });
    ledger.poke("Camera::project", [0.1, -0.2, 0.7, 500.0, 320.0], |a| {
        // Plain arithmetic: what is no number stays none, and nothing else is made up.
        let camera = Intrinsics { fx: a[3], cx: a[4], ..Intrinsics::pinhole(640, 480, 500.0) };
        let p = camera.project(DVec3::new(a[0], a[1], a[2]));
        let sound = a.iter().all(|v| v.is_finite() && v.abs() < 1e15) && a[2].abs() > 1e-15;
        if sound { finite(p.to_array()) } else { Ok(()) }
    });
    ledger.poke("Isometry::from_wxyz", [1.0, 0.1, -0.2, 0.3], |a| {
        let r = Isometry::from_wxyz(a, DVec3::ZERO);
        let error = r.orthonormality_error();
        check(error < 1e-9 || !r.rotation.is_finite() || a.iter().any(|v| v.abs() > 1e150), || format!("{error}"))
    });
    ledger.poke("colmap::ModelCamera::intrinsics", [500.0, 501.0, 320.0, 240.0, -0.1, 0.01, 0.0, 0.0], |a| {
        let camera = ModelCamera { model: "OPENCV".into(), width: 640, height: 480, params: a.to_vec() };
        match camera.intrinsics() {
            Err(_) => Ok(()),
            Ok(i) => finite([i.fx, i.fy, i.cx, i.cy]).and(check(i.fx > 0.0 && i.fy > 0.0, || format!("{i:?}"))),
        }
    });
    for divisor in [0, 1, 3, u32::MAX] {
        ledger.one("Intrinsics::reduced", &divisor.to_string(), || {
            let _ = Intrinsics::pinhole(u32::MAX, 1, 1.0).reduced(divisor);
            Ok(())
        });
    }
    ledger.close("cameras");
}

#[test]
fn alignments_and_axes_are_rigid_or_none() {
    let mut ledger = Ledger::default();
    let sound: Vec<(DVec3, DVec3)> = (0..6u32)
        .map(|i| {
            let t = f64::from(i);
            let b = DVec3::new(t.sin(), (t * 1.7).cos(), (t * 0.3).sin());
            (DMat3::from_rotation_z(0.4) * b * 2.0 + DVec3::ONE, b)
        })
        .collect();
    for with_scale in [false, true] {
        ledger.poke("similarity::umeyama", [0.3, 0.1, -0.2, 0.5, 0.4, 0.9], |a| {
            let mut pairs = sound.clone();
            pairs[2] = (DVec3::new(a[0], a[1], a[2]), DVec3::new(a[3], a[4], a[5]));
            let Some(fit) = umeyama(&pairs, with_scale) else { return Ok(()) };
            let s = fit.a_from_b;
            finite([fit.rms, s.scale]).and(finite(s.translation.to_array()))?;
            let error = Isometry::new(s.rotation, DVec3::ZERO).orthonormality_error();
            check(error < 1e-6, || format!("rotation is off by {error}"))
        });
    }
    for (name, v) in POISON {
        ledger.one("similarity::umeyama, all alike", name, || {
            check(umeyama(&[(DVec3::splat(v), DVec3::splat(v)); 5], true).is_none(), || "found".into())
        });
    }
    let face: Vec<DVec3> = (0..68u32)
        .map(|i| DVec3::new(f64::from(i % 17) - 8.0, f64::from(i / 17), (f64::from(i) * 0.7).sin()))
        .collect();
    for place in [0, 8, 16, 20, 36, 45] {
        ledger.poke("head_hull::world_from_head", [0.1, 0.2, 0.3], |a| {
            let mut face = face.clone();
            face[place] = DVec3::from(a);
            let _ = head_hull::head_hull(&face, a[1]);
            let Some(axes) = head_hull::world_from_head(&face) else { return Ok(()) };
            finite(axes.translation.to_array())?;
            check(axes.orthonormality_error() < 1e-6, || format!("{axes:?}"))
        });
    }
    ledger.poke("polygon::convex_hull", [0.5, 0.5, 2.0], |a| {
        let square = [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0), (a[0], a[1])].map(DVec2::from);
        let hull = polygon::convex_hull(&square);
        let _ = polygon::hull_contains(&hull, DVec2::new(a[1], a[2]));
        finite(hull.iter().flat_map(DVec2::to_array))
    });
    ledger.poke("polygon::projected_hull", [0.0, 0.0, 2.0, 500.0], |a| {
        let camera = Camera { intrinsics: Intrinsics::pinhole(64, 48, a[3]), camera_from_world: Isometry::IDENTITY };
        let corners = [DVec3::new(a[0], a[1], a[2]), DVec3::new(1.0, 0.0, 2.0), DVec3::new(0.0, 1.0, 2.0)];
        finite(polygon::projected_hull(&corners, &camera).iter().flat_map(DVec2::to_array))
    });
    ledger.poke("track::HeadPose", [0.1, 0.2, 0.3, 1.0, 2.0, 600.0], |a| {
        let pose =
            HeadPose { rotation_rad: DVec3::new(a[0], a[1], a[2]), translation_mm: DVec3::new(a[3], a[4], a[5]) };
        let there = pose.camera_from_head();
        let back = HeadPose::from_isometry(&there);
        if a.iter().all(|v| v.is_finite()) { finite(back.rotation_rad.to_array()) } else { Ok(()) }
    });
    ledger.close("alignments and axes");
}

#[test]
fn attributes_and_curves_stay_in_their_ranges() {
    let mut ledger = Ledger::default();
    ledger.poke_32("AttributeSpec", [0.3, 4.0, 0.5, 2.0], |[low, high, neutral, value]| {
        let spec = AttributeSpec::from_range(ActionUnit(12), 2, low, high, neutral);
        let scale = spec.scale();
        let all = [scale.attribute(Intensity(value)).0, spec.neutral_attribute().0];
        check(all.iter().all(|v| (-1.0..=1.0).contains(v)), || format!("{all:?} from {spec:?}"))?;
        let activation = scale.activation(Intensity(value)).0;
        check(activation.is_finite() && activation >= 0.0, || format!("activation {activation} from {spec:?}"))?;
        if spec.active {
            finite_32([scale.intensity(Attribute(value.clamp(-2.0, 2.0))).0].into_iter().filter(|_| !value.is_nan()))
        } else {
            Ok(())
        }
    });
    let wave: Vec<f32> = (0..40u16).map(|i| (f32::from(i) * 0.4).sin() + 1.0).collect();
    let smooth_of = |values: &[f32]| {
        let given: Vec<Option<f32>> = values.iter().map(|&v| Some(v)).collect();
        smooth::smooth_segments(&given, 7, smooth::ORDER)
    };
    for place in [0, 3, 20, 39] {
        for (name, poison) in POISON_32 {
            ledger.one("smooth::smooth_segments", &format!("value {place} = {name}"), || {
                let mut values = wave.clone();
                values[place] = poison;
                let (got, pure) = (smooth_of(&values), smooth_of(&wave));
                for (i, value) in got.iter().enumerate() {
                    let value = value.ok_or("a value is gone")?;
                    if i == place && !poison.is_finite() {
                        check(value.to_bits() == poison.to_bits(), || format!("{place} became {value}"))?;
                    } else if poison.abs() <= 1e30 || !poison.is_finite() {
                        finite_32([value])?;
                    }
                    if i.abs_diff(place) > 7 && (10..30).contains(&i) {
                        check(Some(value) == pure[i], || format!("{i} is touched by {place}"))?;
                    }
                }
                Ok(())
            });
        }
    }
    for window in [0, 1, 2, 4, 39, 40, 41, 1000, 1 << 30] {
        for order in [0, 1, 3, 8] {
            ledger.one("smooth::smooth_run", &format!("window {window}, order {order}"), || {
                let values: Vec<f64> = wave.iter().map(|&v| f64::from(v)).collect();
                let out = smooth::smooth_run(&values, window, order);
                check(out.len() == 40, || format!("{} values", out.len())).and(finite(out))
            });
        }
    }
    ledger.poke("smooth::window_for_fps", [120.0], |[fps]| {
        let window = smooth::window_for_fps(fps);
        check(window % 2 == 1 && (5..=1_000_001).contains(&window), || window.to_string())
    });
    ledger.poke("curves::interpolate", [0.0, 1.0, 3.0, 0.5], |[a, b, c, t]| {
        let value = curves::interpolate(&[a, b, c], &[0.0, 1.0, 2.0], t);
        let sound = a < b && b < c && t.is_finite() && (c - a).is_finite();
        if sound { check((0.0..=2.0).contains(&value), || value.to_string()) } else { Ok(()) }
    });
    ledger.poke("SceneBounds::is_valid", [0.1, 0.2, 0.3, 1.5, 0.4, 3.0], |a| {
        let scene = SceneBounds { center_in_world: DVec3::new(a[0], a[1], a[2]), scale: a[3], near: a[4], far: a[5] };
        if !scene.is_valid() {
            return Ok(());
        }
        finite(scene.scene_from_world(DVec3::ONE).to_array())?;
        finite_32(scene.scene_from_world(DVec3::ONE).as_vec3().to_array())?;
        finite_32([1.0 / a[3] as f32, 1.0 / a[4] as f32, 1.0 / a[5] as f32, (a[5] / a[3]) as f32])
    });
    ledger.close("attributes and curves");
}

fn row(frame: u32) -> TrackRow {
    TrackRow {
        frame: FrameIndex(frame),
        face_id: 0,
        timestamp_secs: Some(f64::from(frame) / 30.0),
        confidence: 0.9,
        success: true,
        intensities: vec![Some(1.0)],
        presences: vec![Some(true)],
        landmarks: None,
        landmarks_in_camera_mm: None,
        head_pose: None,
    }
}

#[test]
fn writers_refuse_what_readers_would_not_take() {
    let mut ledger = Ledger::default();
    let dir = tempfile::tempdir().unwrap();
    ledger.poke("nerfies::write_camera", POSE, |a| {
        let camera = Camera { intrinsics: Intrinsics::pinhole(64, 48, 60.0), camera_from_world: rows(&a) };
        let path = dir.path().join("camera.json");
        let _ = std::fs::remove_file(&path);
        if let Err(e) = nerfies::write_camera(&path, &camera) {
            return check(e.path().is_some() && !path.exists(), || format!("{e}, and a file is left"));
        }
        let text = std::fs::read_to_string(&path).map_err(|e| e.to_string())?;
        check(!text.contains("null") && !text.contains("NaN"), || text)
    });
    ledger.poke_32("openface::to_bytes", [1.0, 0.9, 0.5], |[intensity, confidence, x]| {
        let points = std::array::from_fn(|i| [i as f32 + x, i as f32]);
        let track = Track {
            units: vec![ActionUnit(12)],
            presence_units: vec![ActionUnit(12)],
            rows: (0..3)
                .map(|i| TrackRow {
                    intensities: vec![Some(intensity)],
                    confidence,
                    landmarks: Some(Box::new(Landmarks68 { points_px: points })),
                    ..row(i)
                })
                .collect(),
        };
        let curves = Curves::from_track(&track, 0.5);
        finite(curves.times_secs.iter().copied())?;
        let Ok(bytes) = openface::to_bytes(&track) else { return Ok(()) };
        let Ok(back) = openface::parse(&bytes, &openface::ReadOptions::default(), &Silent) else { return Ok(()) };
        for row in &back.rows {
            finite_32(row.intensities.iter().flatten().copied())?;
            finite_32(row.landmarks.iter().flat_map(|l| l.points_px).flatten())?;
        }
        Ok(())
    });
    ledger.poke("Curves::from_track", [0.0, 0.033, 0.066], |times| {
        let rows = times.iter().zip(0..).map(|(&t, i)| TrackRow { timestamp_secs: Some(t), ..row(i) }).collect();
        let track = Track { units: vec![ActionUnit(12)], presence_units: vec![ActionUnit(12)], rows };
        let curves = Curves::from_track(&track, 0.5);
        finite(curves.times_secs.iter().copied().chain([curves.fps()]))
    });
    ledger.poke_32("Landmarks68", [3.0, 4.0], |a| {
        let mut points: [[f32; 2]; 68] = std::array::from_fn(|i| [i as f32 * 3.0, (i as f32).sin()]);
        points[36] = a;
        let landmarks = Landmarks68 { points_px: points };
        let _ = (landmarks.asymmetry(), landmarks.bounds_px(), landmarks.outer_eye_distance_px());
        check(landmarks.is_finite() == a.iter().all(|v| v.is_finite()), || "is_finite lies".into())
    });
    ledger.poke("nerfies::Polygons::label_image", [10.0, 12.0], |a| {
        let points_px = vec![[1.0, 1.0], [40.0, 2.0], a, [3.0, 30.0]];
        let file = Polygons {
            polygons: vec![Polygon { label: "AU12".into(), points_px }],
            image_path: None,
            image_size: None,
        };
        let image = file.label_image(&[("AU12", 3)], 1, 48, 32);
        check(image.labels.iter().all(|&l| l == 0 || l == 3), || "another label".into())
    });
    for (width, height) in [(0, 0), (1, 0), (0, 7)] {
        ledger.one("nerfies::fill_polygon", &format!("{width}×{height}"), || {
            nerfies::fill_polygon(&[[0.0, 0.0], [9.0, 0.0], [4.0, 9.0]], width, height, |_, _| {});
            Ok(())
        });
    }
    ledger.one("colmap::images_to_text", "NaN pose", || {
        let mut images = std::collections::BTreeMap::new();
        let image = colmap::ModelImage {
            camera_from_world: Isometry::new(DMat3::IDENTITY * f64::NAN, DVec3::NAN),
            camera_id: 1,
            name: "a.png".into(),
            points: Vec::new(),
        };
        images.insert(1, image);
        let Ok(bytes) = colmap::images_to_text(&images) else { return Ok(()) };
        check(colmap::parse_images_text(&bytes).is_err(), || "a NaN comes back as a pose".into())
    });
    ledger.close("writers");
}
