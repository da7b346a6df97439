//! Times, rotation and damage, compared with what the `ffmpeg` and `ffprobe` programs say. Skipped where they are absent.
#![expect(clippy::unwrap_used, reason = "helpers of tests")]

mod common;

use std::path::{Path, PathBuf};

use common::{ffmpeg, has_ffmpeg, our_times, true_times};
use risorius_video::Reader;

fn compare(path: &Path, tolerance_secs: f64) {
    let (ours, truth) = (our_times(path), true_times(path));
    assert_eq!(ours.len(), truth.len(), "{}", path.display());
    for (i, (a, b)) in ours.iter().zip(&truth).enumerate() {
        assert!((a - b).abs() < tolerance_secs, "{}: frame {i} is at {b} s, not {a} s", path.display());
    }
}

#[test]
fn times_are_those_of_ffprobe() {
    if !has_ffmpeg() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name);
    let source = "-f lavfi -i testsrc2=size=160x120:rate=60:duration=1.5";
    // Frames left out make the rate variable; -bf reorders frames; an edit list cuts the start off.
    let vfr = "-vf select='not(eq(mod(n\\,7)\\,3))*not(between(n\\,40\\,44))' -vsync vfr";
    ffmpeg(&format!("{source} {vfr} -c:v libx264 -bf 3"), &path("vfr.mp4"));
    ffmpeg(
        &format!("{source} {vfr} -c:v libx264 -bf 3 -movflags frag_keyframe+empty_moov -g 20"),
        &path("fragmented.mp4"),
    );
    ffmpeg(&format!("{source} {vfr} -c:v libx264 -bf 3 -use_editlist 0"), &path("no_edit.mp4"));
    ffmpeg(&format!("{source} {vfr} -c:v mpeg4"), &path("part2.mov"));
    ffmpeg(&format!("{source} -c:v libx264 -bf 2 -g 30"), &path("whole.mp4"));
    let whole = path("whole.mp4");
    ffmpeg(&format!("-ss 0.7 -i {} -c copy", whole.display()), &path("trimmed.mp4"));
    ffmpeg(&format!("{source} -c:v libx264 -bf 2 -frames:v 2"), &path("two.mp4"));
    ffmpeg(&format!("{source} -c:v libx264 -bf 2 -frames:v 1"), &path("one.mp4"));
    for name in
        ["vfr.mp4", "fragmented.mp4", "no_edit.mp4", "part2.mov", "whole.mp4", "trimmed.mp4", "two.mp4", "one.mp4"]
    {
        compare(&path(name), 1e-6);
    }
    ffmpeg(&format!("{source} -c:v libx264 -bf 2"), &path("matroska.mkv"));
    compare(&path("matroska.mkv"), 2e-3);
}

#[test]
fn real_files_have_the_times_of_ffprobe() {
    let Some(folder) = risorius_tests::shared("data/video") else { return };
    if !has_ffmpeg() {
        return;
    }
    let mut files: Vec<PathBuf> = std::fs::read_dir(&folder)
        .unwrap()
        .map(|e| e.unwrap().path())
        .filter(|p| p.extension().is_some_and(|e| e == "mp4" || e == "mov"))
        .collect();
    files.sort();
    assert!(!files.is_empty());
    for file in &files {
        compare(file, 1e-6);
    }
}

#[test]
fn turned_and_mirrored_videos_are_shown_as_ffmpeg_does() {
    if !has_ffmpeg() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let stored = dir.path().join("stored.mp4");
    ffmpeg("-f lavfi -i testsrc2=size=160x120:rate=30:duration=0.3 -c:v libx264 -crf 12 -pix_fmt yuv420p", &stored);
    let matrices = [
        ((1, 0, 0, 1), 0),
        ((0, 1, -1, 0), 90),
        ((-1, 0, 0, -1), 180),
        ((0, -1, 1, 0), 270),
        ((-1, 0, 0, 1), 0),
        ((1, 0, 0, -1), 180),
    ];
    for (matrix, rotation) in matrices {
        let turned = dir.path().join("turned.mp4");
        set_matrix(&stored, &turned, matrix);
        ffmpeg(&format!("-i {} -frames:v 2", turned.display()), &dir.path().join("shown%d.png"));
        let shown = |n| image::open(dir.path().join(format!("shown{n}.png"))).unwrap().into_rgb8();
        let mut reader = Reader::open(&turned).unwrap();
        let info = reader.info().clone();
        let first = reader.next_frame().unwrap().unwrap().image;
        assert_eq!(
            (first.dimensions(), (info.width, info.height), info.rotation_degrees),
            (shown(1).dimensions(), shown(1).dimensions(), rotation)
        );
        // The second frame takes another path than the first, which is read at opening.
        let second = reader.next_frame().unwrap().unwrap().image;
        for (name, image, shown) in [("first", &first, shown(1)), ("second", &second, shown(2))] {
            let difference =
                image.as_raw().iter().zip(shown.as_raw()).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>();
            let mean = difference / shown.as_raw().len() as f64;
            assert!(mean < 6.0, "{matrix:?}: the {name} frame differs by {mean} levels");
        }
    }
}

/// Writes the display matrix into a copy of the file, as a phone does.
fn set_matrix(from: &Path, to: &Path, (a, b, c, d): (i32, i32, i32, i32)) {
    let mut bytes = std::fs::read(from).unwrap();
    let tkhd = bytes.windows(4).position(|w| w == b"tkhd").expect("a track header");
    // A version 0 header: name, version and flags, 5 words, 2 reserved, layer to reserved (2), then the 3×3 matrix.
    let matrix = tkhd + 4 + 4 + 20 + 8 + 8;
    for (i, value) in [(0, a), (1, b), (3, c), (4, d)] {
        bytes[matrix + 4 * i..matrix + 4 * i + 4].copy_from_slice(&(value << 16).to_be_bytes());
    }
    std::fs::write(to, bytes).unwrap();
}

#[test]
fn a_cut_video_gives_its_frames_up_to_the_damage() {
    if !has_ffmpeg() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    for (name, options, known) in [("front.mp4", "-movflags +faststart", true), ("cut.mkv", "", false)] {
        let path = dir.path().join(name);
        ffmpeg(&format!("-f lavfi -i testsrc2=size=160x120:rate=30:duration=8 -c:v libx264 -g 30 {options}"), &path);
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() * 6 / 10]).unwrap();
        let mut reader = Reader::open(&path).unwrap();
        let mut count = 0;
        while reader.next_frame().unwrap().is_some() {
            count += 1;
        }
        let cut = reader.truncation().unwrap_or_else(|| panic!("{name}: nothing is missed after {count} frames"));
        assert!((90..200).contains(&count) && cut.read == count, "{name}: {cut:?}");
        assert!(if known { cut.expected == 240 } else { cut.expected.abs_diff(240) < 5 }, "{name}: {cut:?}");
    }
}
