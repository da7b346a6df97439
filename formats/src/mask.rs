//! Label images: one byte per pixel, 0 the rest, 1..N the regions; PNG on disk.

use std::io::Cursor;
use std::path::Path;

use image::codecs::png::PngDecoder;
use image::{DynamicImage, ImageDecoder as _, ImageError};

use crate::{ErrorKind, FormatError, Result, atomic};

/// What a byte of a PNG can become at most: two bits a run of 258 bytes.
const MOST_UNPACKED: u64 = 1032;
/// Bytes that the decoder may take for a row, a colour profile or a text.
const MOST_BUFFER: u64 = 16 << 20;

/// A label per pixel, row by row from the top left.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LabelImage {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `width · height` labels.
    pub labels: Vec<u8>,
}

impl LabelImage {
    /// An image of zeros.
    pub fn new(width: u32, height: u32) -> Self {
        Self { width, height, labels: vec![0; width as usize * height as usize] }
    }

    /// The label at column `x`, row `y`.
    pub fn get(&self, x: u32, y: u32) -> u8 {
        self.labels[y as usize * self.width as usize + x as usize]
    }

    /// Share of pixels that carry `label`, 0–1.
    pub fn share(&self, label: u8) -> f64 {
        if self.labels.is_empty() {
            return 0.0;
        }
        let carrying: usize = self.labels.iter().map(|&l| usize::from(l == label)).sum();
        carrying as f64 / self.labels.len() as f64
    }

    /// Decodes an 8-bit grey PNG. Takes no memory for more pixels than the file can hold.
    pub fn parse_png(bytes: &[u8]) -> Result<Self> {
        let bad = |e: ImageError| FormatError::syntax(format!("not a label image: {e}"));
        let mut limits = image::Limits::default();
        limits.max_alloc = Some(MOST_BUFFER);
        let decoder = PngDecoder::with_limits(Cursor::new(bytes), limits).map_err(bad)?;
        let (width, height) = decoder.dimensions();
        let bits = u64::from(decoder.original_color_type().bits_per_pixel());
        let unpacked = (u64::from(width) * u64::from(height)).saturating_mul(bits) / 8;
        if unpacked > MOST_UNPACKED * bytes.len() as u64 {
            let message = format!("claims {width}×{height} pixels, more than {} bytes can hold", bytes.len());
            return Err(FormatError::new(ErrorKind::Limits, message));
        }
        let DynamicImage::ImageLuma8(grey) = DynamicImage::from_decoder(decoder).map_err(bad)? else {
            return Err(FormatError::syntax("a label image must be 8-bit grey"));
        };
        Ok(Self { width: grey.width(), height: grey.height(), labels: grey.into_raw() })
    }

    /// Reads an 8-bit grey PNG.
    pub fn read_png(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let bytes = std::fs::read(path).map_err(|e| FormatError::io(path, "read", &e))?;
        Self::parse_png(&bytes).map_err(|e| e.in_file(path))
    }

    /// Writes an 8-bit grey PNG, whole or not at all.
    pub fn write_png(&self, path: impl AsRef<Path>) -> Result<()> {
        let path = path.as_ref();
        let mut bytes = Cursor::new(Vec::new());
        image::write_buffer_with_format(
            &mut bytes,
            &self.labels,
            self.width,
            self.height,
            image::ExtendedColorType::L8,
            image::ImageFormat::Png,
        )
        .map_err(|e| FormatError::syntax(format!("cannot encode: {e}")).in_file(path))?;
        atomic::write_file(path, bytes.get_ref())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flat_labels_of_a_large_picture_come_back() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("flat.png");
        let mut flat = LabelImage::new(3840, 2160);
        for labels in [0u8, 3] {
            flat.labels.fill(labels);
            flat.write_png(&path).unwrap();
            assert_eq!(LabelImage::read_png(&path).unwrap(), flat);
        }
    }

    #[test]
    fn more_pixels_than_the_file_can_hold_are_refused() {
        // The first byte chooses the fuzzer's parser.
        let found = include_bytes!("../../fuzz/found/text/labels-that-claim-900-megapixels");
        let error = LabelImage::parse_png(&found[1..]).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::Limits);
        assert_eq!(
            error.to_string(),
            format!("claims 30000×30000 pixels, more than {} bytes can hold", found.len() - 1)
        );
    }
}
