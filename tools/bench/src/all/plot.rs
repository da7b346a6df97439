//! The report's plots: error against cost, memory, and how cost grows.

use plotters::coord::Shift;
use plotters::prelude::*;

use crate::{Report, Row};

const COLOURS: [RGBColor; 8] = [
    RGBColor(31, 119, 180),
    RGBColor(214, 80, 40),
    RGBColor(44, 140, 60),
    RGBColor(130, 90, 190),
    RGBColor(140, 86, 75),
    RGBColor(200, 100, 170),
    RGBColor(110, 110, 110),
    RGBColor(20, 160, 170),
];
const PANEL: (u32, u32) = (470, 330);

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type Drawn = Result<(), Box<dyn std::error::Error>>;

/// A line of a panel.
pub(crate) struct Line {
    pub(crate) name: String,
    /// x, y.
    pub(crate) points: Vec<(f64, f64)>,
}

/// A panel.
pub(crate) struct Panel {
    pub(crate) title: String,
    pub(crate) x: String,
    pub(crate) y: String,
    /// Powers of ten along y.
    pub(crate) log_y: bool,
    pub(crate) lines: Vec<Line>,
}

/// Panels of error against CPU seconds, one per kind of error.
pub(crate) fn errors(report: &Report) -> Vec<Panel> {
    let mut panels: Vec<Panel> = Vec::new();
    for row in &report.rows {
        let Some((what, error)) = &row.error else { continue };
        let stage = row.name.split('/').next().unwrap_or_default();
        let (title, line) = (format!("{stage}: error against time"), series(row));
        // Fits whose other settings were varied all lie at one place of the line of steps.
        if stage == "fit" && line != "steps" {
            continue;
        }
        let at = panels.iter().position(|p| p.title == title).unwrap_or_else(|| {
            let x = "CPU seconds".to_owned();
            panels.push(Panel { title, x, y: what.clone(), log_y: false, lines: Vec::new() });
            panels.len() - 1
        });
        add(&mut panels[at], &line, (row.cpu_secs, *error));
    }
    panels
}

/// What belongs together within a stage: names without their numbers.
fn series(row: &Row) -> String {
    let setting = row.name.split_once('/').map_or(row.name.as_str(), |(_, s)| s);
    setting.trim_end_matches(|c: char| c.is_ascii_digit()).trim_end_matches('-').to_owned()
}

fn add(panel: &mut Panel, name: &str, point: (f64, f64)) {
    if let Some(line) = panel.lines.iter_mut().find(|l| l.name == name) {
        line.points.push(point);
    } else {
        panel.lines.push(Line { name: name.to_owned(), points: vec![point] });
    }
}

/// Panels of CPU seconds against frames, AUs, pixels and Gaussians, each line relative to its largest value.
pub(crate) fn growth(report: &Report) -> Vec<Panel> {
    let mut panels: Vec<Panel> = Vec::new();
    for row in &report.rows {
        let stage = row.name.split('/').next().unwrap_or_default();
        for (axis, value) in &row.grows_with {
            if *axis == "steps" && !row.name.contains("steps") {
                continue;
            }
            if !panels.iter().any(|p| p.x == *axis) {
                panels.push(Panel {
                    title: format!("How cost grows with {axis}"),
                    x: axis.clone(),
                    y: "CPU seconds".to_owned(),
                    log_y: true,
                    lines: Vec::new(),
                });
            }
            let name = match series(row).as_str() {
                every if every.contains("every") => format!("{stage}, {}", row.name.rsplit('-').next().unwrap_or("")),
                drawn if stage == "render" => format!("render, {drawn}"),
                _ => stage.to_owned(),
            };
            if let Some(panel) = panels.iter_mut().find(|p| p.x == *axis) {
                add(panel, &name, (*value, row.cpu_secs));
            }
        }
    }
    for line in panels.iter_mut().flat_map(|p| &mut p.lines) {
        line.points.sort_by(|a, b| a.0.total_cmp(&b.0));
    }
    panels.retain(|p| p.lines.iter().any(|l| l.points.len() > 1));
    panels
}

/// Draws panels side by side, two in a row.
pub(crate) fn svg(panels: &[Panel]) -> Result<String, String> {
    let rows = panels.len().div_ceil(2).max(1);
    let mut text = String::new();
    let draw = |text: &mut String| -> Drawn {
        let size = (2 * PANEL.0, rows as u32 * PANEL.1);
        let root = SVGBackend::with_string(text, size).into_drawing_area();
        root.fill(&WHITE)?;
        for (area, panel) in root.split_evenly((rows, 2)).iter().zip(panels) {
            lines(area, panel)?;
        }
        Ok(root.present()?)
    };
    draw(&mut text).map_err(|e| e.to_string())?;
    Ok(text)
}

