//! `bench-confies against-splat`: the same times for both fields, and the times that both need for the same error.

use std::path::PathBuf;

use plotters::prelude::*;
use risorius_console::{Console, Failure};
use serde::Serialize;

use super::rows::{self, Job, Row};
use super::{create, text};
use crate::panels;

/// Options of `bench-confies against-splat`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Example:\n  bench-confies against-splat --dataset datasets/ada --views test/views.json --work work/against --budgets 2m,10m,30m\n\nWrites against.csv, against.md, against.json and against.svg into WORK. A run that was stopped goes on with the first fit\nthat is not measured."
)]
pub(super) struct Args {
    /// A dataset made by `dataset build`
    #[arg(long, value_name = "DIR")]
    dataset: PathBuf,
    /// Views with true pictures
    #[arg(long, value_name = "VIEWS.json")]
    views: PathBuf,
    /// Where runs, rows, table and plot go
    #[arg(long, value_name = "DIR")]
    work: PathBuf,
    /// Times of both fields' fits
    #[arg(long, value_name = "TIMES", value_delimiter = ',', default_value = "2m,5m,15m")]
    budgets: Vec<String>,
    /// Further times of the Gaussian field, short ones, where it meets the other's error
    #[arg(long, value_name = "TIMES", value_delimiter = ',', default_value = "3s,6s,15s,30s")]
    splat_budgets: Vec<String>,
    /// Preset of the paper's networks
    #[arg(long, value_name = "NAME", default_value = "cpu")]
    preset: String,
    /// Image scale of both [default: the dataset's]
    #[arg(long, value_name = "S")]
    image_scale: Option<u32>,
    /// Say what would be fitted, without doing it
    #[arg(long)]
    dry_run: bool,
}

/// What is plotted and compared: whole pictures, and what the AUs move.
const SHOWN: [&str; 2] = ["all", "all: AU regions"];

/// Both fields at one time.
#[derive(Debug, Serialize)]
struct EqualTime {
    budget: String,
    confies_psnr_db: f64,
    splat_psnr_db: f64,
}

/// The times that both need for what confies reaches.
#[derive(Debug, Serialize)]
struct EqualError {
    psnr_db: f64,
    confies_secs: f64,
    /// `None` where no splat fit reaches it.
    splat_secs: Option<f64>,
    /// Whether the shortest splat fit is better already, so that its time is only a bound from above.
    bound: bool,
}

#[derive(Debug, Serialize)]
struct Report {
    confies: Vec<Row>,
    splat: Vec<Row>,
    equal_time: Vec<EqualTime>,
    equal_error: Vec<EqualError>,
}

pub(super) fn run(args: &Args, console: &Console) -> Result<(), Failure> {
    create(&args.work)?;
    let mut short: Vec<&String> = args.splat_budgets.iter().filter(|b| !args.budgets.contains(b)).collect();
    short.extend(&args.budgets);
    let splat: Vec<Job<'_>> = short.into_iter().map(|b| job(args, "splat", b)).collect();
    let confies: Vec<Job<'_>> = args.budgets.iter().map(|b| job(args, "confies", b)).collect();
    if args.dry_run {
        let commands: Vec<String> =
            splat.iter().chain(&confies).map(|j| format!("trainer {}", j.command(&args.work).join(" "))).collect();
        console.finish(&commands, &commands.join("\n"));
        return Ok(());
    }
    let measured = |jobs: &[Job<'_>]| {
        let mut rows = jobs.iter().map(|j| j.measure(&args.work, console)).collect::<Result<Vec<_>, _>>()?;
        rows.sort_by(|a, b| a.wall_secs.total_cmp(&b.wall_secs));
        Ok::<_, Failure>(rows)
    };
    let (splat, confies) = (measured(&splat)?, measured(&confies)?);
    let report = Report {
        equal_time: equal_time(args, &confies, &splat),
        equal_error: equal_error(&confies, &splat),
        confies,
        splat,
    };
    let header = ["field", "time asked", "steps", "wall s", "CPU s", "peak MiB", "PSNR dB", "AU regions dB"];
    let cells: Vec<Vec<String>> = report.splat.iter().chain(&report.confies).map(cells).collect();
    let table = rows::write(&args.work, "against", &header, &cells, &report)?;
    let words = format!("{table}\n{}", words(&report));
    risorius_formats::atomic::write_file(args.work.join("against.md"), words.as_bytes())?;
    plot(&args.work.join("against.svg"), &report)?;
    console.finish(&report, words.trim_end());
    Ok(())
}

