//! The contact sheet: a look at the chosen frames with their regions and AU values.

use std::path::{Path, PathBuf};

use image::{ExtendedColorType, Rgb, RgbImage};
use risorius_formats::AttributeTable;
use risorius_formats::au::MAX_INTENSITY;
use risorius_formats::mask::LabelImage;
use risorius_formats::nerfies::{self, Dataset};

use crate::error::{DatasetError, Result};
use crate::package::{self, Job};
use crate::regions::{self, RegionStyle};
use crate::rows::Rows;
use crate::{balance, raster, scale};

/// Frames on the sheet.
pub const FRAMES: usize = 40;
/// Frames in a row.
const COLUMNS: u32 = 8;
/// Pictures are reduced until they are no wider than this, pixels.
const MAX_WIDTH: u32 = 180;
/// Height of the AU bars under a picture, pixels.
const BARS: u32 = 28;
/// Space around pictures, pixels.
const GAP: u32 = 4;
/// How strongly regions are tinted, in 256ths.
const TINT: u16 = 88;

/// One picture of the sheet.
#[derive(Clone, Debug)]
pub struct Thumbnail {
    image: RgbImage,
    intensities: Vec<f32>,
}

/// Reduces and tints a frame.
pub fn thumbnail(image: &RgbImage, job: &Job, styles: &[RegionStyle]) -> Thumbnail {
    let (width, height) = (job.camera.intrinsics.width, job.camera.intrinsics.height);
    let divisor = [1, 2, 4].into_iter().find(|d| width / d <= MAX_WIDTH).unwrap_or(8);
    let mut small = scale::reduced(image, divisor);
    if let Some(head) = &job.head {
        raster::dim_outside(&mut small, &raster::hull_mask(head, &job.camera.reduced(divisor)));
    }
    if let Some(polygons) = &job.polygons {
        raster::tint(
            &mut small,
            &regions::label_image(polygons, styles, divisor, width / divisor, height / divisor),
            TINT,
        );
    }
    Thumbnail { image: small, intensities: job.intensities.clone() }
}

/// The pictures of a sheet from the files of a dataset.
pub fn thumbnails(dir: &Path, dataset: &Dataset, rows: &Rows) -> Result<Vec<Thumbnail>> {
    let scales = crate::export::scales_in(dir);
    let width = dataset.cameras.values().next().map_or(0, |c| c.intrinsics.width);
    let Some(&scale) = scales.iter().find(|&&s| width / s <= MAX_WIDTH).or(scales.last()) else {
        return Ok(Vec::new());
    };
    let chosen: Vec<_> = rows.takes.iter().flat_map(|t| &t.frames).filter(|f| f.id.is_some()).collect();
    let mut result = Vec::new();
    for row in balance::spread(chosen.len(), FRAMES).into_iter().map(|i| chosen[i]) {
        let id = row.id.as_deref().unwrap_or_default();
        let path = nerfies::rgb_path(dir, scale, id);
        let decoded = image::open(&path).map_err(|e| DatasetError::Picture { path, message: e.to_string() })?;
        let mut picture = decoded.into_rgb8();
        let mask = |path: PathBuf| if path.is_file() { LabelImage::read_png(path).map(Some) } else { Ok(None) };
        if let Some(head) = mask(nerfies::head_path(dir, scale, id))? {
            raster::dim_outside(&mut picture, &head);
        }
        if let Some(labels) = mask(nerfies::region_path(dir, scale, id))? {
            raster::tint(&mut picture, &labels, TINT);
        }
        result.push(Thumbnail { image: picture, intensities: row.intensities.clone().unwrap_or_default() });
    }
    Ok(result)
}

/// Draws and writes the sheet; nothing without pictures.
pub fn write_png(path: &Path, thumbnails: &[Thumbnail], table: &AttributeTable) -> Result<()> {
    let Some(first) = thumbnails.first() else { return Ok(()) };
    let (w, h) = (first.image.width(), first.image.height());
    let columns = COLUMNS.min(thumbnails.len() as u32);
    let rows = (thumbnails.len() as u32).div_ceil(columns);
    let (cell_w, cell_h) = (w + GAP, h + BARS + GAP);
    let mut sheet = RgbImage::from_pixel(columns * cell_w + GAP, rows * cell_h + GAP, Rgb([24; 3]));
    for (i, thumbnail) in (0u32..).zip(thumbnails) {
        let (x, y) = (GAP + i % columns * cell_w, GAP + i / columns * cell_h);
        image::imageops::replace(&mut sheet, &thumbnail.image, i64::from(x), i64::from(y));
        bars(&mut sheet, thumbnail, table, [x, y + h, w]);
    }
    package::write_png(path, sheet.as_raw(), sheet.width(), sheet.height(), ExtendedColorType::Rgb8)
}

/// A bar per attribute in its region's colour, full height at intensity 5.
fn bars(sheet: &mut RgbImage, thumbnail: &Thumbnail, table: &AttributeTable, [x, y, width]: [u32; 3]) {
    let count = table.attributes.len().max(1) as u32;
    for (k, (spec, &v)) in (0u32..).zip(table.attributes.iter().zip(&thumbnail.intensities)) {
        let (left, right) = (x + k * width / count, x + (k + 1) * width / count);
        let filled = ((v / MAX_INTENSITY).clamp(0.0, 1.0) * BARS as f32).round() as u32;
        for column in left..right.saturating_sub(1).max(left + 1).min(sheet.width()) {
            for row in 0..BARS {
                let colour = if BARS - row <= filled { raster::region_colour(spec.region as u8 + 1) } else { [44; 3] };
                sheet.put_pixel(column, y + row, Rgb(colour));
            }
        }
    }
}
