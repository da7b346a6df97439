//! A contact sheet: a few frames of a take on one picture.

use std::path::Path;

use image::{ImageFormat, Rgb, RgbImage, imageops};
use risorius_formats::{FormatError, Take, atomic};

use crate::check::blurred_frames;
use crate::{CaptureError, Result};

const COLUMNS: u32 = 6;
const ROWS: u32 = 4;
/// Longer side of a picture on the sheet, pixels.
const CELL: u32 = 240;
/// Width of the frame around a picture, pixels.
const BORDER: u32 = 4;
const PLAIN: Rgb<u8> = Rgb([40, 40, 40]);
const BLURRED: Rgb<u8> = Rgb([220, 60, 40]);

/// Writes 24 frames, evenly spread over the take, to a PNG file; blurred ones have a red border.
pub fn write_sheet(take: &Take, path: impl AsRef<Path>) -> Result<()> {
    Ok(atomic::write_file(path, &sheet_png(take)?)?)
}

/// The same as the bytes of a PNG file.
pub(crate) fn sheet_png(take: &Take) -> Result<Vec<u8>> {
    let (width, height) = (take.manifest.width.max(1), take.manifest.height.max(1));
    let scale = f64::from(CELL) / f64::from(width.max(height));
    let size = |side: u32| ((f64::from(side) * scale).round() as u32).max(1);
    let (cell_width, cell_height) = (size(width) + 2 * BORDER, size(height) + 2 * BORDER);
    let count = (COLUMNS * ROWS).min(take.manifest.frame_count);
    let indices: Vec<u32> = (0..count).map(|i| spread(i, count, take.manifest.frame_count)).collect();
    let blurred = blurred_frames(&take.frames);
    let mut sheet = RgbImage::from_pixel(COLUMNS * cell_width, count.div_ceil(COLUMNS) * cell_height, PLAIN);
    risorius_video::read_take_frames(take, &indices, |index, image| {
        let place = indices.binary_search(&index).unwrap_or(0) as u32;
        let (x, y) = ((place % COLUMNS) * cell_width, (place / COLUMNS) * cell_height);
        if blurred.contains(&index) {
            let red = RgbImage::from_pixel(cell_width, cell_height, BLURRED);
            imageops::replace(&mut sheet, &red, x.into(), y.into());
        }
        let small = imageops::thumbnail(&image, size(width), size(height));
        imageops::replace(&mut sheet, &small, (x + BORDER).into(), (y + BORDER).into());
        Ok::<(), CaptureError>(())
    })?;
    let mut bytes = std::io::Cursor::new(Vec::new());
    sheet
        .write_to(&mut bytes, ImageFormat::Png)
        .map_err(|e| FormatError::syntax(format!("cannot encode: {e}")).in_file(take.media_path()))?;
    Ok(bytes.into_inner())
}

/// The `i`-th of `count` frames spread over `total`, first and last included.
fn spread(i: u32, count: u32, total: u32) -> u32 {
    (u64::from(i) * u64::from(total.saturating_sub(1)) / u64::from(count.saturating_sub(1).max(1))) as u32
}
