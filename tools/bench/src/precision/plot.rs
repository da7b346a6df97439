//! Run time against error, a line for each stage; both axes logarithmic.

use std::path::Path;

use plotters::prelude::*;
use risorius_bench::panels::{self, Area, Drawn};
use risorius_formats::FormatError;

use crate::Rung;

/// What has no error at all is drawn here.
const EXACT: f64 = 1e-17;
/// Where the legend stands in its panel, pixels: on the right, between the errors of 32 bits and those of 64, where no
/// stage has a point.
const LEGEND: SeriesLabelPosition = SeriesLabelPosition::Coordinate(258, 168);

/// Writes two panels: the largest and the root mean square error.
pub(crate) fn write(path: &Path, rungs: &[Rung]) -> Result<(), FormatError> {
    type Value = fn(&Rung) -> f64;
    let sides: [(&str, Value); 2] =
        [("largest error, share of the largest value", |r| r.max_error), ("root mean square error", |r| r.rms_error)];
    panels::write(path, sides, |area, (title, value)| panel(area, title, rungs, value))
}

fn panel(area: &Area<'_>, title: &str, rungs: &[Rung], value: fn(&Rung) -> f64) -> Drawn {
    let span = |values: Vec<f64>| {
        let (low, high) = values.iter().fold((f64::MAX, f64::MIN), |m, v| (m.0.min(*v), m.1.max(*v)));
        low * 0.5..high * 6.0
    };
    let x = span(rungs.iter().map(|r| r.nanos).collect());
    let mut chart = ChartBuilder::on(area)
        .caption(title, ("sans-serif", 15))
        .margin(12)
        .x_label_area_size(36)
        .y_label_area_size(56)
        .build_cartesian_2d(x.log_scale(), (EXACT * 0.5..10.0).log_scale())?;
    let power = |v: &f64| format!("{v:.0e}");
    chart
        .configure_mesh()
        .x_desc("nanoseconds a value")
        .x_label_formatter(&power)
        .y_label_formatter(&power)
        .light_line_style(TRANSPARENT)
        .draw()?;
    let mut stages: Vec<&str> = rungs.iter().map(|r| r.stage).collect();
    stages.dedup();
    for (i, stage) in stages.into_iter().enumerate() {
        let color = Palette99::pick(i).to_rgba();
        let own: Vec<&Rung> = rungs.iter().filter(|r| r.stage == stage).collect();
        let place = |r: &Rung| (r.nanos, value(r).max(EXACT));
        let line = LineSeries::new(own.iter().map(|r| place(r)), color.mix(0.4));
        chart.draw_series(line)?.label(stage).legend(move |(x, y)| Circle::new((x + 8, y), 4, color.filled()));
        chart.draw_series(own.iter().map(|r| {
            EmptyElement::at(place(r))
                + Circle::new((0, 0), 4, color.filled())
                + Text::new(r.numbers, (6, -12), ("sans-serif", 10))
        }))?;
    }
    let border = BLACK.mix(0.3);
    chart.configure_series_labels().background_style(WHITE.mix(0.8)).border_style(border).position(LEGEND).draw()?;
    Ok(())
}
