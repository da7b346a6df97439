//! Small pictures of the face, as JPEG inside the page.

use std::collections::BTreeMap;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use image::codecs::jpeg::JpegEncoder;
use image::{RgbImage, imageops};
use risorius_formats::{Landmarks68, Reporter, Take};

use crate::error::{Result, TrackerError};

/// Side of a thumbnail, pixels: drawn at half of it, so that it is sharp on fine screens.
const SIDE: u32 = 192;
/// Side of the crop over the longer side of the box around the 68 points.
const MARGIN: f32 = 1.45;
/// How far the crop's middle lies above that of the points, which end at the brows: shares of the crop's side.
const RAISED: f32 = 0.08;
const QUALITY: u8 = 80;

/// Thumbnails by frame, as `data:` addresses.
pub type Thumbnails = BTreeMap<u32, String>;

/// Decodes the frames of `faces` and crops each to its face.
pub fn draw(take: &Take, faces: &BTreeMap<u32, &Landmarks68>, reporter: &dyn Reporter) -> Result<Thumbnails> {
    reporter.stage("draw", Some(faces.len() as u64));
    let mut thumbnails = Thumbnails::new();
    let frames: Vec<u32> = faces.keys().copied().collect();
    risorius_video::read_take_frames(take, &frames, |frame, picture| {
        if reporter.cancelled() {
            return Err(TrackerError::Cancelled { doing: "drawing".to_owned() });
        }
        if let Some(address) = faces.get(&frame).and_then(|face| thumbnail(&picture, face)) {
            thumbnails.insert(frame, address);
        }
        reporter.advance(1);
        Ok(())
    })?;
    Ok(thumbnails)
}

/// The face as a `data:` address; `None` where the points lie outside of the picture.
fn thumbnail(picture: &RgbImage, face: &Landmarks68) -> Option<String> {
    if !face.is_finite() {
        return None;
    }
    let [left, top, right, bottom] = face.bounds_px();
    let side = MARGIN * (right - left).max(bottom - top);
    let corner = |low: f32, high: f32, raised: f32| 0.5 * (low + high) - (0.5 + raised) * side;
    let (x, y) = (corner(left, right, 0.0).max(0.0) as u32, corner(top, bottom, RAISED).max(0.0) as u32);
    let width = (side as u32).min(picture.width().saturating_sub(x));
    let height = (side as u32).min(picture.height().saturating_sub(y));
    if width < 4 || height < 4 {
        return None;
    }
    let crop = imageops::crop_imm(picture, x, y, width, height).to_image();
    let scale = f64::from(SIDE) / f64::from(width.max(height));
    let size = |side: u32| ((f64::from(side) * scale).round() as u32).max(1);
    let small = imageops::resize(&crop, size(width), size(height), imageops::FilterType::Triangle);
    let mut jpeg = Vec::new();
    JpegEncoder::new_with_quality(&mut jpeg, QUALITY).encode_image(&small).ok()?;
    Some(format!("data:image/jpeg;base64,{}", STANDARD.encode(&jpeg)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_face_at_the_edge_is_cropped_to_the_picture() {
        let picture = RgbImage::new(200, 100);
        let face = |x: f32| Landmarks68 { points_px: std::array::from_fn(|i| [x + (i % 9) as f32 * 10.0, i as f32]) };
        assert!(thumbnail(&picture, &face(150.0)).unwrap().starts_with("data:image/jpeg;base64,/9j/"));
        assert_eq!(thumbnail(&picture, &face(900.0)), None);
        assert_eq!(thumbnail(&picture, &face(f32::NAN)), None);
    }
}
