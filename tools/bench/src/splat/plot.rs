//! The plot of run time against error.

use plotters::prelude::*;

use super::fits::Fit;

/// The lines of the plot: what of [`Fit::psnr_db`], in which colour.
const LINES: [(&str, RGBColor); 4] = [
    ("all", RGBColor(40, 40, 40)),
    ("all: head", RGBColor(31, 119, 180)),
    ("all: background", RGBColor(44, 140, 60)),
    ("unseen_expression: AU regions", RGBColor(214, 80, 40)),
];

/// PSNR over the seconds of the fit, as SVG.
pub(super) fn svg(fits: &[Fit]) -> Result<String, String> {
    let fail = |e: &dyn std::fmt::Display| e.to_string();
    let (mut low, mut high) = (f64::MAX, f64::MIN);
    for v in fits.iter().flat_map(|f| LINES.iter().filter_map(|(k, _)| f.psnr_db.get(*k))).filter(|v| v.is_finite()) {
        (low, high) = (low.min(*v), high.max(*v));
    }
    if low > high {
        return Err("no fit has a PSNR to plot".to_owned());
    }
    let longest = fits.iter().map(|f| f.wall_secs).fold(1.0, f64::max);
    let mut text = String::new();
    {
        let root = SVGBackend::with_string(&mut text, (760, 460)).into_drawing_area();
        root.fill(&WHITE).map_err(|e| fail(&e))?;
        let mut chart = ChartBuilder::on(&root)
            .caption("Gaussian field: error against the time of the fit", ("sans-serif", 18))
            .margin(12)
            .x_label_area_size(40)
            .y_label_area_size(50)
            .build_cartesian_2d(0.0..longest * 1.05, low - 0.5..high + 0.5)
            .map_err(|e| fail(&e))?;
        chart
            .configure_mesh()
            .x_desc("seconds on the wall, loading and saving included")
            .y_desc("mean PSNR, dB")
            .draw()
            .map_err(|e| fail(&e))?;
        for (key, color) in LINES {
            let points: Vec<(f64, f64)> =
                fits.iter().filter_map(|f| Some((f.wall_secs, *f.psnr_db.get(key)?))).collect();
            chart
                .draw_series(LineSeries::new(points.iter().copied(), color.stroke_width(2)))
                .map_err(|e| fail(&e))?
                .label(key)
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], color.stroke_width(2)));
            chart.draw_series(points.iter().map(|p| Circle::new(*p, 3, color.filled()))).map_err(|e| fail(&e))?;
        }
        chart
            .configure_series_labels()
            .position(SeriesLabelPosition::LowerRight)
            .background_style(WHITE.mix(0.8))
            .border_style(BLACK.mix(0.3))
            .draw()
            .map_err(|e| fail(&e))?;
        root.present().map_err(|e| fail(&e))?;
    }
    Ok(text)
}
