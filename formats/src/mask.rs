//! Label images: one byte per pixel, 0 the rest, 1..N the regions; PNG on disk.

use std::io::Cursor;
use std::path::Path;

use crate::{FormatError, Result, atomic};

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

    /// Decodes an 8-bit grey PNG.
    pub fn parse_png(bytes: &[u8]) -> Result<Self> {
        let image = image::load_from_memory_with_format(bytes, image::ImageFormat::Png)
            .map_err(|e| FormatError::syntax(format!("not a label image: {e}")))?;
        let image::DynamicImage::ImageLuma8(grey) = image else {
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
