//! Videos that no cameras can be found from, with real COLMAP: each ends with an error that says what to do, and leaves
//! nothing half-written.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]
#![allow(clippy::print_stderr, reason = "a skipped test says so")]

use std::path::{Path, PathBuf};

use image::{Rgb, RgbImage};
use risorius_formats::report::Collected;
use risorius_formats::take::SourceKind;
use risorius_formats::{Hint, Take, Track, TrackRow, openface};
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
    let mut state = 7u64;
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
    let path = testing::take(dir, SIDE[0], SIDE[1], FRAMES);
    let pictures = path.join("pictures");
    std::fs::create_dir(&pictures).unwrap();
    for i in 0..FRAMES {
        picture(i).save(pictures.join(format!("{i:03}.png"))).unwrap();
    }
    let mut manifest = Take::open(&path).unwrap().manifest;
    manifest.source = SourceKind::Images;
    manifest.media = "pictures".into();
    manifest.write(path.join("take.toml")).unwrap();
    let points = std::array::from_fn(|k| [130.0 + (k % 9) as f32 * 7.0, 90.0 + (k / 9) as f32 * 8.0]);
    let rows: Vec<TrackRow> = (0..FRAMES).map(|i| testing::row(i, &points)).collect();
    openface::write(path.join("track/openface.csv"), &Track { rows, ..Track::default() }).unwrap();
    path
}

fn fails(take: &Path) -> TrackerError {
    let options = PosesOptions {
        source: Source::Colmap(ColmapOptions::default()),
        min_confidence: 0.8,
        max_gap_secs: MAX_GAP_SECS,
        accept_poor: false,
        eye_distance_mm: None,
        follow: true,
        correct_by_landmarks: true,
    };
    let error = poses::find(take, &options, &Collected::default()).unwrap_err();
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
