//! A rendered room of two walls and a floor, with known cameras: key frames are made exact, the others placed.

use super::*;
use crate::poses::model::PlacedFrame;
use crate::poses::sharpen::sharpen;
use glam::DMat3;
use image::{Rgb, RgbImage};
use risorius_formats::FrameIndex;
use risorius_formats::colmap::{Point2d, Point3d};
use risorius_formats::report::Collected;
use risorius_formats::take::SourceKind;

const FRAMES: u32 = 36;
const EVERY: u32 = 5;

fn lens() -> Intrinsics {
    Intrinsics::pinhole(240, 180, 230.0)
}

fn noise(seed: u64) -> f64 {
    let n = (seed + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    let n = (n ^ (n >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    ((n ^ (n >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB) >> 40) as f64 / f64::from(1u32 << 24) - 0.5
}

/// Walls: a point, and the normal.
fn walls() -> [(DVec3, DVec3); 3] {
    [(DVec3::Z * 3.0, -DVec3::Z), (DVec3::X * -1.3, DVec3::X), (DVec3::Y * 0.8, -DVec3::Y)]
}

fn truth(i: u32) -> Isometry {
    let t = f64::from(i) / f64::from(FRAMES) - 0.5;
    // A hand's shake of some pixels on top of an arc.
    let shake = 0.012 * (f64::from(i) * 1.1).sin();
    let rotation = DMat3::from_rotation_y(-0.35 * t + shake) * DMat3::from_rotation_x(0.05 * (7.0 * t).sin());
    let center = DVec3::new(1.1 * t, 0.1 * (9.0 * t).cos(), 0.3 * t * t);
    Isometry::new(rotation, -(rotation * center))
}

/// Where a pixel's ray meets the room.
fn hit(pose: &Isometry, pixel: DVec2) -> Option<DVec3> {
    hit_by(&lens(), pose, pixel)
}

fn hit_by(lens: &Intrinsics, pose: &Isometry, pixel: DVec2) -> Option<DVec3> {
    let world_from_camera = pose.inverse();
    let ray = world_from_camera.rotation * lens.unproject(pixel)?.extend(1.0);
    let start = world_from_camera.translation;
    let along = |(p, n): (DVec3, DVec3)| (p - start).dot(n) / ray.dot(n);
    let nearest = walls().into_iter().map(along).filter(|t| *t > 0.1).fold(f64::INFINITY, f64::min);
    nearest.is_finite().then(|| start + ray * nearest)
}

fn colour(p: DVec3) -> u8 {
    let wave = |k: u64| {
        let axis = DVec3::new(noise(7 * k), noise(7 * k + 1), noise(7 * k + 2)) * 110.0;
        (p.dot(axis) + 20.0 * noise(7 * k + 3)).sin()
    };
    (128.0 + 22.0 * (0..9).map(wave).sum::<f64>()).clamp(0.0, 255.0) as u8
}

fn render(lens: &Intrinsics, pose: &Isometry) -> RgbImage {
    RgbImage::from_fn(240, 180, |x, y| {
        let p = hit_by(lens, pose, DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
        Rgb([p.map_or(0, colour); 3])
    })
}

fn frames() -> Vec<FrameRecord> {
    (0..FRAMES)
        .map(|i| FrameRecord {
            index: FrameIndex(i),
            timestamp_nanos: i64::from(i) * 33_000_000,
            ..FrameRecord::default()
        })
        .collect()
}

/// What COLMAP would give: key frames a little off, points where their noisy features say.
fn model() -> TakeModel {
    let keys: Vec<u32> = (0..FRAMES).step_by(EVERY as usize).collect();
    let mut model = TakeModel { lenses: BTreeMap::from([(1, lens())]), ..TakeModel::default() };
    for &k in &keys {
        let twist = std::array::from_fn(|c| 0.004 * noise(u64::from(k) * 6 + c as u64));
        let camera_from_world = se3::exp(Twist::from_array(twist)).compose(&truth(k));
        model.frames.insert(k, PlacedFrame { lens: 1, camera_from_world, points: vec![] });
    }
    let mut id = 0u64;
    for &k in &keys {
        for place in 0..40u64 {
            id += 1;
            let pixel = DVec2::new(120.0 + 200.0 * noise(id * 2), 90.0 + 140.0 * noise(id * 2 + 1));
            let Some(position) = hit(&truth(k), pixel) else { continue };
            let mut track = Vec::new();
            for &other in &keys {
                let at = lens().project(truth(other).transform_point(position));
                let seen = DVec2::new(noise(id * 99 + u64::from(other)), noise(id * 77 + u64::from(other))) * 1.5 + at;
                let inside = at.x > 2.0 && at.y > 2.0 && at.x < 238.0 && at.y < 178.0;
                let visible = hit(&truth(other), at).is_some_and(|p| p.distance(position) < 0.02);
                if inside && visible && (place % 2 == 0 || other.abs_diff(k) <= EVERY) {
                    let frame = model.frames.get_mut(&other).unwrap();
                    track.push((other + 1, frame.points.len() as u32));
                    frame.points.push(Point2d { position_px: seen.to_array(), point3d: Some(id) });
                }
            }
            model.points.insert(id, Point3d { position, rgb: [0; 3], error_px: 0.5, track });
        }
    }
    model
}

/// Mean error of the turns between each frame and the first, degrees.
fn turn_error(poses: &BTreeMap<u32, Isometry>) -> f64 {
    let first = poses[&0];
    let error = |(&i, p): (&u32, &Isometry)| {
        let (own, exact) = (p.rotation * first.rotation.transpose(), truth(i).rotation * truth(0).rotation.transpose());
        se3::rotation_angle(&(own * exact.transpose())).to_degrees()
    };
    poses.iter().map(error).sum::<f64>() / poses.len() as f64
}

/// The room's frames as files, and the pictures of the key frames.
fn video(change: impl Fn(u32, RgbImage) -> RgbImage) -> (tempfile::TempDir, BTreeMap<u32, Picture>) {
    let dir = tempfile::tempdir().unwrap();
    let mut pictures = BTreeMap::new();
    for i in 0..FRAMES {
        let image = change(i, render(&lens(), &truth(i)));
        if i % EVERY == 0 {
            pictures.insert(i, Picture::new(&image));
        }
        image.save(dir.path().join(format!("{i:03}.png"))).unwrap();
    }
    (dir, pictures)
}

/// A take of the pictures in a folder.
fn take_of(pictures: &std::path::Path) -> Take {
    let dir = tempfile::tempdir().unwrap();
    let mut take = Take::open(crate::testing::take(dir.path(), 240, 180, FRAMES)).unwrap();
    take.manifest.source = SourceKind::Images;
    take.manifest.media = pictures.to_owned();
    take
}

#[test]
fn key_frames_become_exact_and_all_others_find_their_place() {
    let (dir, pictures) = video(|_, image| image);
    let mut model = model();
    let before = turn_error(&model.poses());
    let sharpened = sharpen(&mut model, &pictures).unwrap();
    let after = turn_error(&model.poses());
    assert!(before > 0.1 && after < 0.03 && sharpened.median_error_px < 0.15, "{before} {after} {sharpened:?}");
    assert!((model.lenses[&1].fx / 230.0 - 1.0).abs() < 0.01, "{:?}", model.lenses);
    assert!(model.reprojection_error_px().unwrap() < 0.2);
    let frames = frames();
    let follow = Follow::new(&model, &pictures, &frames, |_, _| false).unwrap();
    let followed = follow.run(&model.poses(), &take_of(dir.path()), &BTreeSet::new(), &Collected::default()).unwrap();
    assert_eq!(followed.poses.len() + pictures.len(), FRAMES as usize, "lost {:?}", followed.lost);
    let mut all = followed.poses;
    all.extend(model.poses());
    let error = turn_error(&all);
    assert!(error < 0.04, "{error}");
    // Interpolation cannot know the shake.
    let mut spline = interpolate(&model.poses(), &frames, 1.0).poses;
    spline.extend(model.poses());
    assert!(turn_error(&spline) > 5.0 * error);
}

#[test]
fn frames_without_the_scene_are_lost_and_the_next_ones_found_again() {
    let (dir, pictures) =
        video(|i, image| if (11..14).contains(&i) { RgbImage::from_pixel(240, 180, Rgb([90; 3])) } else { image });
    let mut model = model();
    sharpen(&mut model, &pictures).unwrap();
    let frames = frames();
    let follow = Follow::new(&model, &pictures, &frames, |_, _| false).unwrap();
    let followed = follow.run(&model.poses(), &take_of(dir.path()), &BTreeSet::new(), &Collected::default()).unwrap();
    assert_eq!(followed.lost, [11, 12, 13]);
    let mut found = followed.poses;
    found.extend(model.poses());
    assert!(found.contains_key(&14) && turn_error(&found) < 0.04);
    // Patches on what is to be avoided are not used.
    assert!(Follow::new(&model, &pictures, &frames, |_, _| true).is_none());
}

#[test]
fn a_principal_point_off_the_middle_is_found() {
    let off = DVec2::new(9.0, -7.0);
    let exact = Intrinsics { cx: 120.0 + off.x, cy: 90.0 + off.y, ..lens() };
    let mut pictures = BTreeMap::new();
    for i in (0..FRAMES).step_by(EVERY as usize) {
        pictures.insert(i, Picture::new(&render(&exact, &truth(i))));
    }
    // COLMAP holds the middle: its cameras are turned so that the middle of the picture is right.
    let turn = DMat3::from_rotation_y((off.x / exact.fx).atan()) * DMat3::from_rotation_x(-(off.y / exact.fy).atan());
    let mut model = model();
    for (i, frame) in &mut model.frames {
        for p in &mut frame.points {
            let point = model.points[&p.point3d.unwrap()].position;
            p.position_px = exact.project(truth(*i).transform_point(point)).to_array();
        }
        frame.camera_from_world = Isometry::new(turn, DVec3::ZERO).compose(&frame.camera_from_world);
    }
    let sharpened = sharpen(&mut model, &pictures).unwrap();
    let found = model.lenses[&1];
    let missed = DVec2::new(found.cx - exact.cx, found.cy - exact.cy);
    assert!(sharpened.freed.centre && missed.length() < 1.5, "{found:?} {sharpened:?}");
    assert!(turn_error(&model.poses()) < 0.03);
}
