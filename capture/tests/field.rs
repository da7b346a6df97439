//! Inputs that went wrong for users, each with its right value: what a stream says of its pictures and its times.
//! The files lie in the development data (`data/field`); a file that is not there is skipped, and said.
#![expect(clippy::unwrap_used, reason = "helpers of tests")]

mod common;

use std::path::{Path, PathBuf};

use common::{capture, ffmpeg, has_ffmpeg, stderr};
use risorius_capture::CaptureError;
use risorius_capture::record::{RecordOptions, record};
use risorius_formats::report::Collected;
use risorius_formats::{Hint, Take};
use risorius_tests::shared;
use risorius_video::Reader;

/// Makes a take; gives it with the codes of the warnings.
fn made(input: &Path, out: &Path) -> Result<(Take, Vec<String>), Box<CaptureError>> {
    let options = RecordOptions { input: input.into(), out: out.into(), ..RecordOptions::default() };
    let said = Collected::default();
    record(&options, &said)?;
    let warnings = said.warnings().iter().map(|w| format!("{}: {}", w.kind, w.message)).collect();
    Ok((Take::open(out).unwrap(), warnings))
}

fn last_secs(take: &Take) -> f64 {
    take.frames.last().unwrap().timestamp_nanos as f64 * 1e-9
}

#[test]
fn every_coding_shows_the_same_colour() {
    let Some(folder) = shared("data/field/colour") else { return };
    let dir = tempfile::tempdir().unwrap();
    for name in ["png", "bt601.mp4", "bt709.mp4", "h264_full.mp4", "hlg.mov"] {
        let (take, warnings) = made(&folder.join(name), &dir.path().join(name)).unwrap();
        let luma = take.frames[3].luma_mean.unwrap();
        assert!((luma - 100.0).abs() <= 1.5, "{name}: luma {luma}");
        assert!(warnings.is_empty(), "{name}: {warnings:?}");
        let pixel = Reader::open_take(&take).unwrap().next_frame().unwrap().unwrap().image.get_pixel(60, 40).0;
        assert!(pixel.iter().zip([200u8, 60, 40]).all(|(a, b)| a.abs_diff(b) <= 1), "{name}: {pixel:?}");
    }
}

#[test]
fn a_cover_is_no_video_and_neither_is_sound() {
    let Some(folder) = shared("data/field") else { return };
    let dir = tempfile::tempdir().unwrap();
    let (take, warnings) = made(&folder.join("cover-first/cover_first.mp4"), &dir.path().join("cover")).unwrap();
    assert_eq!((take.frames.len(), take.manifest.width, take.manifest.height), (60, 160, 120));
    assert!(warnings.is_empty(), "{warnings:?}");
    for name in ["audio.m4a", "audio.mp4"] {
        let error = made(&folder.join("audio-only").join(name), &dir.path().join(name)).unwrap_err();
        assert!(error.to_string().ends_with("has no video track (sound only)"), "{error}");
        assert!(error.hint().is_some());
    }
}

#[test]
fn a_size_that_changes_is_named_with_its_frame() {
    let Some(folder) = shared("data/field/size-change") else { return };
    let dir = tempfile::tempdir().unwrap();
    for (name, words) in [
        ("sizes.mp4", "frame 30 is 320×240 pixels, but the frames before have 160×120"),
        ("face_270_to_540.mp4", "frame 30 is 540×960 pixels, but the frames before have 270×480"),
        ("face_540_to_270.mp4", "frame 30 is 270×480 pixels, but the frames before have 540×960"),
    ] {
        let out = dir.path().join("take");
        let error = made(&folder.join(name), &out).unwrap_err().to_string();
        assert!(error.contains(name) && error.ends_with(words), "{error}");
        assert!(!out.exists(), "{name}: a take was left");
    }
}

#[test]
fn times_count_from_the_first_sample() {
    let Some(folder) = shared("data/field/late-keyframe") else { return };
    let dir = tempfile::tempdir().unwrap();
    let (take, warnings) = made(&folder.join("kcut.mp4"), &dir.path().join("take")).unwrap();
    assert_eq!(take.frames.len(), 68);
    assert!((last_secs(&take) - 2.8).abs() < 1e-3, "{}", last_secs(&take));
    assert!(warnings.len() == 1 && warnings[0].contains("the first 19 of 87 frames cannot be decoded"), "{warnings:?}");
}

#[test]
fn dim_light_is_no_slow_motion() {
    let Some(folder) = shared("data/field/dim-light") else { return };
    let dir = tempfile::tempdir().unwrap();
    for (name, secs) in [("dim_tagged.mp4", 5.95), ("dim24_tagged.mp4", 3.958)] {
        let (take, warnings) = made(&folder.join(name), &dir.path().join(name)).unwrap();
        assert!((last_secs(&take) - secs).abs() < 1e-3 && warnings.is_empty(), "{name}: {warnings:?}");
    }
}

/// A clip of `fps` frames/s whose metadata say that it was filmed at `filmed`.
fn tagged(dir: &Path, fps: u32, filmed: u32) -> PathBuf {
    let path = dir.join(format!("{filmed}at{fps}.mp4"));
    ffmpeg(
        &format!(
            "-f lavfi -i testsrc2=size=160x120:rate={fps} -frames:v {fps} -c:v libx264 -movflags use_metadata_tags \
             -metadata com.android.capture.fps={filmed}"
        ),
        &path,
    );
    path
}

