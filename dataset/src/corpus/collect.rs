//! Files a dataset, and the run that was fitted to it, in a corpus.

use std::fs;
use std::path::Path;

use polars::prelude::Column;
use risorius_formats::pose_report::json_error;
use risorius_formats::{ErrorKind, FormatError, Reporter, Warning};
use serde::Serialize;

use super::numbers::{self, Number};
use super::table_path;
use crate::error::Result;
use crate::provenance::Provenance;
use crate::stats::Report;
use crate::tables::{self, TABLES, column, write_table};

/// Under what a dataset is filed.
#[derive(Clone, Debug, Default)]
pub struct Entry<'a> {
    /// The subject; `None` takes what the dataset states.
    pub subject: Option<&'a str>,
    /// The take; `None` takes the dataset's names.
    pub take: Option<&'a str>,
    /// The take's place in the subject's order of takes, from 0.
    pub number: u32,
    /// The folder of the run.
    pub run: Option<&'a Path>,
}

/// What was filed.
#[derive(Clone, Debug, Serialize)]
pub struct Collected {
    /// The subject.
    pub subject: String,
    /// The takes.
    pub takes: Vec<String>,
    /// Files written, in all tables.
    pub files: usize,
    /// Numbers of the evaluation.
    pub numbers: usize,
}

/// Files the dataset in `dir` in `corpus`; what was filed there for its takes before is replaced.
pub fn collect(dir: &Path, corpus: &Path, entry: &Entry<'_>, reporter: &dyn Reporter) -> Result<Collected> {
    let provenance = Provenance::read(dir)?;
    let bad = |message: String, hint: &str| {
        Err(FormatError::new(ErrorKind::Missing, message).in_file(dir).with_hint(hint).into())
    };
    if provenance.takes.is_empty() {
        return bad("is not a dataset that knows its takes".to_owned(), "build it with `dataset build`");
    }
    if entry.take.is_some() && provenance.takes.len() > 1 {
        return bad(
            format!("has {} takes, and one name was given", provenance.takes.len()),
            "leave out the name: each take keeps its own",
        );
    }
    let stated = provenance.takes.iter().map(|t| t.subject.trim()).find(|s| !s.is_empty());
    let Some(subject) = entry.subject.or(stated) else {
        return bad("does not state its subject".to_owned(), "name it with `--subject NAME`");
    };
    let report = read_report(dir)?;
    let numbers = match entry.run {
        Some(run) => numbers::of_evaluation(&run.join("eval").join("eval.json"))?,
        None => Vec::new(),
    };
    if let (Some(run), true) = (entry.run, numbers.is_empty()) {
        let message = format!("{}: was not judged yet; the table of metrics has nothing of it", run.display());
        reporter.warn(Warning::new("not-judged", message));
    }
    let mut collected = Collected { subject: subject.to_owned(), takes: Vec::new(), files: 0, numbers: numbers.len() };
    for take in &provenance.takes {
        let name = entry.take.unwrap_or(&take.name);
        let path = |table: &str| table_path(corpus, table, subject, name);
        let who = [("subject", subject), ("take", name)];
        let named = |columns: Vec<Column>| -> Vec<Column> {
            let rows = columns.first().map_or(0, Column::len);
            who.iter().map(|(key, text)| column(key, vec![*text; rows])).chain(columns).collect()
        };
        for table in TABLES {
            let from = tables::existing_table(dir, table, &take.name);
            tables::copy_table(&from, &path(table), &who)?;
            collected.files += 1;
        }
        write_table(&path("datasets"), named(dataset_row(&report, &take.name, entry.number)))?;
        collected.files += 1;
        for table in ["fits", "metrics"] {
            let columns = match (table, entry.run) {
                ("fits", Some(run)) => Some(numbers::fit_row(run)?),
                ("metrics", Some(_)) if !numbers.is_empty() => Some(metric_rows(&numbers)),
                _ => None,
            };
            match columns {
                Some(columns) => {
                    write_table(&path(table), named(columns))?;
                    collected.files += 1;
                }
                None => remove(&path(table))?,
            }
        }
        collected.takes.push(name.to_owned());
        if reporter.cancelled() {
            return Err(crate::DatasetError::Cancelled);
        }
    }
    Ok(collected)
}

/// Removes what an earlier filing left, with its folder, which else would be an empty partition.
fn remove(path: &Path) -> Result<()> {
    match fs::remove_file(path) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(FormatError::io(path, "remove", &e).into()),
        _ => {
            if let Some(folder) = path.parent() {
                let _ = fs::remove_dir(folder);
            }
            Ok(())
        }
    }
}

fn read_report(dir: &Path) -> Result<Report> {
    let path = dir.join("report").join("stats.json");
    let bytes = fs::read(&path).map_err(|e| {
        FormatError::io(&path, "read", &e).with_hint("only datasets made by `dataset build` have these numbers")
    })?;
    Ok(serde_json::from_slice(&bytes).map_err(|e| json_error(&e).in_file(&path))?)
}

fn dataset_row(report: &Report, take: &str, number: u32) -> Vec<Column> {
    let of = report.takes.iter().find(|t| t.name == take);
    let count = |n: fn(&crate::stats::TakeReport) -> u32| of.map(n);
    let one = |name: &str, value: usize| column(name, vec![value as u32]);
    vec![
        column("take_number", vec![number]),
        column("fps", vec![of.map(|t| t.fps)]),
        column("frames", vec![count(|t| t.counts.frames)]),
        column("valid", vec![count(|t| t.counts.valid)]),
        column("lost", vec![count(|t| t.counts.lost)]),
        column("low_confidence", vec![count(|t| t.counts.low_confidence)]),
        column("incomplete", vec![count(|t| t.counts.incomplete)]),
        column("posed", vec![of.map(|t| t.posed as u32)]),
        column("reprojection_error_px", vec![of.and_then(|t| t.reprojection_error_px)]),
        one("candidates", report.candidates),
        one("chosen", report.chosen),
        one("train", report.split.train),
        one("val", report.split.val),
        one("active_aus", report.attributes.iter().filter(|a| a.active).count()),
        column("block_entropy", vec![report.evenness_after.block_entropy]),
    ]
}

fn metric_rows(numbers: &[Number]) -> Vec<Column> {
    let texts = |pick: fn(&Number) -> Option<&String>| numbers.iter().map(|n| pick(n).cloned()).collect::<Vec<_>>();
    vec![
        column("view", texts(|n| n.view.as_ref())),
        column("kind", texts(|n| n.kind.as_ref())),
        column("part", texts(|n| n.part.as_ref())),
        column("au", texts(|n| n.au.as_ref())),
        column("metric", numbers.iter().map(|n| n.metric.clone()).collect::<Vec<_>>()),
        column("value", numbers.iter().map(|n| n.value).collect::<Vec<_>>()),
    ]
}
