//! Videos that no cameras can be found from, with real COLMAP: each ends with an error that says what to do, and leaves
//! nothing half-written.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]
#![allow(clippy::print_stderr, reason = "a skipped test says so")]

use std::path::{Path, PathBuf};

use glam::{DMat3, DQuat, DVec2, DVec3};
use image::{Rgb, RgbImage};
use risorius_formats::report::Collected;
use risorius_formats::take::SourceKind;
use risorius_formats::{Hint, Isometry, Take, Track, TrackRow, colmap, openface};
use risorius_tracker::TrackerError;
use risorius_tracker::poses::colmap::ColmapOptions;
use risorius_tracker::poses::{self, PosesOptions, Source, interpolate::MAX_GAP_SECS};

#[path = "../src/testing.rs"]
mod testing;

const SIDE: [u32; 2] = [320, 240];
const FRAMES: u32 = 24;

fn colmap_is_here() -> bool {
    let here = std::process::Command::new("colmap").arg("help").output().is_ok();
    if !here {
        eprintln!("SKIPPED: there is no `colmap` here");
    }
    here
}

/// Blobs of random place, size and grey: what a feature detector likes.
fn wall(width: u32, height: u32) -> RgbImage {
    wall_of(width, height, 7)
}

fn wall_of(width: u32, height: u32, seed: u64) -> RgbImage {
    let mut state = seed;
    let mut next = |n: u32| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as u32 % n
    };
    let mut image = RgbImage::from_pixel(width, height, Rgb([120; 3]));
    for _ in 0..width * height / 60 {
        let (x, y, r, grey) = (next(width), next(height), 2 + next(4), 30 + next(200));
        for dy in 0..=2 * r {
            for dx in 0..=2 * r {
                let (px, py) = ((x + dx).saturating_sub(r), (y + dy).saturating_sub(r));
                let inside = dx.abs_diff(r).pow(2) + dy.abs_diff(r).pow(2) <= r * r;
                if inside && px < width && py < height {
                    image.put_pixel(px, py, Rgb([grey as u8; 3]));
                }
            }
        }
    }
    image
}

fn take(dir: &Path, picture: impl Fn(u32) -> RgbImage) -> PathBuf {
    let points = std::array::from_fn(|k| [130.0 + (k % 9) as f32 * 7.0, 90.0 + (k / 9) as f32 * 8.0]);
    take_with(dir, FRAMES, picture, |_| points)
}

fn take_with(
    dir: &Path,
    frames: u32,
    picture: impl Fn(u32) -> RgbImage,
    points: impl Fn(u32) -> [[f32; 2]; 68],
) -> PathBuf {
    let path = testing::take(dir, SIDE[0], SIDE[1], frames);
    let pictures = path.join("pictures");
    std::fs::create_dir(&pictures).unwrap();
    for i in 0..frames {
        picture(i).save(pictures.join(format!("{i:03}.png"))).unwrap();
    }
    let mut manifest = Take::open(&path).unwrap().manifest;
    manifest.source = SourceKind::Images;
    manifest.media = "pictures".into();
    manifest.write(path.join("take.toml")).unwrap();
    let rows: Vec<TrackRow> = (0..frames).map(|i| testing::row(i, &points(i))).collect();
    openface::write(path.join("track/openface.csv"), &Track { rows, ..Track::default() }).unwrap();
    path
}

fn options(colmap: ColmapOptions) -> PosesOptions {
    PosesOptions {
        source: Source::Colmap(colmap),
        min_confidence: 0.8,
        max_gap_secs: MAX_GAP_SECS,
        accept_poor: false,
        eye_distance_mm: None,
        follow: true,
        correct_by_landmarks: true,
    }
}

fn fails(take: &Path) -> TrackerError {
    fails_with(take, ColmapOptions::default())
}

fn fails_with(take: &Path, colmap: ColmapOptions) -> TrackerError {
    let error = poses::find(take, &options(colmap), &Collected::default()).unwrap_err();
    assert!(error.hint().is_some(), "{error}");
    assert!(!take.join("poses/sparse").exists() && !take.join("poses/report.json").exists());
    let names: Vec<String> =
        std::fs::read_dir(take).unwrap().map(|e| e.unwrap().file_name().to_string_lossy().into_owned()).collect();
    assert!(!names.iter().any(|n| n.contains(".part")), "{names:?}");
    error
}

