//! AU intensities before and after the choice, a panel per AU.

use plotters::coord::Shift;
use plotters::prelude::*;

use super::{Chart, text};
use crate::raster;
use crate::stats::{AttributeReport, Report};

/// One panel per AU.
const COLUMNS: usize = 6;
const PANEL: (u32, u32) = (210, 170);
const HEADER: u32 = 64;

/// The share of frames per intensity level above rest, one panel per AU: grey before, coloured after, a line for even
/// steps in time. Level 0 stands in the caption: it would dwarf everything else.
#[derive(Clone, Copy, Debug)]
pub struct Distribution<'a>(pub &'a Report);

impl Chart for Distribution<'_> {
    fn size(&self) -> (u32, u32) {
        let rows = self.0.attributes.len().div_ceil(COLUMNS).max(1);
        (PANEL.0 * COLUMNS as u32, HEADER + PANEL.1 * rows as u32)
    }

    fn draw<DB: DrawingBackend>(&self, root: &DrawingArea<DB, Shift>) -> Result<(), String> {
        let report = self.0;
        let rows = report.attributes.len().div_ceil(COLUMNS).max(1);
        let (head, body) = root.split_vertically(HEADER);
        header(&head, report)?;
        let regions: Vec<&str> = report.attributes.iter().fold(Vec::new(), |mut names, a| {
            if !names.contains(&a.region.as_str()) {
                names.push(&a.region);
            }
            names
        });
        for (area, attribute) in body.split_evenly((rows, COLUMNS)).iter().zip(&report.attributes) {
            let region = regions.iter().position(|r| *r == attribute.region).unwrap_or(0);
            panel(area, attribute, region)?;
        }
        Ok(())
    }
}

fn header<DB: DrawingBackend>(area: &DrawingArea<DB, Shift>, report: &Report) -> Result<(), String> {
    let title = format!(
        "AU intensities of {} of {} frames. Variation of block sizes above rest: {:.2} of all, {:.2} evenly over time, {:.2} chosen",
        report.chosen,
        report.candidates,
        report.evenness_before.raised_variation,
        report.evenness_uniform.raised_variation,
        report.evenness_after.raised_variation,
    );
    text(area, &title, (12, 12), 18)?;
    text(
        area,
        "Share of frames (%) per intensity; the rest is at rest. Grey: all usable frames. Coloured: chosen. Line: evenly over time",
        (12, 38),
        14,
    )
}

fn panel<DB: DrawingBackend>(
    area: &DrawingArea<DB, Shift>,
    attribute: &AttributeReport,
    region: usize,
) -> Result<(), String> {
    let levels = attribute.histogram_before.len();
    if levels < 2 {
        return Ok(());
    }
    let shares = |histogram: &[usize]| -> Vec<f64> {
        let total = histogram.iter().sum::<usize>().max(1) as f64;
        histogram.iter().map(|&c| 100.0 * c as f64 / total).collect()
    };
    let [before, uniform, after] =
        [&attribute.histogram_before, &attribute.histogram_uniform, &attribute.histogram_after].map(|h| shares(h));
    let top = [&before, &uniform, &after].into_iter().flat_map(|s| &s[1..]).fold(1.0f64, |m, &v| m.max(v)) * 1.05;
    let state =
        if attribute.active { format!("rest {:.0} → {:.0} %", before[0], after[0]) } else { "inactive".to_owned() };
    let step = 5.0 / (levels - 1) as f64;
    let mut chart = ChartBuilder::on(area)
        .caption(format!("{} {}: {state}", attribute.unit, attribute.name), ("sans-serif", 11))
        .margin(6)
        .x_label_area_size(20)
        .y_label_area_size(32)
        .build_cartesian_2d(0.5 * step..5.0 + 0.5 * step, 0.0..top)
        .map_err(|e| e.to_string())?;
    let y_label = |v: &f64| if top < 4.5 { format!("{v:.1}") } else { format!("{v:.0}") };
    let x_label = |v: &f64| format!("{v:.0}");
    let mut mesh = chart.configure_mesh();
    mesh.disable_x_mesh().x_labels(6).y_labels(5).x_label_formatter(&x_label).y_label_formatter(&y_label);
    mesh.light_line_style(TRANSPARENT).draw().map_err(|e| e.to_string())?;
    let [r, g, b] = raster::region_colour(region as u8 + 1);
    let bars = |values: &[f64], from: f64, to: f64, colour: RGBColor| -> Vec<Rectangle<(f64, f64)>> {
        let bar = |(level, &v): (usize, &f64)| {
            let x = level as f64 * step;
            Rectangle::new([(x + from * step, 0.0), (x + to * step, v)], colour.filled())
        };
        values.iter().enumerate().skip(1).map(bar).collect()
    };
    chart.draw_series(bars(&before, -0.4, 0.0, RGBColor(190, 190, 190))).map_err(|e| e.to_string())?;
    chart.draw_series(bars(&after, 0.0, 0.4, RGBColor(r, g, b))).map_err(|e| e.to_string())?;
    let line =
        LineSeries::new(uniform.iter().enumerate().skip(1).map(|(l, &v)| (l as f64 * step, v)), RGBColor(90, 90, 90));
    chart.draw_series(line).map_err(|e| e.to_string())?;
    Ok(())
}
