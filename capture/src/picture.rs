//! A native frame as a picture to look at: for the meter and the preview, never for the recording.

use image::codecs::jpeg::JpegEncoder;
use image::{ImageFormat, RgbImage, imageops};
use risorius_video::RawLayout;

use crate::source::{PixelFormat, Started};

/// Longer side of a preview's picture, pixels.
const PREVIEW_SIDE: u32 = 640;

/// The picture of a frame; `None` for H.264, which needs the frames before, and for broken ones.
pub(crate) fn rgb(started: &Started, data: &[u8]) -> Option<RgbImage> {
    match started.format {
        PixelFormat::Mjpeg => Some(image::load_from_memory_with_format(data, ImageFormat::Jpeg).ok()?.into_rgb8()),
        PixelFormat::H264 => None,
        format => rgb_from_raw(format.raw()?, started.width, started.height, started.stride, data),
    }
}

/// BT.601, limited range, as the decoders of these formats assume.
fn rgb_from_yuv(y: u8, u: u8, v: u8) -> [u8; 3] {
    let (y, u, v) = (1.164 * (f32::from(y) - 16.0), f32::from(u) - 128.0, f32::from(v) - 128.0);
    [y + 1.596 * v, y - 0.392 * u - 0.813 * v, y + 2.017 * u].map(|c| c.clamp(0.0, 255.0) as u8)
}

fn rgb_from_raw(raw: RawLayout, width: u32, height: u32, stride: usize, data: &[u8]) -> Option<RgbImage> {
    let (w, h) = (width as usize, height as usize);
    let stride = stride.max(raw.row_bytes(width));
    let planar = matches!(raw, RawLayout::Nv12 | RawLayout::I420);
    let needed = if planar { stride * h + 2 * (stride / 2) * (h / 2) } else { stride * (h - 1) + raw.row_bytes(width) };
    if data.len() < needed {
        return None;
    }
    let chroma_at = stride * h;
    let pixel = |x: usize, y: usize| -> [u8; 3] {
        let row = y * stride;
        match raw {
            RawLayout::Yuyv => {
                let pair = row + 4 * (x / 2);
                rgb_from_yuv(data[row + 2 * x], data[pair + 1], data[pair + 3])
            }
            RawLayout::Uyvy => {
                let pair = row + 4 * (x / 2);
                rgb_from_yuv(data[row + 2 * x + 1], data[pair], data[pair + 2])
            }
            RawLayout::Nv12 => {
                let pair = chroma_at + y / 2 * stride + 2 * (x / 2);
                rgb_from_yuv(data[row + x], data[pair], data[pair + 1])
            }
            RawLayout::I420 => {
                let at = chroma_at + y / 2 * (stride / 2) + x / 2;
                rgb_from_yuv(data[row + x], data[at], data[at + stride / 2 * (h / 2)])
            }
            RawLayout::Grey => [data[row + x]; 3],
            RawLayout::Rgb24 => [data[row + 3 * x], data[row + 3 * x + 1], data[row + 3 * x + 2]],
            RawLayout::Bgr24 => [data[row + 3 * x + 2], data[row + 3 * x + 1], data[row + 3 * x]],
        }
    };
    let bytes: Vec<u8> = (0..h).flat_map(|y| (0..w).flat_map(move |x| pixel(x, y))).collect();
    RgbImage::from_raw(width, height, bytes)
}

/// A small JPEG for the preview's page.
pub(crate) fn small_jpeg(image: &RgbImage) -> Option<Vec<u8>> {
    let scale = (f64::from(PREVIEW_SIDE) / f64::from(image.width().max(image.height()))).min(1.0);
    let side = |n: u32| ((f64::from(n) * scale) as u32).max(1);
    let small = imageops::thumbnail(image, side(image.width()), side(image.height()));
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, 75).encode_image(&small).ok()?;
    Some(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn padded_rows_and_every_layout_give_the_same_colour() {
        // Orange: Y 150, U 60, V 190.
        let expected = rgb_from_yuv(150, 60, 190);
        let (w, h) = (4u32, 2u32);
        let pad = |row: &[u8]| [row, &[9, 9]].concat();
        let layouts: [(RawLayout, usize, Vec<u8>); 4] = [
            (
                RawLayout::Yuyv,
                10,
                [pad(&[150, 60, 150, 190, 150, 60, 150, 190]), pad(&[150, 60, 150, 190, 150, 60, 150, 190])].concat(),
            ),
            (
                RawLayout::Uyvy,
                10,
                [pad(&[60, 150, 190, 150, 60, 150, 190, 150]), pad(&[60, 150, 190, 150, 60, 150, 190, 150])].concat(),
            ),
            (RawLayout::Nv12, 6, [pad(&[150; 4]), pad(&[150; 4]), pad(&[60, 190, 60, 190])].concat()),
            (RawLayout::I420, 4, [vec![150; 8], vec![60; 2], vec![190; 2]].concat()),
        ];
        for (raw, stride, data) in layouts {
            let image = rgb_from_raw(raw, w, h, stride, &data).unwrap();
            assert!(image.pixels().all(|p| p.0 == expected), "{raw:?} {image:?}");
            assert!(rgb_from_raw(raw, w, h, stride, &data[..data.len() - 4]).is_none());
        }
    }
}