/// Errors that say that the video is at fault.
fn blames_the_video(error: &TrackerError) -> bool {
    matches!(
        error,
        TrackerError::ColmapNoModel { .. }
            | TrackerError::FewRegistered { .. }
            | TrackerError::PoorPoses { .. }
            | TrackerError::TooLittleParallax { .. }
    )
}

#[test]
fn a_textureless_background_is_told() {
    if !colmap_is_here() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let take = take(dir.path(), |i| RgbImage::from_pixel(SIDE[0], SIDE[1], Rgb([140 + (i % 3) as u8; 3])));
    let error = fails(&take);
    assert!(matches!(error, TrackerError::ColmapNoModel { .. }), "{error}");
    assert!(error.hint().unwrap().contains("texture"));
}

#[test]
fn a_camera_that_only_turns_is_told() {
    if !colmap_is_here() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let wall = wall(700, 300);
    // A flat wall that slides by, as a far wall does when the camera turns.
    let take = take(dir.path(), |i| image::imageops::crop_imm(&wall, 12 * i, i, SIDE[0], SIDE[1]).to_image());
    let error = fails(&take);
    assert!(blames_the_video(&error), "{error}");
    assert!(error.hint().unwrap().contains("mov"), "{:?}", error.hint());
}

#[test]
fn a_blurred_video_is_told() {
    if !colmap_is_here() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let wall = image::imageops::blur(&wall(700, 300), 14.0);
    let take = take(dir.path(), |i| image::imageops::crop_imm(&wall, 12 * i, i, SIDE[0], SIDE[1]).to_image());
    let error = fails(&take);
    assert!(blames_the_video(&error), "{error}");
}

/// A room: a far wall with strips that stand before it, and a head in the middle, seen by a camera on an arc around it.
struct Room {
    walls: [RgbImage; 2],
}

/// Focal length, pixels.
const FOCAL: f64 = 300.0;
/// Where the head is.
const HEAD: DVec3 = DVec3::new(0.0, 0.0, 2.2);

impl Room {
    fn new(seed: u64) -> Self {
        Self { walls: [wall_of(900, 500, seed), wall_of(900, 500, seed + 1)] }
    }

    /// The camera at `turn` radians of its arc, looking at the head.
    fn camera(turn: f64) -> Isometry {
        let center = HEAD + DVec3::new(turn.sin(), 0.15 * turn, -turn.cos()) * 2.2;
        let z = (HEAD - center).normalize();
        let x = DVec3::Y.cross(z).normalize();
        let rotation = DMat3::from_cols(x, z.cross(x), z).transpose();
        Isometry::new(rotation, -(rotation * center))
    }

    fn picture(&self, turn: f64) -> RgbImage {
        let camera = Self::camera(turn);
        let (world_from_camera, center) = (camera.rotation.transpose(), camera.inverse().translation);
        RgbImage::from_fn(SIDE[0], SIDE[1], |x, y| {
            let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5) - DVec2::new(160.0, 120.0);
            let ray = world_from_camera * (pixel / FOCAL).extend(1.0);
            let at = |z: f64| center + ray * ((z - center.z) / ray.z);
            let near = at(3.0);
            let (place, wall) = if (near.x * 2.0).rem_euclid(2.4) < 1.0 { (near, 0) } else { (at(4.5), 1) };
            let wall = &self.walls[wall];
            let (u, v) = ((place.x * 90.0 + 450.0).clamp(0.0, 898.0), (place.y * 90.0 + 250.0).clamp(0.0, 498.0));
            // Bilinear: patches are compared to a fraction of a pixel.
            let (i, j) = (u as u32, v as u32);
            let (a, b) = (u.fract(), v.fract());
            let grey = |i: u32, j: u32| f64::from(wall.get_pixel(i, j)[0]);
            let row = |j: u32| grey(i, j) * (1.0 - a) + grey(i + 1, j) * a;
            Rgb([(row(j) * (1.0 - b) + row(j + 1) * b).round() as u8; 3])
        })
    }

    /// Where 68 points of the head are in the picture.
    fn points(turn: f64) -> [[f32; 2]; 68] {
        let camera = Self::camera(turn);
        std::array::from_fn(|k| {
            let (x, y) = ((k % 9) as f64 * 0.03 - 0.12, (k / 9) as f64 * 0.035 - 0.12);
            let point = camera.transform_point(HEAD + DVec3::new(x, y, 4.0 * (x * x + y * y)));
            let pixel = point.truncate() / point.z * FOCAL + DVec2::new(160.0, 120.0);
            pixel.to_array().map(|v| v as f32)
        })
    }
}

