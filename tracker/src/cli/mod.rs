//! The command line of `tracker`: glue only.

mod check;
mod import;
mod live;
mod poses;
mod run;

use std::path::Path;

use clap::{Parser, Subcommand};
use risorius_console::{Common, CommonArgs, Console, Failure, Inputs};

use crate::error::TrackerError;

/// Landmarks, action units, head and camera poses of a take.
#[derive(Parser, Debug)]
#[command(name = "tracker", version, about, propagate_version = true, after_help = EXAMPLES)]
pub struct Cli {
    #[command(flatten)]
    common: CommonArgs,
    #[command(subcommand)]
    command: Command,
}

const EXAMPLES: &str = "Example:
  tracker run takes/ada
  tracker poses takes/ada
  tracker check takes/ada";

impl Common for Cli {
    fn common(&self) -> &CommonArgs {
        &self.common
    }
}

#[derive(Subcommand, Debug)]
enum Command {
    Run(run::RunArgs),
    Import(import::ImportArgs),
    Live(live::LiveArgs),
    Poses(poses::PosesArgs),
    Check(check::CheckArgs),
}

/// Runs one command.
pub fn run(cli: &Cli, console: &Console) -> Result<(), Failure> {
    match &cli.command {
        Command::Run(args) => run::run(args, console),
        Command::Import(args) => import::run(args, console),
        Command::Live(args) => live::run(args, console),
        Command::Poses(args) => poses::run(args, console),
        Command::Check(args) => check::run(args, console),
    }
}

/// The value of an option that has to be a number above 0.
fn above_zero(option: &str, unit: &str, value: Option<f64>) -> Result<Option<f64>, Failure> {
    match value {
        Some(v) if !(v.is_finite() && v > 0.0) => {
            Err(Failure::usage(format!("`--{option}` has to be above 0 {unit}, not {v}")))
        }
        value => Ok(value),
    }
}

/// Says what is wrong with a take's folder before anything is locked or made in it.
fn need_take(take: &Path) -> Result<(), Failure> {
    if take.is_dir() { Ok(()) } else { Ok(risorius_formats::Take::open(take).map(drop)?) }
}

/// What every stage reads of a take, and `more` files in it. `take.toml` holds the hash of the video.
fn take_inputs(take: &Path, more: &[&str]) -> Inputs {
    let names = ["take.toml", "frames.csv"].iter().chain(more);
    names.fold(Inputs::default(), |inputs, name| inputs.file(*name, take.join(name)))
}

/// Tells a bad take from an installation that lacks something, unless the user `named` what is lacking.
fn failure(error: TrackerError, named: bool) -> Failure {
    let lacks = match &error {
        TrackerError::NoRuntime { .. } | TrackerError::Runtime { .. } | TrackerError::ColmapMissing { .. } => true,
        TrackerError::Format(e) => e.path().is_some_and(|p| p.starts_with(crate::models::default_dir())),
        _ => false,
    };
    let failure = Failure::from(error);
    if lacks && !named { failure.of_installation() } else { failure }
}

/// `12–15, 20, …`, the longest list that still fits a line.
fn runs_in_words(runs: &[[u32; 2]]) -> String {
    let one = |r: &[u32; 2]| if r[0] == r[1] { r[0].to_string() } else { format!("{}–{}", r[0], r[1]) };
    let mut text = runs.iter().take(8).map(one).collect::<Vec<_>>().join(", ");
    if runs.len() > 8 {
        text += ", …";
    }
    text
}

/// The ranges of the AUs as lines of text.
fn quality_in_words(q: &crate::quality::TrackQuality) -> String {
    use std::fmt::Write as _;
    let mut text = format!("frames       {} valid of {}", q.valid_frames, q.frames);
    if !q.lost_runs.is_empty() {
        let _ = write!(text, "; lost {}: {}", q.lost_frames, runs_in_words(&q.lost_runs));
    }
    if let Some(jitter) = q.landmark_jitter_px {
        let size = q.outer_eye_distance_px.map_or(String::new(), |d| format!(" (eye distance {d:.0} px)"));
        let _ = write!(text, "\nlandmarks    noise {jitter:.2} px{size}");
    }
    if let Some(jitter) = q.au_jitter {
        let _ = write!(text, "\nAUs          noise {jitter:.2}");
    }
    for u in &q.units {
        if let (Some(min), Some(median), Some(p99), Some(max)) = (u.min, u.median, u.p99, u.max) {
            let still = if u.moves { "" } else { "  never moves" };
            let sure = u
                .sureness
                .filter(|_| p99 >= crate::sureness::MOVES_FROM)
                .map_or_else(String::new, |s| format!("  {}", s.word()));
            let name = u.unit.to_string();
            let _ = write!(text, "\n  {name:<11}{min:.2} … {max:.2}, median {median:.2}, 99 % {p99:.2}{still}{sure}");
        }
    }
    if q.saturated_share > 0.0 {
        let _ = write!(
            text,
            "\nsaturated    an AU stands at the end of its scale in {:.1} % of the frames",
            100.0 * q.saturated_share
        );
    }
    if let Some(names) = crate::sureness::still(&q.units) {
        let _ = write!(text, "\nhardly move  {names}: nothing to judge them by");
    }
    if let Some(names) = crate::sureness::not_sure(&q.units) {
        let _ = write!(
            text,
            "\nnot sure     {names}: look at their peaks (`tracker check --report`) before you build on them"
        );
    }
    text
}