#[test]
fn half_speed_is_a_warning_and_an_eighth_a_note() {
    if !has_ffmpeg() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let (take, warnings) = made(&tagged(dir.path(), 30, 60), &dir.path().join("two")).unwrap();
    assert!((last_secs(&take) - 29.0 / 60.0).abs() < 1e-3);
    assert!(warnings.len() == 1 && warnings[0].contains("--true-fps 30"), "{warnings:?}");
    let (take, warnings) = made(&tagged(dir.path(), 30, 240), &dir.path().join("eight")).unwrap();
    assert!((last_secs(&take) - 29.0 / 240.0).abs() < 1e-3 && warnings.is_empty(), "{warnings:?}");
    let (take, warnings) = made(&tagged(dir.path(), 30, 50), &dir.path().join("none")).unwrap();
    assert!((last_secs(&take) - 29.0 / 30.0).abs() < 1e-3 && warnings.is_empty(), "{warnings:?}");
}

#[test]
fn pixels_that_are_not_square_are_resampled() {
    let Some(ada) = shared("data/captures/ada/video.mp4") else { return };
    if !has_ffmpeg() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let clip = dir.path().join("sar.mp4");
    let filter = "select=not(mod(n\\,40)),setpts=N/30/TB,scale=404:960,setsar=540/404";
    ffmpeg(&format!("-t 2 -i {} -vf {filter} -r 30 -c:v libx264 -crf 8", ada.display()), &clip);
    let (take, _) = made(&clip, &dir.path().join("take")).unwrap();
    assert_eq!((take.manifest.width, take.manifest.height), (540, 960));
    let picture = |path: &Path| Reader::open(path).unwrap().next_frame().unwrap().unwrap().image;
    let (shown, original) = (picture(&clip), picture(&ada));
    let differences = shown.as_raw().iter().zip(original.as_raw()).map(|(a, b)| f64::from(a.abs_diff(*b)));
    let mean = differences.sum::<f64>() / original.as_raw().len() as f64;
    assert!(mean < 2.0, "differs from the square original by {mean} levels");
}

#[test]
fn a_clip_on_its_side_is_turned_for_all_who_read_the_take() {
    let dir = tempfile::tempdir().unwrap();
    let video = dir.path().join("v.mp4");
    common::write_video(&video, 6, 30.0);
    let path = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    let args = ["record", "--input", &path("v.mp4"), "--rotate", "90", "--out", &path("take")];
    let output = capture(dir.path(), &args);
    assert!(output.status.success(), "{}", stderr(&output));
    let take = Take::open(dir.path().join("take")).unwrap();
    let m = &take.manifest;
    assert_eq!((m.width, m.height, m.rotation_degrees), (64, 96, 90));
    let stored = Reader::open(&video).unwrap().next_frame().unwrap().unwrap().image;
    let mut turned = Vec::new();
    risorius_video::read_take_frames(&take, &[0, 3], |_, image| {
        turned.push(image);
        Ok::<(), risorius_video::VideoError>(())
    })
    .unwrap();
    assert!(turned[0] == image::imageops::rotate90(&stored) && turned.len() == 2);
    let refused = capture(dir.path(), &["record", "--input", "v.mp4", "--rotate", "45", "--out", "t"]);
    assert!(refused.status.code() == Some(2) && stderr(&refused).contains("expected 90, 180 or 270"));
}

#[test]
fn interlaced_and_transparent_clips_are_named() {
    if !has_ffmpeg() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    for (name, options, code) in [
        ("fields.mp4", "-vf interlace -c:v libx264 -flags +ilme+ildct", "interlaced-video"),
        ("alpha.mov", "-vf format=yuva444p10le -c:v prores_ks -profile:v 4444", "alpha-video"),
        ("square.mp4", "-c:v libx264", ""),
    ] {
        let clip = dir.path().join(name);
        ffmpeg(&format!("-f lavfi -i testsrc2=size=160x120:rate=50 -frames:v 10 {options}"), &clip);
        let (_, warnings) = made(&clip, &dir.path().join(format!("{name}.take"))).unwrap();
        assert!(warnings.first().map_or("", String::as_str).starts_with(code), "{name}: {warnings:?}");
        assert_eq!(warnings.is_empty(), code.is_empty(), "{name}: {warnings:?}");
    }
}

#[test]
fn streams_without_times_have_a_rate_or_are_refused() {
    if !has_ffmpeg() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let raw = dir.path().join("raw.h264");
    ffmpeg("-f lavfi -i testsrc2=size=160x120:rate=60 -frames:v 30 -c:v libx264 -bf 2", &raw);
    let (take, warnings) = made(&raw, &dir.path().join("stated")).unwrap();
    assert!((take.manifest.fps_measured - 60.0).abs() < 0.1, "{}", take.manifest.fps_measured);
    assert!(warnings.len() == 1 && warnings[0].starts_with("no-times"), "{warnings:?}");
    // A raw MJPEG stream says nothing of its rate.
    let raw = dir.path().join("raw.mjpeg");
    ffmpeg("-f lavfi -i testsrc2=size=160x120:rate=60 -frames:v 30 -c:v mjpeg -pix_fmt yuvj420p", &raw);
    let error = made(&raw, &dir.path().join("refused")).unwrap_err();
    assert!(error.to_string().contains("has no times") && error.hint().unwrap().contains("--fps"), "{error}");
    let options =
        RecordOptions { input: raw, out: dir.path().join("asked"), image_fps: Some(60.0), ..RecordOptions::default() };
    let summary = record(&options, &Collected::default()).unwrap();
    assert!((summary.manifest.fps_measured - 60.0).abs() < 0.1);
    let asf = dir.path().join("clip.wmv");
    ffmpeg("-f lavfi -i testsrc2=size=160x120:rate=30 -frames:v 30 -c:v wmv2", &asf);
    let (take, _) = made(&asf, &dir.path().join("asf")).unwrap();
    assert!((take.manifest.fps_measured - 30.0).abs() < 0.5 && take.manifest.fps_asked.unwrap() < 31.0);
}
