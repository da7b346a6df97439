//! `capture check`.

use std::path::PathBuf;

use clap::Args;
use risorius_console::{Console, Failure};
use risorius_formats::{Reporter, Take};

use crate::check::{CheckReport, Level, check};
use crate::sheet::write_sheet;

/// Options of `capture check`.
#[derive(Args, Debug)]
#[command(after_help = "Example:\n  capture check takes/face --sheet face.png")]
pub(super) struct CheckArgs {
    /// The take's folder.
    #[arg(value_name = "TAKE")]
    take: PathBuf,
    /// Also write a contact sheet of 24 frames.
    #[arg(long, value_name = "FILE.png")]
    sheet: Option<PathBuf>,
}

pub(super) fn run(args: &CheckArgs, console: &Console) -> Result<(), Failure> {
    let take = Take::open(&args.take)?;
    console.stage("checking the media", None);
    let report = check(&take, console)?;
    if let Some(path) = &args.sheet {
        console.stage("drawing the contact sheet", None);
        write_sheet(&take, path)?;
    }
    console.finish(&report, &text(&report));
    Ok(())
}

fn text(report: &CheckReport) -> String {
    let word = |level| match level {
        Level::Good => "good",
        Level::Fair => "fair",
        Level::Poor => "poor",
    };
    let mut lines: Vec<String> =
        report.verdicts.iter().map(|v| format!("{}  {:<9}  {}", word(v.level), v.topic, v.message)).collect();
    lines.push(format!("overall: {}", word(report.overall)));
    lines.join("\n")
}
