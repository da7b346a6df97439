//! Fragmented files written here are decoded by FFmpeg, whole or cut.
#![expect(clippy::unwrap_used, reason = "helpers of tests")]

use std::fs::{self, File};
use std::path::Path;

use image::{Rgb, RgbImage};
use risorius_video::fragmented::{Codec, FragmentWriter, timeline, whole_fragments};
use risorius_video::{RawLayout, Reader, UtEncoder};

fn picture(i: u32) -> RgbImage {
    RgbImage::from_fn(64, 48, |x, y| Rgb([(20 + 5 * i) as u8, (x * 3) as u8, (y * 4 + x % 3) as u8]))
}

fn jpeg(i: u32) -> Vec<u8> {
    let mut bytes = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 95).encode_image(&picture(i)).unwrap();
    bytes
}

/// A frame every 8333 or 8334 µs, but 25 ms before frame 20.
fn micros(i: u64) -> u64 {
    i * 25_000 / 3 + if i >= 20 { 16_667 } else { 0 }
}

fn write(path: &Path, codec: &Codec, count: u32, sample: impl Fn(u32) -> Vec<u8>) {
    let mut writer = FragmentWriter::new(File::create(path).unwrap(), codec, 64, 48, 8333).unwrap();
    let sent: usize = (0..count).map(|i| writer.push(micros(i.into()), true, &sample(i)).unwrap()).sum::<usize>()
        + writer.finish().unwrap();
    assert_eq!((sent, writer.whole_bytes()), (count as usize, fs::metadata(path).unwrap().len()));
}

fn read(path: &Path) -> Vec<(i64, RgbImage)> {
    let mut reader = Reader::open(path).unwrap();
    std::iter::from_fn(|| reader.next_frame().unwrap()).map(|f| (f.timestamp_nanos, f.image)).collect()
}

#[test]
fn jpeg_frames_come_back_with_uneven_times() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("v.mp4");
    write(&path, &Codec::Mjpeg, 150, |i| jpeg(i % 40));
    let frames = read(&path);
    assert_eq!(frames.len(), 150);
    for (i, (nanos, image)) in frames.iter().enumerate() {
        assert_eq!(*nanos, micros(i as u64) as i64 * 1000);
        let found = i32::from(image.get_pixel(30, 20)[0]);
        assert!((found - (20 + 5 * (i as i32 % 40))).abs() < 8, "frame {i}: {found}");
    }
}

#[test]
fn a_cut_file_plays_up_to_its_last_whole_fragment() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("v.mp4");
    write(&path, &Codec::Mjpeg, 200, |i| jpeg(i % 40));
    let bytes = fs::read(&path).unwrap();
    let whole = whole_fragments(&path).unwrap();
    assert_eq!((whole.whole_bytes, whole.file_bytes), (bytes.len() as u64, bytes.len() as u64));
    for share in [35, 60, 99] {
        let cut = dir.path().join("cut.mp4");
        fs::write(&cut, &bytes[..bytes.len() * share / 100]).unwrap();
        let end = whole_fragments(&cut).unwrap();
        assert!(end.whole_bytes < end.file_bytes);
        File::options().write(true).open(&cut).unwrap().set_len(end.whole_bytes).unwrap();
        let times = timeline(&cut).unwrap();
        // All of it but half a second.
        let lost = 2 * share - times.nanos().len();
        assert!(lost <= 61, "{lost} lost of {}", 2 * share);
        assert_eq!(read(&cut).len(), times.nanos().len());
    }
}

#[test]
fn raw_pictures_are_stored_without_loss() {
    let dir = tempfile::tempdir().unwrap();
    for (name, layout) in [("rgb", RawLayout::Rgb24), ("bgr", RawLayout::Bgr24), ("grey", RawLayout::Grey)] {
        let path = dir.path().join(format!("{name}.mp4"));
        let mut encoder = UtEncoder::new(layout, 64, 48).unwrap();
        let encoder = std::cell::RefCell::new(&mut encoder);
        write(&path, &Codec::UtVideo(layout.stored_as()), 6, |i| {
            let raw: Vec<u8> = picture(i)
                .pixels()
                .flat_map(|p| match layout {
                    RawLayout::Rgb24 => p.0.to_vec(),
                    RawLayout::Bgr24 => vec![p[2], p[1], p[0]],
                    _ => vec![p[2]],
                })
                .collect();
            let mut out = Vec::new();
            assert!(encoder.borrow_mut().encode(&raw, &mut out));
            out
        });
        for (i, (_, image)) in read(&path).iter().enumerate() {
            let mut expected = picture(i as u32);
            if layout == RawLayout::Grey {
                expected.pixels_mut().for_each(|p| p.0 = [p[2]; 3]);
            }
            assert_eq!(*image, expected, "{name} {i}");
        }
    }
}

#[test]
fn subsampled_pictures_are_decoded_in_their_colours() {
    let dir = tempfile::tempdir().unwrap();
    for layout in [RawLayout::Yuyv, RawLayout::Uyvy, RawLayout::Nv12, RawLayout::I420] {
        let path = dir.path().join("v.mp4");
        // BT.601: a flat orange, Y 150, U 60, V 190.
        let (y, u, v) = (150u8, 60u8, 190u8);
        let n = 64 * 48;
        let raw: Vec<u8> = match layout {
            RawLayout::Yuyv => [y, u, y, v].repeat(n / 2),
            RawLayout::Uyvy => [u, y, v, y].repeat(n / 2),
            RawLayout::Nv12 => [vec![y; n], [u, v].repeat(n / 4)].concat(),
            _ => [vec![y; n], vec![u; n / 4], vec![v; n / 4]].concat(),
        };
        write(&path, &Codec::UtVideo(layout.stored_as()), 2, |_| {
            let mut out = Vec::new();
            assert!(UtEncoder::new(layout, 64, 48).unwrap().encode(&raw, &mut out));
            out
        });
        let pixel = read(&path)[1].1.get_pixel(31, 17).0.map(i32::from);
        let expected =
            [1.164 * 134.0 + 1.596 * 62.0, 1.164 * 134.0 - 0.392 * -68.0 - 0.813 * 62.0, 1.164 * 134.0 + 2.017 * -68.0];
        for (found, wanted) in pixel.iter().zip(expected) {
            assert!((f64::from(*found) - wanted).abs() < 3.0, "{layout:?}: {pixel:?}, not {expected:?}");
        }
    }
}