/// The smallest and largest of some numbers, with room around them, more of it above.
fn range(values: impl Iterator<Item = f64>, above: f64) -> (f64, f64) {
    let (mut low, mut high) = (f64::MAX, f64::MIN);
    for v in values.filter(|v| v.is_finite()) {
        (low, high) = (low.min(v), high.max(v));
    }
    if low > high {
        return (0.0, 1.0);
    }
    let room = ((high - low) * 0.1).max(high.abs() * 0.02).max(0.03);
    (low - room, high + room * (1.0 + 10.0 * above))
}

/// Draws the lines of a panel. Powers of ten run along x, and along y where it says so: axes hold logarithms, so that a
/// range of less than ten has labels too.
fn lines(area: &Area<'_>, panel: &Panel) -> Drawn {
    let height = |y: f64| if panel.log_y { y.max(1e-9).log10() } else { y };
    let place = |p: &(f64, f64)| (p.0.max(1e-9).log10(), height(p.1));
    let points = || panel.lines.iter().flat_map(|l| l.points.iter().map(place));
    let (x0, x1) = range(points().map(|p| p.0), 0.0);
    // The names stand above the lines.
    let (y0, y1) = range(points().map(|p| p.1), 0.09 * panel.lines.len() as f64);
    let mut chart = ChartBuilder::on(area)
        .caption(&panel.title, ("sans-serif", 16))
        .margin(10)
        .x_label_area_size(36)
        .y_label_area_size(56)
        .build_cartesian_2d(x0..x1, y0..y1)?;
    chart
        .configure_mesh()
        .x_desc(&panel.x)
        .y_desc(&panel.y)
        .x_labels(6)
        .y_labels(7)
        .max_light_lines(0)
        .bold_line_style(BLACK.mix(0.12))
        .x_label_formatter(&|v| short(10f64.powf(*v)))
        .y_label_formatter(&|v| if panel.log_y { short(10f64.powf(*v)) } else { trimmed(&format!("{v:.2}")) })
        .draw()?;
    for (line, colour) in panel.lines.iter().zip(COLOURS.iter().cycle()) {
        let points: Vec<(f64, f64)> = line.points.iter().map(place).collect();
        chart
            .draw_series(LineSeries::new(points.iter().copied(), colour.stroke_width(2)))?
            .label(&line.name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 14, y)], colour.stroke_width(2)));
        chart.draw_series(points.iter().map(|p| Circle::new(*p, 3, colour.filled())))?;
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::UpperLeft)
        .background_style(WHITE.mix(0.8))
        .border_style(BLACK.mix(0.3))
        .draw()?;
    Ok(())
}

/// A number for an axis.
fn short(value: f64) -> String {
    match value {
        v if v >= 1e6 => format!("{}M", round(v * 1e-6)),
        v if v >= 1e3 => format!("{}k", round(v * 1e-3)),
        v => round(v),
    }
}

fn round(value: f64) -> String {
    let digits = if value >= 10.0 { 0 } else { usize::from(value < 1.0) + 1 };
    trimmed(&format!("{value:.digits$}"))
}

/// A decimal number without the zeros at its end.
fn trimmed(text: &str) -> String {
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text.to_owned() }
}

/// Peak memory of every command as bars.
pub(crate) fn memory(report: &Report) -> Result<String, String> {
    let rows: Vec<&Row> = report.rows.iter().collect();
    let height = 60 + 18 * rows.len() as u32;
    let most = rows.iter().map(|r| r.peak_mib).fold(1.0, f64::max);
    let mut text = String::new();
    let draw = |text: &mut String| -> Drawn {
        let root = SVGBackend::with_string(text, (2 * PANEL.0, height)).into_drawing_area();
        root.fill(&WHITE)?;
        let title = ("sans-serif", 16).into_text_style(&root).color(&BLACK);
        root.draw_text("Peak memory, MiB", &title, (12, 10))?;
        let label = ("sans-serif", 12).into_text_style(&root).color(&BLACK);
        for (i, row) in rows.iter().enumerate() {
            let top = 40 + 18 * i as i32;
            let width = (row.peak_mib / most * 560.0).round() as i32;
            root.draw(&Rectangle::new([(250, top), (250 + width, top + 13)], COLOURS[0].mix(0.7).filled()))?;
            root.draw_text(&row.name, &label, (12, top + 1))?;
            root.draw_text(&format!("{:.0}", row.peak_mib), &label, (256 + width, top + 1))?;
        }
        Ok(root.present()?)
    };
    draw(&mut text).map_err(|e| e.to_string())?;
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_have_short_numbers() {
        let shown = [0.25, 1.5, 12.4, 1500.0, 64_000.0, 2.5e6].map(short);
        assert_eq!(shown, ["0.25", "1.5", "12", "1.5k", "64k", "2.5M"]);
    }
}