/// The arc of 60 frames, with a cut in the middle where there is a `gap`.
fn turn_of(frame: u32, gap: f64) -> f64 {
    let half = if frame < 30 { -gap / 2.0 } else { gap / 2.0 };
    (f64::from(frame) - 29.5) * 0.012 + half
}

/// All 60 cameras have turned against the first one as they did in truth.
fn check_turns(take: &Path, turn: impl Fn(u32) -> f64) {
    let model = colmap::read_model(take.join("poses/sparse")).unwrap();
    assert_eq!(model.images.len(), 60);
    // Turns against the first frame do not depend on where the model's world lies.
    let mut found: Vec<(u32, DMat3)> = model
        .images
        .values()
        .map(|image| (image.name[..6].parse().unwrap(), image.camera_from_world.rotation))
        .collect();
    found.sort_by_key(|(frame, _)| *frame);
    let truth = |i: u32| Room::camera(turn(i)).rotation;
    for (frame, rotation) in &found {
        let apart = (*rotation * found[0].1.transpose()) * (truth(*frame) * truth(0).transpose()).transpose();
        let degrees = DQuat::from_mat3(&apart).to_axis_angle().1.to_degrees();
        assert!(degrees.min(360.0 - degrees) < 0.5, "frame {frame}: {degrees}°");
    }
}

#[test]
fn both_sides_of_a_cut_are_placed_where_they_see_the_same_place() {
    if !colmap_is_here() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let room = Room::new(7);
    let turn = |i: u32| turn_of(i, 0.2);
    let take = take_with(dir.path(), 60, |i| room.picture(turn(i)), |i| Room::points(turn(i)));
    let heard = Collected::default();
    let colmap = ColmapOptions { keyframes: Some(20), ..ColmapOptions::default() };
    let report = poses::find(&take, &options(colmap), &heard).unwrap();
    assert!(report.notes.iter().any(|n| n.contains("jump") && n.contains("before frame 30")), "{:?}", report.notes);
    check_turns(&take, turn);
}

#[test]
fn a_cut_to_another_place_is_told() {
    if !colmap_is_here() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let rooms = [Room::new(7), Room::new(99)];
    let turn = |i: u32| turn_of(i, 0.0);
    let picture = |i: u32| rooms[usize::from(i >= 30)].picture(turn(i));
    let take = take_with(dir.path(), 60, picture, |i| Room::points(turn(i)));
    let error = fails_with(&take, ColmapOptions { keyframes: Some(20), ..ColmapOptions::default() });
    assert!(blames_the_video(&error), "{error}");
}

/// `RISORIUS_COLMAP_OTHERS=path:path`: COLMAP programs, or Pythons with `pycolmap`, besides the installed one.
#[test]
fn other_versions_of_colmap_place_the_same_arc() {
    let named = std::env::var_os("RISORIUS_COLMAP_OTHERS").unwrap_or_default();
    let programs: Vec<PathBuf> = std::env::split_paths(&named).filter(|p| !p.as_os_str().is_empty()).collect();
    if programs.is_empty() {
        eprintln!("SKIPPED: RISORIUS_COLMAP_OTHERS names no other COLMAP");
    }
    let room = Room::new(7);
    let turn = |i: u32| turn_of(i, 0.0);
    for program in programs {
        let dir = tempfile::tempdir().unwrap();
        let take = take_with(dir.path(), 60, |i| room.picture(turn(i)), |i| Room::points(turn(i)));
        let colmap = ColmapOptions { keyframes: Some(20), program: program.clone(), ..ColmapOptions::default() };
        let heard = Collected::default();
        let report =
            poses::find(&take, &options(colmap), &heard).unwrap_or_else(|e| panic!("{}: {e}", program.display()));
        eprintln!("{}: {}", program.display(), report.notes[0]);
        check_turns(&take, turn);
    }
}
