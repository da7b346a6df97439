//! Videos written and read back, and input that is no video.
#![expect(clippy::unwrap_used, reason = "helpers of tests")]

use std::fs;
use std::path::Path;

use image::{Rgb, RgbImage};
use risorius_formats::Hint;
use risorius_video::{Reader, VideoError, Writer, read_frames};

/// A picture whose grey level tells its number, with structure for the encoder.
fn picture(width: u32, height: u32, level: u8) -> RgbImage {
    RgbImage::from_fn(width, height, |x, _| if x < width / 4 { Rgb([200, 40, 30]) } else { Rgb([level; 3]) })
}

fn level(i: u32) -> u8 {
    (20 + 6 * i) as u8
}

fn write(path: &Path, (width, height): (u32, u32), count: u32, fps: f64) {
    let mut writer = Writer::create(path, width, height, fps).unwrap();
    for i in 0..count {
        writer.push(&picture(width, height, level(i))).unwrap();
    }
    writer.finish().unwrap();
}

fn number_of(image: &RgbImage) -> f64 {
    let centre = image.get_pixel(image.width() * 3 / 4, image.height() / 2);
    (f64::from(centre[1]) - 20.0) / 6.0
}

#[test]
fn frames_come_back_in_order_with_their_times_and_colours() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("new/a:b.mp4");
    write(&path, (64, 48), 30, 120.0);
    let mut reader = Reader::open(&path).unwrap();
    let info = reader.info().clone();
    assert_eq!((info.width, info.height, info.rotation_degrees, info.frame_count_estimate), (64, 48, 0, Some(30)));
    assert!((info.fps - 120.0).abs() < 0.01, "{info:?}");
    for i in 0..30 {
        let frame = reader.next_frame().unwrap().unwrap();
        assert_eq!(frame.index, i);
        let expected = f64::from(i) * 1e9 / 120.0;
        assert!((frame.timestamp_nanos as f64 - expected).abs() < 1e5, "frame {i} at {}", frame.timestamp_nanos);
        assert!((number_of(&frame.image) - f64::from(i)).abs() < 0.5, "frame {i} is {}", number_of(&frame.image));
        let red = frame.image.get_pixel(6, 24);
        assert!(red[0] > 170 && red[1] < 80 && red[2] < 80, "channels are in the wrong order: {red:?}");
    }
    assert!(reader.next_frame().unwrap().is_none() && reader.next_frame().unwrap().is_none());
    assert_eq!(reader.truncation(), None);
    assert_eq!(fs::read_dir(path.parent().unwrap()).unwrap().count(), 1, "a temporary file was left");
}

#[test]
fn wanted_frames_are_found_and_missing_ones_named() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("v.mp4");
    write(&path, (64, 48), 20, 30.0);
    let mut seen = Vec::new();
    read_frames(&path, &[7, 0, 19, 7], |index, image| {
        seen.push((index, number_of(&image).round() as u32));
        Ok::<(), VideoError>(())
    })
    .unwrap();
    assert_eq!(seen, [(0, 0), (7, 7), (19, 19)]);
    let error = read_frames(&path, &[3, 20], |_, _| Ok::<(), VideoError>(())).unwrap_err();
    assert!(error.to_string().ends_with("v.mp4: has no frame 20: it ends after 20"), "{error}");
}

#[test]
fn odd_sizes_are_padded_by_repetition() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("odd.mp4");
    write(&path, (63, 47), 4, 30.0);
    let mut reader = Reader::open(&path).unwrap();
    let image = reader.next_frame().unwrap().unwrap().image;
    assert_eq!(image.dimensions(), (64, 48));
    assert!(image.get_pixel(63, 47)[1].abs_diff(level(0)) < 6, "{:?}", image.get_pixel(63, 47));
}

#[test]
fn an_unfinished_or_refused_video_leaves_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("v.mp4");
    let mut writer = Writer::create(&path, 64, 48, 30.0).unwrap();
    writer.push(&picture(64, 48, 9)).unwrap();
    assert!(matches!(writer.push(&picture(32, 48, 9)), Err(VideoError::SizeChanged { .. })));
    drop(writer);
    let empty = Writer::create(&path, 64, 48, 30.0).unwrap();
    assert!(empty.finish().unwrap_err().to_string().contains("no frames"));
    for (name, fps) in [("v.avi", 30.0), ("v.mp4", 0.0), ("v.mp4", f64::NAN)] {
        assert!(matches!(Writer::create(dir.path().join(name), 64, 48, fps), Err(VideoError::Encode { .. })));
    }
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0);
}

