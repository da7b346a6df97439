//! `bench-splat`: run time against error of the Gaussian field on one dataset with true pictures.

pub(crate) mod fits;
mod pictures;
mod plot;

use std::path::PathBuf;

use clap::Parser;
use risorius_console::{Common, CommonArgs, Console, Failure};
use risorius_formats::{FormatError, atomic};
use risorius_splat::Skips;
use serde::Serialize;

/// Run time against error of the Gaussian field: fits by their time, pictures, edits, and every skip on and off
#[derive(Debug, Parser)]
#[command(
    name = "bench-splat",
    version,
    about,
    after_help = "Example:\n  bench-splat --dataset work/bench/dataset --views work/capture/test/views.json --work work/splat\n\nWrites splat.csv and splat.svg into the folder of `--work`."
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
    /// Views with true pictures
    #[arg(long, value_name = "VIEWS.json")]
    views: PathBuf,
    /// Where runs, splat.csv and splat.svg go
    #[arg(long, value_name = "DIR", required_unless_present = "run")]
    work: Option<PathBuf>,
    /// Times of the fits; the last one's avatar is rendered
    #[arg(long, value_name = "TIMES", value_delimiter = ',', default_value = "15s,30s,1m,2m")]
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
    fits: Vec<fits::Fit>,
    /// At the size that was fitted, and at twice that.
    pictures: Vec<pictures::Pictures>,
    skipped_fits: Vec<fits::Fit>,
}

/// Measures and writes everything.
pub fn run(cli: &Cli, console: &Console) -> Result<(), Failure> {
    if let Some(run) = &cli.run {
        let pictures = pictures::measure(run, &cli.views, cli.every)?;
        console.finish(&pictures, &tables(&pictures));
        return Ok(());
    }
    let (Some(work), Some(dataset)) = (&cli.work, &cli.dataset) else {
        return Err(Failure::usage("name `--work` and `--dataset`"));
    };
    std::fs::create_dir_all(work).map_err(|e| FormatError::io(work, "create", &e))?;
    let measured = |name: &str, length: [&str; 2], skip: Option<&str>| {
        console.say(&format!("fit {name}: {} {}", length[0], length[1]));
        fits::measure(work, &cli.views, dataset, name, length, skip)
    };
    let mut fits = Vec::new();
    for budget in &cli.budgets {
        fits.push(measured(&format!("fit-{budget}"), ["--budget", budget], None)?);
    }
    let Some(last) = cli.budgets.last() else { return Err(Failure::usage("`--budgets` names no time")) };
    let pictures = pictures::measure(&work.join(format!("fit-{last}")), &cli.views, cli.every)?;
    let mut skipped_fits = Vec::new();
    if cli.skip_steps > 0 {
        let steps = cli.skip_steps.to_string();
        skipped_fits.push(measured("all-skips", ["--steps", &steps], None)?);
        // `unchanged` is a skip of edits: no fit has it.
        for skip in Skips::NAMES.into_iter().filter(|skip| *skip != "unchanged") {
            skipped_fits.push(measured(&format!("no-{skip}"), ["--steps", &steps], Some(skip))?);
        }
    }
    let report = Report { fits, pictures, skipped_fits };
    let rows: Vec<&fits::Fit> = report.fits.iter().chain(&report.skipped_fits).collect();
    atomic::write_file(work.join("splat.csv"), fits::csv(&rows).as_bytes())?;
    let svg = plot::svg(&report.fits).map_err(Failure::input)?;
    atomic::write_file(work.join("splat.svg"), svg.as_bytes())?;
    console.finish(&report, &words(&report));
    Ok(())
}

fn tables(pictures: &[pictures::Pictures]) -> String {
    pictures.iter().map(pictures::Pictures::table).collect::<Vec<_>>().join("\n\n")
}

fn words(report: &Report) -> String {
    let mut parts = vec![fits::table(&report.fits), tables(&report.pictures)];
    if !report.skipped_fits.is_empty() {
        parts.push(fits::table(&report.skipped_fits));
    }
    parts.join("\n\n")
}
