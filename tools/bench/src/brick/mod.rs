//! `bench-brick`: run time against error of the brick field on one dataset with true pictures.

mod burn;
pub(crate) mod fits;
mod pictures;
mod plot;

use std::path::PathBuf;

use clap::Parser;
use risorius_brick::Skips;
use risorius_brick::floor::Floor;
use risorius_console::{Common, CommonArgs, Console, Failure};
use risorius_formats::{FormatError, atomic};
use serde::Serialize;

/// Run time against error of the brick field: fits by their time, pictures, edits, and every skip on and off
#[derive(Debug, Parser)]
#[command(
    name = "bench-brick",
    version,
    about,
    after_help = "Example:\n  bench-brick --dataset work/bench/dataset --views work/capture/test/views.json --work work/brick"
)]
pub struct Cli {
    #[command(flatten)]
    common: CommonArgs,
    /// A dataset made by `dataset build`
    #[arg(long, value_name = "DIR", required_unless_present = "run")]
    dataset: Option<PathBuf>,
    /// Only times pictures of this run; nothing is fitted
    #[arg(long, value_name = "RUN", conflicts_with_all = ["dataset", "budgets", "skip_steps"])]
    run: Option<PathBuf>,
    /// Times a step of the run's avatar through Burn instead: the operation, its gradient, Burn's Adam on whole tensors
    #[arg(long, requires = "run", conflicts_with_all = ["views", "work"])]
    burn: bool,
    /// Views with true pictures
    #[arg(long, value_name = "VIEWS.json", required_unless_present = "burn")]
    views: Option<PathBuf>,
    /// Where runs, brick.csv and brick.svg go
    #[arg(long, value_name = "DIR", required_unless_present = "burn")]
    work: Option<PathBuf>,
    /// Times of the fits; the last one's avatar is rendered
    #[arg(long, value_name = "TIMES", value_delimiter = ',', default_value = "30s,1m,2m")]
    budgets: Vec<String>,
    /// Steps of the fits that leave out one skip each; 0 for none
    #[arg(long, value_name = "N", default_value_t = 0)]
    skip_steps: u64,
    /// Every so many views is used for timing pictures
    #[arg(long, value_name = "N", default_value_t = 6)]
    every: usize,
}

impl Common for Cli {
    fn common(&self) -> &CommonArgs {
        &self.common
    }
}

/// Everything that was measured.
#[derive(Debug, Serialize)]
struct Report {
    floor: Floor,
    floor_fit_samples_per_sec: f64,
    fits: Vec<fits::Fit>,
    pictures: pictures::Pictures,
    skipped_fits: Vec<fits::Fit>,
}

/// Measures and writes everything.
pub fn run(cli: &Cli, console: &Console) -> Result<(), Failure> {
    if let (true, Some(run)) = (cli.burn, &cli.run) {
        let step = burn::measure(run)?;
        console.finish(&step, &step.table());
        return Ok(());
    }
    let (Some(work), Some(views)) = (&cli.work, &cli.views) else {
        return Err(Failure::usage("name `--work` and `--views`"));
    };
    std::fs::create_dir_all(work).map_err(|e| FormatError::io(work, "create", &e))?;
    let floor = Floor::measure();
    let Some(dataset) = &cli.dataset else {
        let Some(run) = &cli.run else { return Err(Failure::usage("name a `--dataset` or a `--run`")) };
        let pictures = pictures::measure(run, views, cli.every)?;
        console.finish(&pictures, &pictures.table());
        return Ok(());
    };
    let measured = |name: &str, length: [&str; 2], skip: Option<&str>| {
        console.say(&format!("fit {name}: {} {}", length[0], length[1]));
        fits::measure(work, views, dataset, name, length, skip, &floor)
    };
    let mut fits = Vec::new();
    for budget in &cli.budgets {
        fits.push(measured(&format!("fit-{budget}"), ["--budget", budget], None)?);
    }
    let Some(last) = cli.budgets.last() else { return Err(Failure::usage("`--budgets` names no time")) };
    let pictures = pictures::measure(&work.join(format!("fit-{last}")), views, cli.every)?;
    let mut skipped_fits = Vec::new();
    if cli.skip_steps > 0 {
        let steps = cli.skip_steps.to_string();
        skipped_fits.push(measured("all-skips", ["--steps", &steps], None)?);
        // `unchanged` is a skip of edits: no fit has it.
        for skip in Skips::NAMES.into_iter().filter(|skip| *skip != "unchanged") {
            skipped_fits.push(measured(&format!("no-{skip}"), ["--steps", &steps], Some(skip))?);
        }
    }
    let report = Report { floor_fit_samples_per_sec: floor.fit_samples_per_sec(), floor, fits, pictures, skipped_fits };
    let rows: Vec<&fits::Fit> = report.fits.iter().chain(&report.skipped_fits).collect();
    atomic::write_file(work.join("brick.csv"), fits::csv(&rows).as_bytes())?;
    let svg = plot::svg(&report.fits).map_err(Failure::input)?;
    atomic::write_file(work.join("brick.svg"), svg.as_bytes())?;
    console.finish(&report, &words(&report));
    Ok(())
}

fn words(report: &Report) -> String {
    let f = &report.floor;
    let mut lines = vec![format!(
        "floor: {} threads, {:.0} GFLOP/s, {:.0} M look-ups/s: {:.2} M samples/s of fitting at best",
        f.threads,
        f.gflops,
        f.million_look_ups_per_sec,
        report.floor_fit_samples_per_sec * 1e-6
    )];
    lines.push(fits::table(&report.fits));
    lines.push(report.pictures.table());
    if !report.skipped_fits.is_empty() {
        lines.push(fits::table(&report.skipped_fits));
    }
    lines.join("\n\n")
}
