//! Run time against error, one point for each run.

use std::path::Path;

use plotters::prelude::*;
use risorius_bench::panels::{self, Area, Drawn};
use risorius_formats::FormatError;

use super::Row;

/// Writes two panels: CPU time against mean rotation error and against mean position error; both axes logarithmic.
pub(crate) fn write(path: &Path, rows: &[Row]) -> Result<(), FormatError> {
    type Value = fn(&Row) -> f64;
    let sides: [(&str, Value); 2] = [
        ("mean rotation error, degrees", |r| r.rotation_mean_deg),
        ("mean position error, % of the path's radius", |r| r.position_mean_percent),
    ];
    panels::write(path, sides, |area, (title, value)| panel(area, title, rows, value))
}

fn panel(area: &Area<'_>, title: &str, rows: &[Row], value: fn(&Row) -> f64) -> Drawn {
    let usable: Vec<&Row> =
        rows.iter().filter(|r| value(r).is_finite() && value(r) > 0.0 && r.cpu_secs > 0.0).collect();
    let span = |values: Vec<f64>| {
        let (low, high) = values.iter().fold((f64::MAX, f64::MIN), |m, v| (m.0.min(*v), m.1.max(*v)));
        if low > high { 0.1..1.0 } else { low * 0.6..high * 2.2 }
    };
    let x = span(usable.iter().map(|r| r.cpu_secs).collect());
    let y = span(usable.iter().map(|r| value(r)).collect());
    let mut chart = ChartBuilder::on(area)
        .caption(title, ("sans-serif", 15))
        .margin(12)
        .x_label_area_size(36)
        .y_label_area_size(56)
        .build_cartesian_2d(x.log_scale(), y.log_scale())?;
    chart.configure_mesh().x_desc("CPU seconds").light_line_style(TRANSPARENT).draw()?;
    chart.draw_series(usable.iter().map(|r| {
        let color = if r.recipe == "plain COLMAP" { RGBColor(200, 60, 40) } else { RGBColor(30, 90, 200) };
        let label = format!("{}, {} key frames", r.recipe, r.keyframes);
        EmptyElement::at((r.cpu_secs, value(r)))
            + Circle::new((0, 0), 4, color.filled())
            + Text::new(label, (7, -14), ("sans-serif", 11))
    }))?;
    Ok(())
}
