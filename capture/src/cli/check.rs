//! `capture check`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use risorius_console::{Console, Failure};
use risorius_formats::{Reporter, Take};

use crate::check::{CheckReport, Level, check, word, write_page};
use crate::sheet::write_sheet;

/// Options of `capture check`.
#[derive(Args, Debug)]
#[command(
    after_help = "Examples:\n  capture check takes/face --report face.html\n  capture check takes/face --require fair -q && tracker run takes/face\n\n\
    The orbit is judged once the take is tracked: run `tracker run TAKE`, then this again."
)]
pub(super) struct CheckArgs {
    /// The take's folder.
    #[arg(value_name = "TAKE")]
    take: PathBuf,
    /// Also write a contact sheet of 24 frames.
    #[arg(long, value_name = "FILE.png")]
    sheet: Option<PathBuf>,
    /// Also write a page with the verdicts, charts over time and the contact sheet.
    #[arg(long, value_name = "FILE.html")]
    report: Option<PathBuf>,
    /// Fail (exit status 1) when the take is worse than this.
    #[arg(long, value_name = "LEVEL")]
    require: Option<Required>,
}

/// What a take has to be.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum Required {
    /// Everything as it should be.
    Good,
    /// Nothing that is likely to spoil the result.
    Fair,
}

pub(super) fn run(args: &CheckArgs, console: &Console) -> Result<(), Failure> {
    let take = Take::open(&args.take)?;
    console.stage("checking the media", None);
    let report = check(&take, console)?;
    if let Some(path) = &args.sheet {
        console.stage("drawing the contact sheet", None);
        write_sheet(&take, path)?;
    }
    if let Some(path) = &args.report {
        console.stage("writing the report", None);
        write_page(&take, &report, path)?;
    }
    console.finish(&report, &text(&report));
    let worst = match args.require {
        Some(Required::Good) => Level::Good,
        Some(Required::Fair) => Level::Fair,
        None => Level::Poor,
    };
    if report.overall <= worst {
        return Ok(());
    }
    let topics: Vec<_> = report.verdicts.iter().filter(|v| v.level > worst).map(|v| v.topic).collect();
    let message = format!("{}: is {}: {}", args.take.display(), word(report.overall), topics.join(", "));
    Err(Failure::input(message).with_hint("the verdicts say what to do; record again, or go on without `--require`"))
}

fn text(report: &CheckReport) -> String {
    let mut lines: Vec<String> =
        report.verdicts.iter().map(|v| format!("{}  {:<11}  {}", word(v.level), v.topic, v.message)).collect();
    lines.push(format!("overall: {}", word(report.overall)));
    lines.join("\n")
}
