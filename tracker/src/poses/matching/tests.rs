use glam::{DMat3, DVec2, DVec3};
use risorius_formats::{FrameIndex, Intrinsics, Isometry, Landmarks68, TrackRow};

use super::rule::Key;
use super::*;

const FRAMES: u32 = 240;

/// A camera that swings around a head at the world's origin, at a pace of its own.
fn camera(frame: f64) -> Camera {
    let t = frame / 30.0;
    let turn = DMat3::from_rotation_y(0.4 * (1.3 * t).sin()) * DMat3::from_rotation_x(0.15 * (2.1 * t).cos());
    let center = turn.transpose() * DVec3::new(0.0, 0.0, -0.6 - 0.05 * (0.7 * t).sin());
    let camera_from_world = Isometry::new(turn, -(turn * center));
    Camera { intrinsics: Intrinsics::pinhole(640, 480, 700.0), camera_from_world }
}

/// Landmarks with a little noise, as a tracker sees them.
fn track(frames: u32) -> Track {
    let face = |k: usize| {
        let t = k as f64;
        DVec3::new((t * 1.7).sin() * 0.07, (t * 0.9).cos() * 0.08, (t * 2.3).sin() * 0.04)
    };
    let row = |i: u32| {
        let points_px = std::array::from_fn(|k| {
            let noise = DVec2::new((f64::from(i) * 7.1 + k as f64).sin(), (f64::from(i) * 3.3 - k as f64).cos());
            let p = camera(f64::from(i)).project(face(k)) + 0.4 * noise;
            [p.x as f32, p.y as f32]
        });
        TrackRow {
            frame: FrameIndex(i),
            face_id: 0,
            timestamp_secs: None,
            confidence: 1.0,
            success: true,
            intensities: vec![],
            presences: vec![],
            landmarks: Some(Box::new(Landmarks68 { points_px })),
            landmarks_in_camera_mm: None,
            head_pose: None,
        }
    };
    Track { units: vec![], presence_units: vec![], rows: (0..frames).map(row).collect() }
}

/// Decides about images (name, the frame that they really are).
fn decided(images: &[(String, f64)], pictures: Option<&[String]>, numbering: &Numbering) -> Option<Matched> {
    let track = track(FRAMES);
    let names = images.iter().zip(1..).map(|((name, _), id)| (id, name.clone())).collect();
    let cameras = images.iter().zip(1..).map(|((_, frame), id)| (id, camera(*frame))).collect();
    let subject = Subject { frames: FRAMES, fps: 30.0, pictures, track: Some(&track), min_confidence: 0.8 };
    decide(&names, &cameras, &subject, numbering)
}

/// The largest distance between the frame that an image got and the one that it is, and how many got one.
fn worst(images: &[(String, f64)], matched: &Matched) -> (f64, usize) {
    let off = |(frame, id): (&u32, &u32)| (f64::from(*frame) - images[*id as usize - 1].1).abs();
    (matched.frames.iter().map(off).fold(0.0, f64::max), matched.frames.len())
}

fn named(frames: impl Iterator<Item = u32>, name: impl Fn(u32) -> String) -> Vec<(String, f64)> {
    frames.map(|f| (name(f), f64::from(f))).collect()
}

#[test]
fn every_usual_way_of_counting_is_found() {
    let free = Numbering::default();
    let all: [(&str, Vec<(String, f64)>); 11] = [
        ("from 0", named(0..FRAMES, |f| format!("{f:06}.png"))),
        ("from 1", named(0..FRAMES, |f| format!("frame_{:05}.png", f + 1))),
        ("from 1, some not registered", named((9..FRAMES - 20).step_by(3), |f| format!("{:06}.png", f + 1))),
        ("a camera\u{2019}s counter", named(0..FRAMES, |f| format!("DSC_{:04}.JPG", f + 451))),
        ("copies", named(0..FRAMES, |f| format!("IMG_{:04} (1).JPG", f + 1))),
        ("every eighth", named((0..FRAMES).step_by(8), |f| format!("frame_{:05}.png", f / 8 + 1))),
        ("every fifth, later", named((4..FRAMES).step_by(5), |f| format!("{:04}.png", f / 5))),
        ("a part, from 1", named(100..180, |f| format!("{:04}.png", f - 99))),
        (
            "milliseconds",
            named((0..FRAMES).step_by(4), |f| format!("{}.png", 170_000_000_000 + u64::from(f) * 1000 / 30)),
        ),
        ("a date before", named(0..FRAMES, |f| format!("20240131_{:05}.png", f + 1))),
        ("letters", (0..26u8).map(|i| (format!("{}.png", char::from(b'a' + i)), f64::from(i) * 9.0)).collect()),
    ];
    for (what, images) in &all {
        let matched = decided(images, None, &free).unwrap_or_else(|| panic!("{what}"));
        let (off, count) = worst(images, &matched);
        assert!(off < 0.51 && count * 50 >= images.len() * 49, "{what}: {off} {count} {}", matched.rule);
        assert!(matched.error_px.unwrap() < 0.6, "{what}: {matched:?}");
    }
}

