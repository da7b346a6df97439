//! The folder `report/`: numbers, charts, the contact sheet and one page that holds them all.

use std::path::Path;

use risorius_formats::atomic;
use risorius_formats::pose_report::write_json;

use crate::error::{DatasetError, Result};
use crate::options::BuildOptions;
use crate::page::{self, Figure};
use crate::plot::{self, Chart, Distribution, Sphere, Timeline, TogetherChart};
use crate::rows::{FrameState, Rows};
use crate::sheet::{self, Thumbnail};
use crate::stats::Report;

/// Writes the report of a dataset into its folder `dir`.
pub(crate) fn write(
    dir: &Path,
    rows: &Rows,
    report: &Report,
    options: &BuildOptions,
    thumbnails: &[Thumbnail],
) -> Result<()> {
    let dir = dir.join("report");
    write_json(dir.join("stats.json"), report)?;
    let settings = toml::to_string(options).map_err(|e| DatasetError::encode(dir.join("settings.toml"), &e))?;
    atomic::write_file(dir.join("settings.toml"), settings.as_bytes())?;
    let mut figures = Vec::new();
    figures.push(both(&dir, "distribution", "AU intensities before and after", &Distribution(report))?);
    figures.push(both(&dir, "together", "AUs that are raised together", &TogetherChart(report))?);
    figures.push(both(&dir, "coverage", "Camera coverage", &sphere(rows, report))?);
    for (k, take) in rows.takes.iter().enumerate() {
        let name = if k == 0 { "timeline".to_owned() } else { format!("timeline-{}", k + 1) };
        let title = format!("AUs over time: {}", take.name);
        figures.push(both(&dir, &name, &title, &Timeline { take, table: &rows.table })?);
    }
    let sheet = dir.join("contact_sheet.png");
    sheet::write_png(&sheet, thumbnails, &rows.table)?;
    let sheet = std::fs::read(&sheet).ok();
    let page = page::html(rows, report, &settings, &figures, sheet.as_deref());
    Ok(atomic::write_file(dir.join("index.html"), page.as_bytes())?)
}

/// Writes a chart as SVG and as PNG, and keeps the SVG for the page.
fn both(dir: &Path, name: &str, title: &str, chart: &impl Chart) -> Result<Figure> {
    let path = dir.join(format!("{name}.svg"));
    let svg = plot::svg(chart).map_err(|message| DatasetError::Encode { path: path.clone(), message })?;
    atomic::write_file(&path, svg.as_bytes())?;
    plot::write(&dir.join(format!("{name}.png")), chart)?;
    Ok(Figure { title: title.to_owned(), svg })
}

fn sphere(rows: &Rows, report: &Report) -> Sphere {
    let usable = || rows.takes.iter().flat_map(|t| &t.frames).filter(|f| f.state == FrameState::Usable);
    let of = |split: &str| usable().filter(|f| f.split == Some(split)).filter_map(|f| f.view).collect();
    Sphere {
        usable: usable().filter_map(|f| f.view).collect(),
        train: of("train"),
        val: of("val"),
        coverage: report.coverage,
    }
}