#[test]
fn what_is_no_video_is_called_so() {
    let dir = tempfile::tempdir().unwrap();
    let put = |name: &str, bytes: &[u8]| {
        let path = dir.path().join(name);
        fs::write(&path, bytes).unwrap();
        path
    };
    let whole = dir.path().join("whole.mp4");
    write(&whole, (64, 48), 20, 30.0);
    let bytes = fs::read(&whole).unwrap();
    fs::create_dir(dir.path().join("folder")).unwrap();
    put("folder/notes.txt", b"hello");
    let noise: Vec<u8> = (0..9000u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 13) as u8).collect();
    // An index of nothing but 0xff behind a sound header: lengths and counts that cannot be.
    let mut wild = bytes[..32].to_vec();
    wild.extend([0, 0, 8, 0]);
    wild.extend(b"moov");
    wild.extend([0xff; 2040]);
    for (path, words) in [
        (dir.path().join("none.mp4"), "does not exist"),
        (put("empty.mp4", b""), "is empty"),
        (put("text.mp4", b"this is a text file and no video\n"), "is not a video"),
        (put("noise.mp4", &noise), "is not a video"),
        (put("cut.mp4", &bytes[..bytes.len() / 2]), "is truncated: the index"),
        (put("wild.mp4", &wild), "is truncated: the index"),
        (dir.path().join("folder"), "has no PNG or JPEG images"),
    ] {
        let error = Reader::open(&path).unwrap_err();
        let text = error.to_string();
        assert!(text.starts_with(&*path.to_string_lossy()) && text.contains(words), "{text}");
        assert!(!text.contains('\n') && error.hint().is_some(), "{text}");
    }
}

#[test]
fn a_folder_is_read_in_the_order_of_its_numbers() {
    let dir = tempfile::tempdir().unwrap();
    for i in [0u32, 1, 2, 9, 10, 11] {
        picture(40, 30, level(i)).save(dir.path().join(format!("f{i}.png"))).unwrap();
    }
    fs::write(dir.path().join("notes.txt"), "no picture").unwrap();
    fs::write(dir.path().join(".hidden.png"), "no picture").unwrap();
    let mut reader = Reader::open_with_fps(dir.path(), Some(10.0)).unwrap();
    assert_eq!((reader.info().fps, reader.info().frame_count_estimate), (10.0, Some(6)));
    let mut seen = Vec::new();
    while let Some(frame) = reader.next_frame().unwrap() {
        seen.push((number_of(&frame.image) as u32, frame.timestamp_nanos / 1_000_000));
    }
    assert_eq!(seen, [(0, 0), (1, 100), (2, 200), (9, 300), (10, 400), (11, 500)]);
}

#[test]
fn an_odd_or_broken_image_is_named() {
    let dir = tempfile::tempdir().unwrap();
    picture(40, 30, 9).save(dir.path().join("1.png")).unwrap();
    picture(41, 30, 9).save(dir.path().join("2.png")).unwrap();
    fs::write(dir.path().join("3.png"), "no picture").unwrap();
    let mut reader = Reader::open(dir.path()).unwrap();
    assert!(reader.next_frame().unwrap().is_some());
    let odd = reader.next_frame().unwrap_err().to_string();
    assert!(odd.ends_with("2.png: is 41×30 pixels, but the first frame has 40×30"), "{odd}");
    let broken = reader.next_frame().unwrap_err().to_string();
    assert!(broken.contains("3.png: is not a readable image"), "{broken}");
}

#[test]
fn a_written_video_has_the_pictures_that_went_in() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("v.mp4");
    // Smooth, as faces are, with a saturated patch and an edge.
    let picture = |i: u32| {
        RgbImage::from_fn(160, 120, |x, y| {
            let shade = 40.0 * (f64::from(x + 3 * i) / 25.0).sin() + 30.0 * (f64::from(y) / 18.0).cos();
            let base = if x > 90 && y > 60 { [200.0, 70.0, 60.0] } else { [150.0, 120.0, 100.0] };
            Rgb(base.map(|b| (b + shade).clamp(0.0, 255.0) as u8))
        })
    };
    let mut writer = Writer::create(&path, 160, 120, 30.0).unwrap();
    (0..10).for_each(|i| writer.push(&picture(i)).unwrap());
    writer.finish().unwrap();
    let mut reader = Reader::open(&path).unwrap();
    assert_eq!(reader.info().coding, "yuv420p, BT.709, limited range");
    for i in 0..10 {
        let frame = reader.next_frame().unwrap().unwrap().image;
        let sum: f64 = frame.as_raw().iter().zip(picture(i).as_raw()).map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
        let mean = sum / frame.as_raw().len() as f64;
        assert!(mean < 2.0, "frame {i} differs by {mean} levels");
    }
}
