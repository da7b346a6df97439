//! `dataset stats` and `dataset verify`.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use risorius_console::{Console, Failure};
use risorius_formats::pose_report::json_error;
use risorius_formats::{ErrorKind, FormatError};

use crate::{BuildOptions, Report, compare, corpus, plot, survey, tables, verify};

/// Show how a dataset was chosen and how even its AU intensities are.
///
/// Of several datasets the chosen frames are counted together, and a corpus (see `dataset collect`) is summed up: subjects,
/// AUs, worst takes, drift of ICC. Either way one take is in memory at a time.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  dataset stats datasets/ada --plot ada.svg\n  dataset stats datasets/ada --compare\n  dataset stats datasets/*\n  dataset stats corpus"
)]
pub(super) struct StatsArgs {
    /// Folders of datasets made by `dataset build` or `dataset import`, or of one corpus
    #[arg(required = true, value_name = "DATASET")]
    datasets: Vec<PathBuf>,
    /// Also draw the intensities before and after
    #[arg(long, value_name = "FILE.svg|FILE.png")]
    plot: Option<PathBuf>,
    /// Compare ways of choosing as many frames from the same candidates, in one table
    #[arg(long)]
    compare: bool,
    /// How many frames the compared ways choose [default: as many as the dataset has]
    #[arg(long, value_name = "N", requires = "compare")]
    frames: Option<usize>,
}

/// Open a dataset as a stranger would and list every problem.
///
/// Plain Nerfies, HyperNeRF and CoNeRF folders, transforms.json, COLMAP and Parquet exports can be checked, too. Exit status 1 if there is any problem; with --json
/// the document lists them as `problems`, each with `path` and `message`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  dataset verify datasets/ada")]
pub(super) struct VerifyArgs {
    /// Folder of the dataset
    dataset: PathBuf,
}

pub(super) fn stats(args: &StatsArgs, console: &Console) -> Result<(), Failure> {
    if args.compare {
        return compare(args, console);
    }
    let [dataset] = &args.datasets[..] else {
        if args.plot.is_some() {
            return Err(Failure::usage("`--plot` draws one dataset").with_hint("name one dataset"));
        }
        args.datasets.iter().try_for_each(|d| check_folder(d))?;
        let survey = survey::survey(&args.datasets, console)?;
        console.finish(&survey, &survey_table(&survey));
        return Ok(());
    };
    if corpus::is_corpus(dataset) {
        return super::corpus::stats(dataset, console);
    }
    let path = dataset.join("report").join("stats.json");
    let report = read_report(dataset, &path)?;
    if let Some(path) = &args.plot {
        plot::write_distribution(path, &report)?;
    }
    console.finish(&report, &table(&report));
    Ok(())
}

fn compare(args: &StatsArgs, console: &Console) -> Result<(), Failure> {
    let [dataset] = &args.datasets[..] else {
        return Err(Failure::usage("`--compare` looks at one dataset").with_hint("name one dataset"));
    };
    check_folder(dataset)?;
    let rows = tables::read(dataset)?;
    let chosen = rows.takes.iter().flat_map(|t| &t.frames).filter(|f| f.id.is_some()).count();
    let compared = compare::compare(&rows, args.frames.unwrap_or(chosen), &BuildOptions::default());
    let mut text = String::from(
        "| choice | frames | block entropy | entropy per AU | variation | above rest | empty | cells | mean gap | largest gap | sharpness | mean abs r |\n|---|---|---|---|---|---|---|---|---|---|---|---|",
    );
    for c in &compared {
        let (e, v) = (&c.evenness, &c.coverage);
        let _ = write!(
            text,
            "\n| {} | {} | {:.3} | {:.3} | {:.2} | {:.2} | {} | {}/{} | {:.2}° | {:.1}° | {:.2} | {:.3} |",
            c.choice,
            c.frames,
            e.block_entropy,
            e.entropy,
            e.coefficient_of_variation,
            e.raised_variation,
            e.empty_blocks,
            v.cells_chosen,
            v.cells,
            v.mean_gap_deg,
            v.largest_gap_deg,
            c.sharpness_rank,
            c.correlation
        );
    }
    console.finish(&compared, &text);
    Ok(())
}

fn survey_table(survey: &survey::Survey) -> String {
    let mut text = String::new();
    for d in &survey.datasets {
        let who = if d.subjects.is_empty() { "subject not stated".to_owned() } else { d.subjects.join(", ") };
        let _ = writeln!(
            text,
            "{}: {} chosen of {} trusted frames, {} takes, {} active AUs; {who}",
            d.dataset.display(),
            d.chosen,
            d.trusted,
            d.takes,
            d.active
        );
    }
    let _ = writeln!(text, "\n{} chosen frames in {} datasets", survey.chosen, survey.datasets.len());
    let _ = writeln!(text, "{:<5} {:<22} {:>9}  chosen per intensity", "AU", "name", "active in");
    for (unit, counts) in &survey.levels {
        let counts: Vec<String> = counts.iter().map(|c| format!("{c:>6}")).collect();
        let active = survey.active_in.get(unit).copied().unwrap_or(0);
        let _ = writeln!(text, "{:<5} {:<22} {active:>9}  {}", unit.to_string(), unit.facs_name(), counts.join(" "));
    }
    text.trim_end().to_owned()
}

