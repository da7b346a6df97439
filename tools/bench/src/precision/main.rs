//! The precision ladder: each stage in f64, f32, bfloat16 and half precision, its error against run time.
//!
//! One readable generic text per stage is run in every precision, so that a step down the ladder changes nothing but the
//! numbers; beside it stand the kernels that fits and renders really use. Sixteen-bit arithmetic is emulated on the CPU
//! (each operation is rounded), so its run time says nothing of a GPU: its error does.

mod ladder;
mod numbers;
mod plot;

use std::fmt::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use risorius_console::{Common, CommonArgs, Console, Failure};
use risorius_formats::atomic;
use serde::Serialize;

/// Error against run time of every stage in f64, f32, bf16 and f16
#[derive(Debug, Parser)]
#[command(name = "bench-precision", version, about, after_help = "Example:\n  bench-precision --out work/precision")]
struct Cli {
    #[command(flatten)]
    common: CommonArgs,
    /// Where precision.csv and precision.svg go
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// How often each rung is timed; the fastest counts
    #[arg(long, default_value_t = 5)]
    rounds: u32,
}

impl Common for Cli {
    fn common(&self) -> &CommonArgs {
        &self.common
    }
}

/// One stage in one precision.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Rung {
    /// The stage.
    pub(crate) stage: &'static str,
    /// The numbers, or the kernel.
    pub(crate) numbers: &'static str,
    /// Largest error, as a share of the largest value of the f64 result.
    pub(crate) max_error: f64,
    /// Root mean square error, likewise.
    pub(crate) rms_error: f64,
    /// Values that are none where the f64 result has one.
    pub(crate) lost: usize,
    /// Run time per value of the result, nanoseconds, all threads together.
    pub(crate) nanos: f64,
}

fn main() -> ExitCode {
    risorius_console::run(|cli: &Cli, console| bench(cli, console))
}

fn bench(cli: &Cli, console: &Console) -> Result<(), Failure> {
    let rungs = ladder::climb(cli.rounds);
    let mut csv = String::from("stage,numbers,max_error,rms_error,lost,nanos_per_value\n");
    let mut table = String::from("stage              numbers          max error   rms error   lost  ns/value\n");
    for r in &rungs {
        let Rung { stage, numbers, max_error, rms_error, lost, nanos } = r;
        let _ = writeln!(csv, "{stage},{numbers},{max_error:e},{rms_error:e},{lost},{nanos:.3}");
        let _ =
            writeln!(table, "{stage:<18} {numbers:<16} {max_error:>9.1e}   {rms_error:>9.1e}  {lost:>5}  {nanos:>8.2}");
    }
    let failed = |e: risorius_formats::FormatError| Failure::input(e.to_string());
    std::fs::create_dir_all(&cli.out).map_err(|e| Failure::input(format!("{}: {e}", cli.out.display())))?;
    atomic::write_file(cli.out.join("precision.csv"), csv.as_bytes()).map_err(failed)?;
    plot::write(&cli.out.join("precision.svg"), &rungs).map_err(failed)?;
    console.finish(&rungs, &table);
    Ok(())
}
