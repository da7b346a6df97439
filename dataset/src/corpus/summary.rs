//! A corpus in numbers: who and how much, how AUs are spread over subjects, the worst takes, how agreement drifts.
//!
//! Files are read one after the other, and of each only the columns that count: what is held does not grow with the
//! number of takes but for a line per take.

use std::collections::BTreeMap;
use std::path::Path;

use risorius_formats::au::MAX_INTENSITY;
use risorius_formats::{ActionUnit, ErrorKind, FormatError, Reporter};
use serde::Serialize;

use super::{is_corpus, partitions};
use crate::balance;
use crate::error::Result;
use crate::table_file::TableFile;

/// Levels of the counts: whole steps of 0–5.
const LEVELS: usize = MAX_INTENSITY as usize + 1;
/// An AU of this intensity or more is raised.
const RAISED: f32 = 1.0;
/// How many of the worst takes are named.
const WORST: usize = 5;

/// What a corpus holds.
#[derive(Clone, Debug, Default, Serialize)]
pub struct CorpusSummary {
    /// Takes in all.
    pub takes: usize,
    /// Frames in all.
    pub frames: u64,
    /// Frames chosen for fitting and testing.
    pub chosen: u64,
    /// Takes with a fitted avatar.
    pub avatars: usize,
    /// Per subject.
    pub subjects: BTreeMap<String, SubjectCount>,
    /// Per subject and AU: trusted frames.
    pub aus: BTreeMap<String, BTreeMap<ActionUnit, AuCount>>,
    /// The judged takes with the lowest PSNR, the worst first.
    pub worst: Vec<TakeScore>,
    /// Per subject: ICC(3,1) of AU control, mean over AUs, of the subject's first and last judged take.
    pub icc: BTreeMap<String, Agreement>,
}

/// What there is of a subject.
#[derive(Clone, Debug, Default, Serialize)]
pub struct SubjectCount {
    /// Takes.
    pub takes: usize,
    /// Frames.
    pub frames: u64,
    /// Frames without a face, or with an unsure one.
    pub untrusted: u64,
}

/// How an AU is spread over the trusted frames of a subject.
#[derive(Clone, Debug, Default, Serialize)]
pub struct AuCount {
    /// Trusted frames.
    pub frames: u64,
    /// Mean intensity, 0–5.
    pub mean: f64,
    /// Share of the frames with an intensity of 1 or more.
    pub raised: f64,
    /// Frames per level.
    pub levels: [u64; LEVELS],
    #[serde(skip)]
    sum: f64,
    #[serde(skip)]
    raised_frames: u64,
}

/// A judged take.
#[derive(Clone, Debug, Serialize)]
pub struct TakeScore {
    /// The subject.
    pub subject: String,
    /// The take.
    pub take: String,
    /// Mean PSNR over its views, dB.
    pub psnr_db: f64,
    /// Mean ICC(3,1) of AU control, where it was measured.
    pub icc_3_1: Option<f64>,
    /// Share of frames that are not trusted.
    pub untrusted: f64,
    #[serde(skip)]
    number: u32,
}

/// How AU control agrees, and how that drifts.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Agreement {
    /// Takes with a measured agreement.
    pub takes: usize,
    /// Mean over these.
    pub mean: f64,
    /// Of the first take in the subject's order.
    pub first: f64,
    /// Of the last one, less the first.
    pub drift: f64,
}

/// Sums up the corpus in `dir`.
pub fn summarise(dir: &Path, reporter: &dyn Reporter) -> Result<CorpusSummary> {
    if !is_corpus(dir) {
        return Err(FormatError::new(ErrorKind::Missing, "holds no takes of a corpus")
            .in_file(dir)
            .with_hint("`dataset collect` files datasets in a corpus")
            .into());
    }
    let tables = dir.join("tables");
    let takes: Vec<_> = partitions(&tables.join("datasets"), "subject")
        .flat_map(|(subject, dir)| partitions(&dir, "take").map(move |(take, _)| (subject.clone(), take)))
        .collect();
    reporter.stage("read the corpus", Some(takes.len() as u64));
    let mut summary = CorpusSummary { takes: takes.len(), ..CorpusSummary::default() };
    let mut scores = Vec::new();
    for (subject, take) in takes {
        let path = |table: &str| super::table_path(dir, table, &subject, &take);
        let untrusted = count_frames(&path("datasets"), &subject, &mut summary)?;
        count_aus(&path("aus"), summary.aus.entry(subject.clone()).or_default())?;
        summary.avatars += usize::from(path("fits").is_file());
        if path("metrics").is_file() {
            let number = TableFile::open_columns(&path("datasets"), &["take_number"])?.u32s("take_number")?;
            if let Some((psnr_db, icc_3_1)) = score(&path("metrics"))? {
                let number = number.first().copied().flatten().unwrap_or(0);
                scores.push(TakeScore { subject, take, psnr_db, icc_3_1, untrusted, number });
            }
        }
        reporter.advance(1);
        if reporter.cancelled() {
            return Err(crate::DatasetError::Cancelled);
        }
    }
    for count in summary.aus.values_mut().flat_map(BTreeMap::values_mut) {
        count.mean = count.sum / count.frames.max(1) as f64;
        count.raised = count.raised_frames as f64 / count.frames.max(1) as f64;
    }
    summary.icc = agreements(&scores);
    scores.sort_by(|a, b| {
        a.psnr_db.total_cmp(&b.psnr_db).then_with(|| (&a.subject, &a.take).cmp(&(&b.subject, &b.take)))
    });
    scores.truncate(WORST);
    summary.worst = scores;
    Ok(summary)
}

