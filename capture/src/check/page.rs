//! The report as one page: verdicts, figures over time, and the contact sheet.

use risorius_formats::html::escaped;
use std::fmt::Write as _;
use std::path::Path;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use plotters::prelude::*;
use risorius_formats::{FormatError, FrameRecord, Take, atomic};

use super::{CheckReport, Level};
use crate::Result;
use crate::sheet::sheet_png;

const SIZE: (u32, u32) = (900, 170);
/// A chart has at most so many points; each is the worst of those it stands for.
const POINTS: usize = 1500;
const STYLE: &str = "body{font:16px/1.5 sans-serif;max-width:940px;margin:2em auto;padding:0 1em;color:#222}\
td{padding:.2em .8em;vertical-align:top}.good{color:#187a2f}.fair{color:#a86400}.poor{color:#b3261e;font-weight:bold}\
img,svg{max-width:100%}";

/// Writes the report of a take to an HTML file that needs nothing beside it.
pub fn write_page(take: &Take, report: &CheckReport, path: &Path) -> Result<()> {
    let mut page = String::new();
    let name = escaped(&take.dir.display().to_string());
    let overall = word(report.overall);
    let _ = write!(
        page,
        "<!doctype html>\n<html lang=\"en\"><meta charset=\"utf-8\"><title>{name}: {overall}</title><style>{STYLE}</style>\n\
         <h1>{name}: <span class=\"{overall}\">{overall}</span></h1>\n<table>\n"
    );
    for v in &report.verdicts {
        let level = word(v.level);
        let _ = writeln!(
            page,
            "<tr><td class=\"{level}\">{level}</td><td>{}</td><td>{}</td></tr>",
            v.topic,
            escaped(&v.message)
        );
    }
    page.push_str("</table>\n");
    for chart in charts(&take.frames) {
        let svg = chart.draw().map_err(|e| FormatError::syntax(format!("cannot draw: {e}")).in_file(path))?;
        page.push_str(&svg);
    }
    if report.media_intact {
        let _ = write!(
            page,
            "<h2>Frames</h2>\n<p>Evenly spread over the take; blurred ones have a red border.</p>\n\
             <img alt=\"24 frames of the take\" src=\"data:image/png;base64,{}\">\n",
            STANDARD.encode(sheet_png(take)?)
        );
    }
    page.push_str("</html>\n");
    Ok(atomic::write_file(path, page.as_bytes())?)
}

pub(crate) fn word(level: Level) -> &'static str {
    match level {
        Level::Good => "good",
        Level::Fair => "fair",
        Level::Poor => "poor",
    }
}

struct Chart {
    title: &'static str,
    points: Vec<(f64, f64)>,
}

fn charts(frames: &[FrameRecord]) -> Vec<Chart> {
    let secs = |f: &FrameRecord| f.timestamp_nanos as f64 * 1e-9;
    let column = |title, pick: fn(&FrameRecord) -> Option<f32>| {
        let points = frames.iter().filter_map(|f| Some((secs(f), f64::from(pick(f)?)))).collect();
        Chart { title, points }
    };
    let intervals = frames.windows(2).map(|w| (secs(&w[1]), 1000.0 * (secs(&w[1]) - secs(&w[0])))).collect();
    let all = [
        column("sharpness, squared 8-bit levels, over seconds", |f| f.sharpness),
        column("mean luma, 0 to 255", |f| f.luma_mean),
        column("share of black and white pixels", |f| f.clipped_share),
        column("motion: mean difference from the frame before, levels", |f| f.motion),
        Chart { title: "time from frame to frame, ms", points: intervals },
    ];
    all.into_iter().filter(|c| c.points.len() > 1).collect()
}

impl Chart {
    fn draw(&self) -> std::result::Result<String, Box<dyn std::error::Error>> {
        let step = self.points.len().div_ceil(POINTS);
        // Of each stretch the lowest and the highest, so that a single bad frame is seen.
        let shown: Vec<(f64, f64)> = self
            .points
            .chunks(step)
            .flat_map(|part| {
                let low = part.iter().min_by(|a, b| a.1.total_cmp(&b.1)).copied();
                let high = part.iter().max_by(|a, b| a.1.total_cmp(&b.1)).copied();
                if step == 1 { [low, None] } else { [low, high] }
            })
            .flatten()
            .collect();
        let top = shown.iter().map(|p| p.1).fold(0.0, f64::max).max(1e-3) * 1.08;
        let end = self.points.last().map_or(1.0, |p| p.0).max(1e-3);
        let mut svg = String::new();
        {
            let root = SVGBackend::with_string(&mut svg, SIZE).into_drawing_area();
            let mut chart = ChartBuilder::on(&root)
                .caption(self.title, ("sans-serif", 14))
                .margin(6)
                .x_label_area_size(20)
                .y_label_area_size(52)
                .build_cartesian_2d(0.0..end, 0.0..top)?;
            chart.configure_mesh().y_labels(4).light_line_style(TRANSPARENT).draw()?;
            chart.draw_series(LineSeries::new(shown, RGBColor(40, 90, 160).stroke_width(1)))?;
            root.present()?;
        }
        Ok(svg)
    }
}
