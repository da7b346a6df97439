//! Run time against error, one point for each run.

use std::path::Path;

use plotters::prelude::*;
use risorius_bench::panels::{self, Area, Drawn};
use risorius_formats::FormatError;

use super::Row;

/// Writes two panels: wall time per frame of the video against landmark error and against AU agreement.
///
/// Colours are folders of models, sizes are numbers of threads.
pub(crate) fn write(path: &Path, rows: &[Row]) -> Result<(), FormatError> {
    type Value = fn(&Row) -> f64;
    let sides: [(&str, Value); 2] = [
        ("inner-51 error without offset, % of the outer-eye distance", |r| r.errors.landmarks_without_offset_percent),
        ("AU intensity, mean ICC(3,1)", |r| r.errors.icc31_mean),
    ];
    panels::write(path, sides, |area, (title, value)| panel(area, title, rows, value))
}

fn panel(area: &Area<'_>, title: &str, rows: &[Row], value: fn(&Row) -> f64) -> Drawn {
    let ms = |r: &Row| 1000.0 / r.fps;
    let span = |values: Vec<f64>| {
        let (low, high) = values.iter().fold((f64::MAX, f64::MIN), |m, v| (m.0.min(*v), m.1.max(*v)));
        let pad = (0.1 * (high - low)).max(0.02 * high.abs()).max(1e-6);
        (low - pad)..(high + 2.5 * pad)
    };
    let (x, y) = (span(rows.iter().map(ms).collect()), span(rows.iter().map(value).collect()));
    let mut chart = ChartBuilder::on(area)
        .caption(title, ("sans-serif", 15))
        .margin(12)
        .x_label_area_size(36)
        .y_label_area_size(48)
        .build_cartesian_2d(x, y)?;
    chart.configure_mesh().x_desc("ms per frame of the video").light_line_style(TRANSPARENT).draw()?;
    let mut folders: Vec<&str> = rows.iter().map(|r| r.models.as_str()).collect();
    folders.dedup();
    chart.draw_series(rows.iter().map(|r| {
        let color = Palette99::pick(folders.iter().position(|f| *f == r.models).unwrap_or(0));
        let label = format!("N = {}, {} thread{}", r.every, r.threads, if r.threads == 1 { "" } else { "s" });
        EmptyElement::at((ms(r), value(r)))
            + Circle::new((0, 0), 2 + r.threads.min(6), color.filled())
            + Text::new(label, (8, 8 - 14 * (r.threads as i32).min(4)), ("sans-serif", 11))
    }))?;
    Ok(())
}