/// Adds the frames of a take; gives the share that is not trusted.
fn count_frames(path: &Path, subject: &str, summary: &mut CorpusSummary) -> Result<f64> {
    let file = TableFile::open_columns(path, &["frames", "valid", "chosen"])?;
    let one = |name: &str| -> Result<u64> {
        let value = file.u32s(name)?.first().copied().flatten();
        Ok(u64::from(value.ok_or_else(|| file.bad(format!("has no `{name}`")))?))
    };
    let (frames, valid) = (one("frames")?, one("valid")?);
    let untrusted = frames.saturating_sub(valid);
    summary.frames += frames;
    summary.chosen += one("chosen")?;
    let count = summary.subjects.entry(subject.to_owned()).or_default();
    count.takes += 1;
    count.frames += frames;
    count.untrusted += untrusted;
    Ok(untrusted as f64 / frames.max(1) as f64)
}

fn count_aus(path: &Path, counts: &mut BTreeMap<ActionUnit, AuCount>) -> Result<()> {
    let names = TableFile::column_names(path)?;
    let units: Vec<(ActionUnit, &String)> =
        names.iter().filter_map(|name| Some((name.strip_suffix("_intensity")?.parse().ok()?, name))).collect();
    let columns: Vec<&str> = units.iter().map(|(_, name)| name.as_str()).collect();
    let file = TableFile::open_columns(path, &columns)?;
    for (unit, name) in units {
        let count = counts.entry(unit).or_default();
        for value in file.f32s(name)?.into_iter().flatten() {
            count.frames += 1;
            count.sum += f64::from(value);
            count.raised_frames += u64::from(value >= RAISED);
            count.levels[balance::level_of(value, LEVELS)] += 1;
        }
    }
    Ok(())
}

/// Mean PSNR over all views and mean ICC(3,1); `None` where no views were judged.
fn score(path: &Path) -> Result<Option<(f64, Option<f64>)>> {
    let file = TableFile::open_columns(path, &["view", "kind", "part", "au", "metric", "value"])?;
    let (views, kinds, parts, units) =
        (file.texts("view")?, file.texts("kind")?, file.texts("part")?, file.texts("au")?);
    let (metrics, values) = (file.texts("metric")?, file.f64s("value")?);
    let find = |kind: &str, metric: &str| {
        let row = (0..metrics.len()).find(|&i| {
            kinds[i].as_deref() == Some(kind)
                && metrics[i].as_deref() == Some(metric)
                && views[i].is_none()
                && parts[i].is_none()
                && units[i].is_none()
        });
        row.and_then(|i| values[i])
    };
    Ok(find("all", "psnr_db").map(|psnr| (psnr, find("control", "mean_icc_3_1"))))
}

fn agreements(scores: &[TakeScore]) -> BTreeMap<String, Agreement> {
    let mut by_subject: BTreeMap<String, Vec<(u32, &str, f64)>> = BTreeMap::new();
    for s in scores {
        if let Some(icc) = s.icc_3_1 {
            by_subject.entry(s.subject.clone()).or_default().push((s.number, &s.take, icc));
        }
    }
    let sum_up = |(subject, mut takes): (String, Vec<(u32, &str, f64)>)| {
        takes.sort_by(|a, b| (a.0, a.1).cmp(&(b.0, b.1)));
        let (first, last) = (takes.first()?.2, takes.last()?.2);
        let mean = takes.iter().map(|t| t.2).sum::<f64>() / takes.len() as f64;
        Some((subject, Agreement { takes: takes.len(), mean, first, drift: last - first }))
    };
    by_subject.into_iter().filter_map(sum_up).collect()
}
