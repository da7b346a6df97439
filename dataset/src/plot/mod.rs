//! Pictures of a dataset's numbers. Every chart is drawn once and written twice: as SVG, and as PNG without fonts or
//! system libraries.

mod canvas;
mod distribution;
mod sphere;
mod timeline;
mod together;

use std::path::Path;

use plotters::coord::Shift;
use plotters::prelude::*;
use risorius_formats::atomic;

use crate::error::{DatasetError, Result};
use crate::stats::Report;

pub use distribution::Distribution;
pub use sphere::Sphere;
pub use timeline::Timeline;
pub use together::TogetherChart;

/// A chart that draws itself anywhere.
pub trait Chart {
    /// Width and height, pixels.
    fn size(&self) -> (u32, u32);
    /// Draws into the whole of `area`.
    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>) -> Result<(), String>;
}

/// The chart as an SVG document.
pub fn svg(chart: &impl Chart) -> Result<String, String> {
    let mut text = String::new();
    {
        let root = SVGBackend::with_string(&mut text, chart.size()).into_drawing_area();
        draw_all(chart, &root)?;
    }
    Ok(text)
}

/// The chart as a PNG file of twice its size.
pub fn png(chart: &impl Chart) -> Result<Vec<u8>, String> {
    let mut pixels = Vec::new();
    {
        let root = canvas::Canvas::new(chart.size(), &mut pixels).into_drawing_area();
        draw_all(chart, &root)?;
    }
    let (width, height) = (chart.size().0 * canvas::SCALE, chart.size().1 * canvas::SCALE);
    crate::package::png_bytes(&pixels, width, height, image::ExtendedColorType::Rgb8)
}

fn draw_all<DB: DrawingBackend>(chart: &impl Chart, root: &DrawingArea<DB, Shift>) -> Result<(), String> {
    root.fill(&WHITE).map_err(|e| e.to_string())?;
    chart.draw(root)?;
    root.present().map_err(|e| e.to_string())
}

/// Writes a chart, whole or not at all: as PNG where the name says so, else as SVG.
pub fn write(path: &Path, chart: &impl Chart) -> Result<()> {
    let fail = |e: String| DatasetError::Encode { path: path.to_owned(), message: e };
    let is_png = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("png"));
    let bytes = if is_png { png(chart).map_err(fail)? } else { svg(chart).map_err(fail)?.into_bytes() };
    Ok(atomic::write_file(path, &bytes)?)
}

/// Writes the plot of AU intensities before and after the choice.
pub fn write_distribution(path: &Path, report: &Report) -> Result<()> {
    write(path, &Distribution(report))
}

/// One line of text with its upper left corner at `place`.
fn text<DB: DrawingBackend>(
    area: &DrawingArea<DB, Shift>,
    words: &str,
    place: (i32, i32),
    size: i32,
) -> Result<(), String> {
    area.draw(&Text::new(words.to_owned(), place, ("sans-serif", size).into_font())).map_err(|e| e.to_string())
}
