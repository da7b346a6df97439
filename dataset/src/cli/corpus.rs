//! `dataset collect`, and `dataset stats` of a corpus.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use risorius_console::{Console, Failure};

use crate::corpus::{self, CorpusSummary, Entry};

/// File a dataset, and its avatar, in a corpus.
///
/// A corpus is a folder of Parquet tables of many takes, partitioned by subject and take: frames, aus, poses, datasets,
/// fits, metrics. polars, DuckDB, Spark and others read it as it is; `dataset stats CORPUS` sums it up. What was filed
/// for a take before is replaced; several takes can be filed at once.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  dataset collect datasets/ada --run runs/ada --out corpus && dataset stats corpus")]
pub(super) struct CollectArgs {
    /// Folder of the dataset
    dataset: PathBuf,
    /// The corpus, which is made if it is not there
    #[arg(long, value_name = "CORPUS")]
    out: PathBuf,
    /// The run that was fitted to it, for the tables of fits and metrics
    #[arg(long, value_name = "RUN")]
    run: Option<PathBuf>,
    /// The subject [default: what the dataset states]
    #[arg(long, value_name = "NAME", value_parser = parse_name)]
    subject: Option<String>,
    /// The take, where the dataset has one [default: its own name]
    #[arg(long, value_name = "NAME", value_parser = parse_name)]
    take: Option<String>,
    /// Place of the take among the subject's, for what changes from take to take [default: 0]
    #[arg(long, value_name = "N")]
    number: Option<u32>,
}

fn parse_name(text: &str) -> Result<String, String> {
    if text.trim().is_empty() { Err("a name cannot be empty".to_owned()) } else { Ok(text.to_owned()) }
}

pub(super) fn collect(args: &CollectArgs, console: &Console) -> Result<(), Failure> {
    let entry = Entry {
        subject: args.subject.as_deref(),
        take: args.take.as_deref(),
        number: args.number.unwrap_or(0),
        run: args.run.as_deref(),
    };
    let done = corpus::collect(&args.dataset, &args.out, &entry, console)?;
    let text = format!(
        "{}: subject {}, {} filed in {} files, {} numbers of the evaluation",
        args.out.display(),
        done.subject,
        done.takes.join(", "),
        done.files,
        done.numbers
    );
    console.finish(&done, &text);
    Ok(())
}

pub(super) fn stats(dir: &Path, console: &Console) -> Result<(), Failure> {
    let summary = corpus::summarise(dir, console)?;
    console.finish(&summary, &in_words(&summary));
    Ok(())
}

fn in_words(s: &CorpusSummary) -> String {
    let mut text = format!(
        "{} takes of {} subjects, {} frames, {} chosen, {} avatars\n",
        s.takes,
        s.subjects.len(),
        s.frames,
        s.chosen,
        s.avatars
    );
    for (subject, count) in &s.subjects {
        let share = 100.0 * count.untrusted as f64 / count.frames.max(1) as f64;
        let _ = write!(text, "\n{subject}: {} takes, {} frames, {share:.1} % not trusted", count.takes, count.frames);
        if let Some(icc) = s.icc.get(subject) {
            let _ = write!(text, "; ICC(3,1) {:.3} over {} takes, drift {:+.3}", icc.mean, icc.takes, icc.drift);
        }
    }
    let _ = write!(text, "\n\nmean intensity (share of frames at 1 or more)\n{:<6}", "AU");
    let units: std::collections::BTreeSet<_> = s.aus.values().flat_map(|a| a.keys()).collect();
    for subject in s.aus.keys() {
        let _ = write!(text, "{:>16}", subject.chars().take(15).collect::<String>());
    }
    for unit in units {
        let _ = write!(text, "\n{:<6}", unit.to_string());
        for aus in s.aus.values() {
            let cell =
                aus.get(unit).map_or_else(|| "–".to_owned(), |a| format!("{:.2} ({:.0} %)", a.mean, 100.0 * a.raised));
            let _ = write!(text, "{cell:>16}");
        }
    }
    if !s.worst.is_empty() {
        text += "\n\nworst takes";
    }
    for w in &s.worst {
        let icc = w.icc_3_1.map_or_else(String::new, |i| format!(", ICC(3,1) {i:.3}"));
        let _ = write!(
            text,
            "\n  {}/{}: {:.2} dB{icc}, {:.1} % of the frames not trusted",
            w.subject,
            w.take,
            w.psnr_db,
            100.0 * w.untrusted
        );
    }
    text
}
