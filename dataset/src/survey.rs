//! Many datasets at once: their chosen frames counted table by table, one take in memory at a time.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use risorius_formats::au::MAX_INTENSITY;
use risorius_formats::{ActionUnit, AttributeTable, Reporter};
use serde::Serialize;

use crate::balance;
use crate::error::Result;
use crate::provenance::Provenance;
use crate::table_file::TableFile;
use crate::tables;

/// Levels of the counts: whole steps of 0–5.
pub const LEVELS: usize = MAX_INTENSITY as usize + 1;

/// One dataset in a survey.
#[derive(Clone, Debug, Serialize)]
pub struct Surveyed {
    /// Its folder, as it was named.
    pub dataset: PathBuf,
    /// Takes.
    pub takes: usize,
    /// Whom they show, where stated, each once.
    pub subjects: Vec<String>,
    /// Trusted frames.
    pub trusted: usize,
    /// Chosen frames.
    pub chosen: usize,
    /// AUs that move.
    pub active: usize,
}

/// What many datasets hold.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Survey {
    /// One after the other.
    pub datasets: Vec<Surveyed>,
    /// Chosen frames of all.
    pub chosen: usize,
    /// Chosen frames per AU and level, over all datasets in which the AU is active.
    pub levels: BTreeMap<ActionUnit, Vec<usize>>,
    /// In how many datasets the AU is active.
    pub active_in: BTreeMap<ActionUnit, usize>,
}

/// Counts the chosen frames of `datasets`.
pub fn survey(datasets: &[PathBuf], reporter: &dyn Reporter) -> Result<Survey> {
    let mut survey = Survey::default();
    reporter.stage("read tables", Some(datasets.len() as u64));
    for dir in datasets {
        let one = one_dataset(dir, &mut survey)?;
        survey.chosen += one.chosen;
        survey.datasets.push(one);
        reporter.advance(1);
    }
    Ok(survey)
}

fn one_dataset(dir: &Path, survey: &mut Survey) -> Result<Surveyed> {
    let table = AttributeTable::read(dir.join("attributes.toml"))?;
    let takes = Provenance::read(dir)?.takes;
    let mut one = Surveyed {
        dataset: dir.to_owned(),
        takes: takes.len(),
        subjects: Vec::new(),
        trusted: 0,
        chosen: 0,
        active: table.attributes.iter().filter(|a| a.active).count(),
    };
    for take in &takes {
        let subject = take.subject.trim();
        if !subject.is_empty() && !one.subjects.iter().any(|s| s == subject) {
            one.subjects.push(subject.to_owned());
        }
        let names: Vec<String> = table.attributes.iter().map(|a| format!("{}_intensity", a.unit)).collect();
        let columns: Vec<&str> = std::iter::once("id").chain(names.iter().map(String::as_str)).collect();
        let file = TableFile::open_columns(&tables::existing_table(dir, "aus", &take.name), &columns)?;
        let chosen: Vec<bool> = file.texts("id")?.iter().map(Option::is_some).collect();
        one.trusted += chosen.len();
        one.chosen += chosen.iter().filter(|c| **c).count();
        for spec in table.attributes.iter().filter(|a| a.active) {
            let counts = survey.levels.entry(spec.unit).or_insert_with(|| vec![0; LEVELS]);
            let values = file.f32s(&format!("{}_intensity", spec.unit))?;
            for value in values.iter().zip(&chosen).filter(|(_, c)| **c).filter_map(|(v, _)| *v) {
                counts[balance::level_of(value, LEVELS)] += 1;
            }
        }
    }
    for spec in table.attributes.iter().filter(|a| a.active) {
        *survey.active_in.entry(spec.unit).or_default() += 1;
    }
    Ok(one)
}