fn read_report(dataset: &Path, path: &Path) -> Result<Report, FormatError> {
    check_folder(dataset)?;
    let bytes = std::fs::read(path).map_err(|e| {
        FormatError::io(path, "read", &e)
            .with_hint("only datasets made by `dataset build` have these numbers; try `dataset verify`")
    })?;
    serde_json::from_slice(&bytes).map_err(|e| json_error(&e).in_file(path))
}

fn check_folder(dataset: &Path) -> Result<(), FormatError> {
    if dataset.is_dir() {
        return Ok(());
    }
    let message = if dataset.exists() { "is not a folder" } else { "does not exist" };
    Err(FormatError::new(ErrorKind::Missing, message).in_file(dataset).with_hint("name the folder of a dataset"))
}

fn table(report: &Report) -> String {
    let mut text = String::new();
    for take in &report.takes {
        let c = take.counts;
        let _ = writeln!(
            text,
            "take {}: {} frames at {:.2} per second; {} valid, {} lost, {} unsure, {} incomplete; {} posed",
            take.name, c.frames, take.fps, c.valid, c.lost, c.low_confidence, c.incomplete, take.posed
        );
    }
    let _ = writeln!(
        text,
        "{} usable frames, {} chosen, {} of them without masks",
        report.candidates, report.chosen, report.chosen_without_masks
    );
    for (name, e) in
        [("before", report.evenness_before), ("uniform", report.evenness_uniform), ("chosen", report.evenness_after)]
    {
        let _ = writeln!(
            text,
            "{name:>8}: variation {:.3} ({:.3} above rest), entropy {:.3} of blocks, {:.3} per AU, {} empty blocks",
            e.coefficient_of_variation, e.raised_variation, e.block_entropy, e.entropy, e.empty_blocks
        );
    }
    let c = &report.coverage;
    let _ = writeln!(
        text,
        "   views: {} of {} cells, yaw {:.0}° to {:.0}°, pitch {:.0}° to {:.0}°, largest gap {:.1}°",
        c.cells_chosen, c.cells, c.yaw_deg[0], c.yaw_deg[1], c.pitch_deg[0], c.pitch_deg[1], c.largest_gap_deg
    );
    let s = &report.split;
    let _ = writeln!(text, "   split: {}, {} for fitting, {} held out", s.kind.name(), s.train, s.val);
    for flag in &report.flags {
        let _ = writeln!(text, "    look: {}", flag.message);
    }
    let _ = writeln!(
        text,
        "\n{:<5} {:<22} {:<6} {:>5} {:>5} {:>7}  chosen per intensity",
        "AU", "name", "region", "min", "max", "neutral"
    );
    for a in &report.attributes {
        let counts: Vec<String> = a.histogram_after.iter().map(|c| format!("{c:>4}")).collect();
        let state = if a.active { "" } else { "  inactive" };
        let _ = writeln!(
            text,
            "{:<5} {:<22} {:<6} {:>5.2} {:>5.2} {:>7.2}  {}{state}",
            a.unit.to_string(),
            a.name,
            a.region,
            a.au_min,
            a.au_max,
            a.neutral,
            counts.join(" ")
        );
    }
    text.truncate(text.trim_end().len());
    text
}

pub(super) fn verify(args: &VerifyArgs, console: &Console) -> Result<(), Failure> {
    check_folder(&args.dataset)?;
    let verdict = verify::verify(&args.dataset, console);
    let mut text = String::new();
    for problem in &verdict.problems {
        let _ = writeln!(text, "{}: {}", problem.path.display(), problem.message);
    }
    if verdict.problems.is_empty() {
        let scales: Vec<String> = verdict.scales.iter().map(|s| format!("{s}x")).collect();
        // Other programs' layouts have one size and no name for it.
        let at = if scales.is_empty() { String::new() } else { format!(" at {}", scales.join(", ")) };
        let _ = write!(
            text,
            "{}: {} frames{at}, {} pictures opened: no problems",
            args.dataset.display(),
            verdict.frames,
            verdict.pictures
        );
        console.finish(&verdict, &text);
        return Ok(());
    }
    console.finish(&verdict, text.trim_end());
    let count = verdict.problems.len();
    let message = format!("{}: {count} problem{}", args.dataset.display(), if count == 1 { "" } else { "s" });
    Err(Failure::input(message).with_hint("put back what is missing or damaged, or build the dataset again"))
}