#[test]
fn two_captures_in_one_model_are_told_apart() {
    let other = |f: u32| (f64::from(f) * 1.7 + 33.0) % 200.0;
    let mut images: Vec<(String, f64)> = (0..FRAMES).map(|f| (format!("DJI_0238/{f:06}.jpg"), other(f))).collect();
    images.extend(named(0..FRAMES, |f| format!("DJI_0286/{f:06}.jpg")));
    let matched = decided(&images, None, &Numbering::default()).unwrap();
    assert_eq!((worst(&images, &matched), matched.rule.folder.as_deref()), ((0.0, 240), Some("DJI_0286")));
    // The user may say so, and is told that it does not fit.
    let stated = |folder: &str| Numbering { folder: Some(folder.to_owned()), ..Numbering::default() };
    assert_eq!(decided(&images, None, &stated("DJI_0286/")).unwrap().frames, matched.frames);
    assert!(decided(&images, None, &stated("DJI_0238")).unwrap().error_px.unwrap() > 5.0);
    assert!(decided(&images, None, &stated("DJI_0")).is_none());
}

#[test]
fn pictures_are_matched_by_their_file_names() {
    // Six numbers are missing, and the folder counts its pictures without gaps.
    let numbers: Vec<u32> = (0..FRAMES + 6).filter(|n| ![3, 4, 20, 21, 22, 40].contains(n)).collect();
    let pictures: Vec<String> = numbers.iter().map(|n| format!("frame_{n:06}.jpg")).collect();
    let by_name: Vec<(String, f64)> =
        numbers.iter().zip(0u32..).map(|(n, f)| (format!("a/frame_{n:06}.JPG"), f64::from(f))).collect();
    let matched = decided(&by_name, Some(&pictures), &Numbering::default()).unwrap();
    assert_eq!((worst(&by_name, &matched), matched.rule.key), ((0.0, 240), Key::FileName));
    // The same numbers under another name.
    let by_number: Vec<(String, f64)> =
        numbers.iter().zip(0u32..).map(|(n, f)| (format!("half_{n}.png"), f64::from(f))).collect();
    let matched = decided(&by_number, Some(&pictures), &Numbering::default()).unwrap();
    assert_eq!((worst(&by_number, &matched), matched.rule.key), ((0.0, 240), Key::PictureNumber));
}

#[test]
fn what_the_user_states_counts_and_is_doubted_aloud() {
    let images = named((0..FRAMES).step_by(8), |f| format!("frame_{:05}.png", f / 8 + 1));
    let stated = |first, step| Numbering { first: Some(first), step, folder: None };
    let right = decided(&images, None, &stated(1, Some(8.0))).unwrap();
    assert_eq!((worst(&images, &right), right.better.is_none()), ((0.0, 30), true));
    let wrong = decided(&images, None, &stated(1, None)).unwrap();
    assert_eq!((wrong.frames[&0], wrong.frames.len()), (1, 30));
    assert!(wrong.error_px.unwrap() > 5.0 && wrong.better.unwrap().0.to_string().contains("8 frames"));
}

#[test]
fn without_landmarks_the_usual_way_is_taken() {
    let images = named(0..10, |f| format!("{:04}.png", f + 1));
    let names = images.iter().zip(1..).map(|((name, _), id)| (id, name.clone())).collect();
    let cameras = BTreeMap::new();
    let subject = Subject { frames: 10, fps: 30.0, pictures: None, track: None, min_confidence: 0.8 };
    let matched = decide(&names, &cameras, &subject, &Numbering::default()).unwrap();
    assert_eq!((matched.frames[&0], matched.frames.len(), matched.error_px), (1, 10, None));
}