fn job<'a>(args: &'a Args, field: &str, budget: &str) -> Job<'a> {
    let mut fit = vec!["--field".to_owned(), field.to_owned(), "--budget".to_owned(), budget.to_owned()];
    if field == "confies" {
        fit.extend(["--preset".to_owned(), args.preset.clone()]);
    }
    fit.extend(args.image_scale.iter().flat_map(|s| ["--image-scale".to_owned(), s.to_string()]));
    let eval = vec!["--views".to_owned(), text(&args.views), "--lpips".to_owned(), "none".to_owned()];
    Job { name: format!("{field}-{budget}"), dataset: &args.dataset, fit, eval, resumes: false }
}

fn of(row: &Row, part: &str) -> f64 {
    row.psnr_db.get(part).copied().unwrap_or(f64::NAN)
}

fn budget_of(row: &Row) -> &str {
    row.name.split_once('-').map_or("", |(_, budget)| budget)
}

fn equal_time(args: &Args, confies: &[Row], splat: &[Row]) -> Vec<EqualTime> {
    let at =
        |rows: &[Row], budget: &str| rows.iter().find(|r| budget_of(r) == budget).map_or(f64::NAN, |r| of(r, SHOWN[0]));
    let both = |budget: &String| EqualTime {
        confies_psnr_db: at(confies, budget),
        splat_psnr_db: at(splat, budget),
        budget: budget.clone(),
    };
    args.budgets.iter().map(both).collect()
}

/// For each confies fit, when the Gaussian field is as good: between its fits on a line over the logarithm of time.
fn equal_error(confies: &[Row], splat: &[Row]) -> Vec<EqualError> {
    let curve: Vec<(f64, f64)> = splat.iter().map(|r| (r.wall_secs.ln(), of(r, SHOWN[0]))).collect();
    let reached = |psnr: f64| {
        let first = curve.iter().position(|(_, p)| *p >= psnr)?;
        let (t1, p1) = curve[first];
        let Some((t0, p0)) = first.checked_sub(1).map(|i| curve[i]) else { return Some((t1.exp(), true)) };
        Some(((t0 + (t1 - t0) * (psnr - p0) / (p1 - p0)).exp(), false))
    };
    let row = |r: &Row| {
        let psnr_db = of(r, SHOWN[0]);
        let splat = reached(psnr_db);
        EqualError {
            psnr_db,
            confies_secs: r.wall_secs,
            splat_secs: splat.map(|b| b.0),
            bound: splat.is_some_and(|b| b.1),
        }
    };
    confies.iter().map(row).collect()
}

fn cells(row: &Row) -> Vec<String> {
    let shown = |part: &str| match of(row, part) {
        v if v.is_finite() => format!("{v:.2}"),
        _ => "–".to_owned(),
    };
    vec![
        row.name.split('-').next().unwrap_or_default().to_owned(),
        budget_of(row).to_owned(),
        row.steps.to_string(),
        format!("{:.1}", row.wall_secs),
        format!("{:.1}", row.cpu_secs),
        format!("{:.0}", row.peak_mib),
        shown(SHOWN[0]),
        shown(SHOWN[1]),
    ]
}

