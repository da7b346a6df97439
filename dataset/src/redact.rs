//! `dataset redact`: removes a take from a dataset for good: its pictures, masks, cameras, attributes, rows and words.
//!
//! What was measured on all takes together stays, because the rest depends on it: the ranges of the AUs, the place and
//! size of the head, and the numbers of the other takes. Exports and avatars made earlier are not reached.

use std::collections::BTreeSet;
use std::path::Path;

use risorius_formats::atomic::AtomicDir;
use risorius_formats::landmark_table::LandmarkTable;
use risorius_formats::nerfies::{self, Dataset};
use risorius_formats::{AttributeTable, ErrorKind, FormatError, Reporter};
use serde::Serialize;

use crate::error::{DatasetError, Result};
use crate::export::{make, scales_in};
use crate::import::take_and_frame;
use crate::options::BuildOptions;
use crate::provenance::{Provenance, REDACTED};
use crate::stats::{self, Report};
use crate::{report, sheet, tables};

/// What a redaction did.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Redacted {
    /// Chosen frames that are gone.
    pub frames_removed: usize,
    /// Chosen frames that stay.
    pub frames_left: usize,
    /// Takes that stay.
    pub takes_left: Vec<String>,
}

/// Removes the take `name` from the dataset in `dir`, wholly or not at all.
pub fn redact(dir: &Path, name: &str, reporter: &dyn Reporter) -> Result<Redacted> {
    let dataset = Dataset::read(dir)?;
    let mut provenance = Provenance::read(dir)?;
    let fail = |message: String, hint: String| {
        Err(DatasetError::Format(FormatError::new(ErrorKind::Missing, message).in_file(dir).with_hint(hint)))
    };
    let names: Vec<String> = provenance.takes.iter().map(|t| t.name.clone()).collect();
    let Some(place) = names.iter().position(|n| n == name) else {
        return fail(format!("has no take `{name}`"), format!("its takes are: {}", names.join(", ")));
    };
    if names.len() < 2 {
        return fail(format!("`{name}` is its only take"), "remove the whole folder".to_owned());
    }
    let number = provenance.takes.remove(place).number;
    let gone: BTreeSet<&String> = dataset.ids.iter().filter(|id| take_and_frame(&dataset, id).0 == number).collect();
    let rest = without(&dataset, &gone, number);
    if rest.train_ids.is_empty() {
        return fail(format!("without `{name}` no frame for fitting is left"), "remove the whole folder".to_owned());
    }

    let options = settings(dir)?;
    let mut rows = tables::read(dir)?;
    rows.takes.retain(|t| t.name != name);
    let old: Report = {
        let path = dir.join("report").join("stats.json");
        let bytes = std::fs::read(&path).map_err(|e| FormatError::io(&path, "read", &e))?;
        serde_json::from_slice(&bytes).map_err(|e| risorius_formats::pose_report::json_error(&e).in_file(&path))?
    };
    let about = old.takes.into_iter().filter(|t| t.name != name).collect();

    let staging = AtomicDir::create(dir)?;
    let out = staging.path();
    keep_files(dir, &rest, out, reporter)?;
    rest.write(out)?;
    AttributeTable::read(dir.join("attributes.toml"))?.write(out.join("attributes.toml"))?;
    provenance.write(out)?;
    tables::write(out, &rows)?;
    tables::intensities_of(&rows).write(out)?;
    if let Some(mut landmarks) = LandmarkTable::read(dir)? {
        landmarks.rows.retain(|id, _| !gone.contains(id));
        landmarks.write(out)?;
    }
    let report = stats::collect(&rows, about, &options);
    report::write(out, &rows, &report, &options, &sheet::thumbnails(out, &rest, &rows)?)?;
    if reporter.cancelled() {
        return Err(DatasetError::Cancelled);
    }
    staging.commit()?;
    Ok(Redacted {
        frames_removed: gone.len(),
        frames_left: rest.ids.len(),
        takes_left: provenance.takes.into_iter().map(|t| t.name).collect(),
    })
}

/// What the dataset in `dir` was built with.
pub(crate) fn settings(dir: &Path) -> Result<BuildOptions> {
    let path = dir.join("report").join("settings.toml");
    let text = std::fs::read_to_string(&path).map_err(|e| FormatError::io(&path, "read", &e))?;
    let options: BuildOptions = toml::from_str(&text)
        .map_err(|e| FormatError::new(ErrorKind::Syntax, e.message().trim().replace('\n', ", ")).in_file(&path))?;
    // What tables are made by.
    if !(2..=101).contains(&options.levels) {
        let message = format!("`levels` is {}, expected 2 to 101", options.levels);
        return Err(FormatError::new(ErrorKind::Inconsistent, message).in_file(&path).into());
    }
    Ok(options)
}

/// The dataset without some of its ids.
fn without(dataset: &Dataset, gone: &BTreeSet<&String>, number: usize) -> Dataset {
    let kept = |ids: &[String]| -> Vec<String> { ids.iter().filter(|id| !gone.contains(id)).cloned().collect() };
    let mut rest = dataset.clone();
    rest.ids = kept(&dataset.ids);
    rest.train_ids = kept(&dataset.train_ids);
    rest.val_ids = kept(&dataset.val_ids);
    rest.cameras.retain(|id, _| !gone.contains(id));
    rest.metadata.retain(|id, _| !gone.contains(id));
    let train: BTreeSet<&String> = rest.train_ids.iter().collect();
    let mut warp_id = 0;
    for id in &rest.ids {
        // A held-out frame gets the place that it would have among the frames for fitting.
        if let Some(m) = rest.metadata.get_mut(id) {
            (m.warp_id, m.appearance_id) = (warp_id, warp_id);
        }
        warp_id += u32::from(train.contains(id));
    }
    let numbers: BTreeSet<u32> = gone.iter().filter_map(|id| id.parse().ok()).collect();
    rest.annotations.retain(|a| !numbers.contains(&a.frame));
    if let Some(extras) = &mut rest.extras {
        extras.ids_without_masks.retain(|id| !gone.contains(id));
        extras.neutral_id = extras.neutral_id.take().filter(|id| !gone.contains(id));
        if let Some(name) = extras.takes.get_mut(number) {
            REDACTED.clone_into(name);
        }
    }
    rest
}

/// Brings the files of the ids that stay into the new folder; links where the file system can, copies elsewhere.
fn keep_files(dir: &Path, rest: &Dataset, out: &Path, reporter: &dyn Reporter) -> Result<()> {
    let scales = scales_in(dir);
    reporter.stage("keep the other takes", Some(rest.ids.len() as u64));
    for id in &rest.ids {
        let mut paths = vec![(nerfies::polygons_path(dir, id), nerfies::polygons_path(out, id))];
        for &s in &scales {
            for path in [nerfies::rgb_path, nerfies::region_path, nerfies::valid_path, nerfies::head_path] {
                paths.push((path(dir, s, id), path(out, s, id)));
            }
        }
        for (from, to) in paths.into_iter().filter(|(from, _)| from.is_file()) {
            to.parent().map_or(Ok(()), make)?;
            if std::fs::hard_link(&from, &to).is_err() {
                crate::export::copy(&from, &to)?;
            }
        }
        reporter.advance(1);
    }
    Ok(())
}
