//! `bench-all`: every stage at several settings, in one report: error against run time, memory, how cost grows with frames,
//! AUs, resolution and Gaussians; and what has become dearer since a baseline.
//!
//! ```text
//! cases (a captured world and command lines) → measure (child processes) → report.csv, *.svg, report.html
//!                                                                       ↘ compare with baseline.json
//! ```
//!
//! A shared machine's clock says little. Cost is CPU time in units of a fixed piece of work that is measured in the same
//! run, and, with `--instructions`, instructions as valgrind counts them.

mod calibrate;
mod captures;
mod cases;
mod compare;
mod counted;
mod plot;
mod report;
mod score;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Parser;
use risorius_bench::child;
use risorius_console::{Common, CommonArgs, Console, Failure};
use risorius_formats::FormatError;
use serde::{Deserialize, Serialize};

/// Time, memory, error and growth of every stage, and what has become dearer
#[derive(Debug, Parser)]
#[command(
    name = "bench-all",
    version,
    about,
    after_help = "Examples:\n  bench-all --work work/bench --quick\n  bench-all --work work/bench --quick --compare tools/bench/baseline.json\n  bench-all --work work/bench --measured --compare tools/bench/baseline.json\n  bench-all --work work/bench --capture captures/ada --colmap\nA new baseline, on a quiet machine:\n  bench-all --work work/bench --quick --instructions --write-baseline tools/bench/baseline.json"
)]
struct Cli {
    #[command(flatten)]
    common: CommonArgs,
    /// Where everything goes; what an earlier run made there is replaced
    #[arg(long, value_name = "DIR", required_unless_present = "calibrate")]
    work: Option<PathBuf>,
    /// A capture with truth in the layout of `synth`, instead of small ones made on the spot
    #[arg(long, value_name = "DIR")]
    capture: Option<PathBuf>,
    /// Small pictures and few steps: two minutes on two idle cores
    #[arg(long)]
    quick: bool,
    /// Also find cameras with the real COLMAP
    #[arg(long)]
    colmap: bool,
    /// Also count instructions of short commands with valgrind's callgrind, on one thread
    #[arg(long)]
    instructions: bool,
    /// Only stages with this in their name, such as `fit`; what they need is made all the same
    #[arg(long, value_name = "WORD")]
    only: Option<String>,
    /// Name what costs more than in this baseline; exit status 1 if something does
    #[arg(long, value_name = "FILE")]
    compare: Option<PathBuf>,
    /// How much more CPU time may be, against the baseline, on a machine that others use as well
    #[arg(long, value_name = "FACTOR", default_value_t = 1.5)]
    slack: f64,
    /// Measure nothing: take the report of the last run in `--work`
    #[arg(long, conflicts_with_all = ["quick", "capture", "colmap", "instructions", "only"])]
    measured: bool,
    /// Write a baseline of this run
    #[arg(long, value_name = "FILE")]
    write_baseline: Option<PathBuf>,
    /// Only do the fixed piece of work that is the unit of cost
    #[arg(long, hide = true)]
    calibrate: bool,
}

impl Common for Cli {
    fn common(&self) -> &CommonArgs {
        &self.common
    }
}

/// One measured command.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Row {
    /// `stage/setting`, such as `fit/steps-200`.
    pub(crate) name: String,
    /// The command line, without the machine's folders.
    pub(crate) command: String,
    /// What is varied, and its value: frames, AUs, pixels, Gaussians.
    pub(crate) grows_with: Vec<(String, f64)>,
    /// Seconds on the wall.
    pub(crate) wall_secs: f64,
    /// CPU seconds of all cores.
    pub(crate) cpu_secs: f64,
    /// `cpu_secs` in units of the calibration.
    pub(crate) cost: f64,
    /// Most memory it held.
    pub(crate) peak_mib: f64,
    /// How far the result is from the truth: what is measured, and the value.
    pub(crate) error: Option<(String, f64)>,
    /// Instructions, where they were counted.
    pub(crate) instructions: Option<u64>,
}

/// Of the layout of reports and baselines.
pub(crate) const VERSION: u32 = 2;

/// The whole run, and a baseline.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Report {
    /// Of this layout.
    pub(crate) version: u32,
    /// The processor, as it calls itself.
    pub(crate) processor: String,
    /// Threads.
    pub(crate) threads: usize,
    /// CPU seconds of the unit of cost.
    pub(crate) unit_cpu_secs: f64,
    /// Whether it was the quick form.
    pub(crate) quick: bool,
    /// Every command.
    pub(crate) rows: Vec<Row>,
}

fn main() -> ExitCode {
    risorius_console::run(run)
}

fn run(cli: &Cli, console: &Console) -> Result<(), Failure> {
    let Some(work) = cli.work.as_ref().filter(|_| !cli.calibrate) else {
        let sum = calibrate::work();
        console.finish(&sum, &format!("{sum}"));
        return Ok(());
    };
    // Read first: a wrong path or form should not cost a run.
    let baseline = cli.compare.as_deref().map(compare::read).transpose()?;
    let earlier = cli.measured.then(|| compare::read(&work.join(report::JSON))).transpose()?;
    if let Some(baseline) = &baseline {
        compare::check_comparable(earlier.as_ref().map_or(cli.quick, |report| report.quick), baseline)?;
    }
    let report = match earlier {
        Some(report) => report,
        None => measured(cli, work, console)?,
    };
    if let Some(path) = &cli.write_baseline {
        compare::write(&report, path)?;
    }
    let verdict = baseline.map(|baseline| compare::compare(&report, &baseline, cli.slack));
    let mut words = vec![report::table(&report)];
    words.extend(verdict.as_ref().map(compare::Verdict::words));
    words.push(format!("look at {}", work.join("report.html").display()));
    console.finish(&report, &words.join("\n\n"));
    match verdict {
        Some(verdict) if !verdict.dearer.is_empty() => {
            Err(Failure::input(format!("{} commands cost more than in the baseline", verdict.dearer.len()))
                .with_hint("if that is meant, write a new baseline with `--write-baseline`"))
        }
        _ => Ok(()),
    }
}

/// Runs everything that is asked for, and leaves the report in `work`.
fn measured(cli: &Cli, work: &Path, console: &Console) -> Result<Report, Failure> {
    std::fs::create_dir_all(work).map_err(|e| FormatError::io(work, "create", &e))?;
    let work = std::path::absolute(work).map_err(|e| FormatError::io(work, "find", &e))?;
    let unit_cpu_secs = unit(&work)?;
    let mut bench = cases::Bench::new(cli, &work, unit_cpu_secs, console)?;
    bench.run_all()?;
    let report = Report {
        version: VERSION,
        processor: calibrate::processor(),
        threads: std::thread::available_parallelism().map_or(1, usize::from),
        unit_cpu_secs,
        quick: cli.quick,
        rows: bench.rows,
    };
    report::write(&report, &work)?;
    Ok(report)
}

/// CPU seconds of the unit of cost: the least of three, since others can only add to it.
fn unit(work: &Path) -> Result<f64, Failure> {
    let mut least = f64::INFINITY;
    for _ in 0..3 {
        least = least.min(child::run("bench-all", &["--calibrate"], work)?.cpu_secs);
    }
    Ok(least)
}