fn words(report: &Report) -> String {
    use std::fmt::Write as _;
    let mut text = String::from("Equal time:\n\n| time | confies dB | splat dB | difference |\n|---|---|---|---|\n");
    for e in &report.equal_time {
        let (c, b) = (e.confies_psnr_db, e.splat_psnr_db);
        let _ = writeln!(text, "| {} | {c:.2} | {b:.2} | {:+.2} |", e.budget, b - c);
    }
    text.push_str("\nEqual error:\n\n| PSNR dB | confies s | splat s | times as fast |\n|---|---|---|---|\n");
    for e in &report.equal_error {
        let (splat, times) = match e.splat_secs {
            Some(secs) => {
                let (at_most, at_least) = if e.bound { ("at most ", "at least ") } else { ("", "") };
                (format!("{at_most}{secs:.1}"), format!("{at_least}{:.0}", e.confies_secs / secs))
            }
            None => ("not reached".to_owned(), "–".to_owned()),
        };
        let _ = writeln!(text, "| {:.2} | {:.1} | {splat} | {times} |", e.psnr_db, e.confies_secs);
    }
    text
}

fn plot(path: &std::path::Path, report: &Report) -> Result<(), Failure> {
    let fields =
        [("confies", &report.confies, RGBColor(214, 80, 40)), ("splat", &report.splat, RGBColor(31, 119, 180))];
    let rows = || report.confies.iter().chain(&report.splat);
    let (first, last) = rows().map(|r| r.wall_secs).fold((f64::MAX, 1.0), |(a, b): (f64, f64), t| (a.min(t), b.max(t)));
    panels::write(path, SHOWN, |area, part| {
        let values = || rows().map(|r| of(r, part)).filter(|v| v.is_finite());
        let (low, high) = values().fold((f64::MAX, f64::MIN), |(a, b), v| (a.min(v), b.max(v)));
        if low > high {
            return Ok(());
        }
        let mut chart = ChartBuilder::on(area)
            .caption(if part == SHOWN[0] { "Whole pictures" } else { "AU regions" }, ("sans-serif", 18))
            .margin(12)
            .x_label_area_size(40)
            .y_label_area_size(50)
            .build_cartesian_2d((first * 0.8..last * 1.25).log_scale(), low - 0.5..high + 0.5)?;
        chart
            .configure_mesh()
            .x_desc("seconds on the wall, loading and saving included")
            .y_desc("mean PSNR, dB")
            .draw()?;
        for (name, rows, color) in fields {
            let points: Vec<(f64, f64)> =
                rows.iter().map(|r| (r.wall_secs, of(r, part))).filter(|p| p.1.is_finite()).collect();
            chart
                .draw_series(LineSeries::new(points.iter().copied(), color.stroke_width(2)))?
                .label(name)
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], color.stroke_width(2)));
            chart.draw_series(points.iter().map(|p| Circle::new(*p, 3, color.filled())))?;
        }
        chart
            .configure_series_labels()
            .position(SeriesLabelPosition::LowerRight)
            .background_style(WHITE.mix(0.8))
            .border_style(BLACK.mix(0.3))
            .draw()?;
        Ok(())
    })?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(name: &str, wall_secs: f64, psnr: f64) -> Row {
        Row {
            name: name.to_owned(),
            asked: Vec::new(),
            parameters: 0,
            steps: 0,
            wall_secs,
            cpu_secs: 0.0,
            peak_mib: 0.0,
            train_psnr_db: 0.0,
            means: std::collections::BTreeMap::new(),
            psnr_db: [("all".to_owned(), psnr)].into(),
        }
    }

    #[test]
    fn equal_error_is_read_off_the_splat_curve() {
        let splat = [row("splat-1s", 1.0, 20.0), row("splat-100s", 100.0, 30.0)];
        let confies = [row("confies-1m", 60.0, 15.0), row("confies-2m", 120.0, 25.0), row("confies-1h", 3600.0, 31.0)];
        let equal = equal_error(&confies, &splat);
        assert_eq!((equal[0].splat_secs, equal[0].bound), (Some(1.0), true));
        assert!((equal[1].splat_secs.unwrap() - 10.0).abs() < 1e-9 && !equal[1].bound);
        assert_eq!(equal[2].splat_secs, None);
    }
}
