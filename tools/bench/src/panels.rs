//! Two plots side by side.

use std::path::Path;

use plotters::coord::Shift;
use plotters::prelude::*;
use risorius_formats::{FormatError, atomic};

const SIZE: (u32, u32) = (960, 420);

/// Half of the picture.
pub type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// What drawing a panel comes to.
pub type Drawn = Result<(), Box<dyn std::error::Error>>;

/// Writes an SVG of a panel for each of two sides, `draw(area, side)`.
pub fn write<T>(path: &Path, sides: [T; 2], draw: impl Fn(&Area<'_>, T) -> Drawn) -> Result<(), FormatError> {
    let mut svg = String::new();
    let all = |svg: &mut String| -> Drawn {
        let root = SVGBackend::with_string(svg, SIZE).into_drawing_area();
        root.fill(&WHITE)?;
        let (left, right) = root.split_horizontally(SIZE.0 / 2);
        for (area, side) in [left, right].iter().zip(sides) {
            draw(area, side)?;
        }
        Ok(root.present()?)
    };
    all(&mut svg).map_err(|e| FormatError::syntax(e.to_string()).in_file(path))?;
    atomic::write_file(path, svg.as_bytes())
}
