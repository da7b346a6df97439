//! Run time against error, one point for each run.

use std::path::Path;

use plotters::prelude::*;

use super::Row;

const SIZE: (u32, u32) = (960, 420);

/// Writes two panels: CPU time against mean rotation error and against mean position error; both axes logarithmic.
pub(crate) fn write(path: &Path, rows: &[Row]) -> Result<(), String> {
    type Value = fn(&Row) -> f64;
    let mut svg = String::new();
    {
        let root = SVGBackend::with_string(&mut svg, SIZE).into_drawing_area();
        root.fill(&WHITE).map_err(|e| e.to_string())?;
        let (left, right) = root.split_horizontally(SIZE.0 / 2);
        let panels: [(_, &str, Value); 2] = [
            (left, "mean rotation error, degrees", |r| r.rotation_mean_deg),
            (right, "mean position error, % of the path's radius", |r| r.position_mean_percent),
        ];
        for (area, title, value) in panels {
            panel(&area, title, rows, value).map_err(|e| e.to_string())?;
        }
        root.present().map_err(|e| e.to_string())?;
    }
    risorius_formats::atomic::write_file(path, svg.as_bytes()).map_err(|e| e.to_string())
}

type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;

fn panel(area: &Area, title: &str, rows: &[Row], value: fn(&Row) -> f64) -> Result<(), Box<dyn std::error::Error>> {
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
