//! Real clips with tables of OpenFace: how far `tracker run` agrees with them. OpenFace is another instrument, not the truth.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use glam::DVec3;
use risorius_console::Failure;
use risorius_formats::au::OPENFACE_INTENSITIES;
use risorius_formats::openface::{self, ReadOptions};
use risorius_formats::{ErrorKind, FormatError, Silent, Track, TrackRow};
use serde::Serialize;

use super::agreement::{self, Agreement, correlation};
use super::columns::Columns;
use super::gaze;
use super::metrics::{self, Truth};

/// What a clip of the pairs may end with.
const VIDEOS: [&str; 4] = ["mp4", "mov", "avi", "mkv"];

/// One clip.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Clip {
    pub(crate) name: String,
    pub(crate) agreement: Agreement,
    /// Mean distance of the inner 51 points, % of the outer-eye distance: as they are, and without each point's median.
    pub(crate) landmarks_percent: [f64; 2],
    /// r of `gaze_angle_x` and `gaze_angle_y`.
    pub(crate) gaze_r: Option<[f64; 2]>,
}

/// Videos of a folder with the tables that have their names.
pub(crate) fn pairs(folder: &Path) -> Result<Vec<(PathBuf, PathBuf)>, FormatError> {
    let entries = std::fs::read_dir(folder).map_err(|e| FormatError::io(folder, "read", &e))?;
    let is_video = |p: &PathBuf| p.extension().is_some_and(|e| VIDEOS.iter().any(|v| e.eq_ignore_ascii_case(v)));
    let mut out: Vec<(PathBuf, PathBuf)> = entries
        .flatten()
        .map(|e| e.path())
        .filter(is_video)
        .map(|video| (video.clone(), video.with_extension("csv")))
        .filter(|(_, table)| table.is_file())
        .collect();
    out.sort();
    if out.is_empty() {
        let message = "holds no video with a table of its name (clip.mp4, clip.csv)";
        return Err(FormatError::new(ErrorKind::Missing, message).in_file(folder));
    }
    Ok(out)
}

/// Compares the track of a clip (`ours`, and its file) with a table, whose rows are the clip's frames.
pub(crate) fn compare(name: String, ours: &Path, table: &Path) -> Result<Clip, Failure> {
    let track = openface::read(ours, &ReadOptions::default(), &Silent)?;
    let reference = Columns::read(table)?;
    let trusted = |row: usize| reference.get(["success"]).is_none_or(|[s]| s[row] == 1.0);
    let column = |name: String| reference.get([name.as_str()]).map(|[c]| c);
    let units = OPENFACE_INTENSITIES.map(|u| column(format!("{u}_r")));
    if units.iter().all(Option::is_none) {
        let message = "has no column of AU intensities (AU01_r)";
        return Err(FormatError::new(ErrorKind::Missing, message).in_file(table).into());
    }
    let intensities: Vec<Option<[f64; 17]>> =
        (0..reference.rows).map(|i| trusted(i).then(|| units.map(|u| u.map_or(0.0, |u| u[i]).max(0.0)))).collect();
    let points: Vec<Option<[&[f64]; 2]>> =
        (0..68).map(|k| reference.get([&format!("x_{k}"), &format!("y_{k}")])).collect();
    // OpenFace counts from the centre of the first pixel.
    let point = |row: usize, k: usize| points[k].map_or([f64::NAN; 2], |[x, y]| [x[row] + 0.5, y[row] + 0.5]);
    let landmarks_px = (0..reference.rows).map(|i| std::array::from_fn(|k| point(i, k))).collect();
    let truth = Truth { landmarks_px, ..Truth::default() };
    let is_known = |row: &&TrackRow| intensities.get(row.frame.0 as usize).is_some_and(Option::is_some);
    let known = Track { rows: track.rows.iter().filter(is_known).cloned().collect(), ..track };
    let errors = metrics::compare(&known, &truth);
    Ok(Clip {
        name,
        agreement: agreement::compare(&known, &intensities),
        landmarks_percent: [errors.landmarks_percent, errors.landmarks_without_offset_percent],
        gaze_r: gaze_r(&gaze::directions(&Columns::read(ours)?), &gaze::directions(&reference)),
    })
}

fn gaze_r(ours: &[DVec3], theirs: &[DVec3]) -> Option<[f64; 2]> {
    let both = || ours.iter().zip(theirs).filter(|(a, b)| **a != DVec3::ZERO && **b != DVec3::ZERO && b.is_finite());
    let pairs = |axis: usize| both().map(|(a, b)| (gaze::angles(*a)[axis], gaze::angles(*b)[axis])).collect::<Vec<_>>();
    (both().count() > 2).then(|| [0, 1].map(|axis| correlation(&pairs(axis))))
}

/// The clips for people: one line each, then one line for each AU.
pub(crate) fn table(clips: &[Clip]) -> String {
    let mut text = "| clip | frames | AUs | r | ICC(3,1) | AUs > 1: r | ICC | ≥ 4.9 % | jitter at rest | cross-talk | inner 51 % | without offset % | gaze x r | y r |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|---|".to_owned();
    for clip in clips {
        line(&mut text, &clip.name, &clip.agreement);
        let [as_is, without] = clip.landmarks_percent;
        let [x, y] = clip.gaze_r.map_or(["–".to_owned(), "–".to_owned()], |r| r.map(|v| format!("{v:.2}")));
        let _ = write!(text, " {as_is:.2} | {without:.2} | {x} | {y} |");
    }
    let mean = |get: &dyn Fn(&Agreement) -> f64| {
        clips.iter().map(|c| get(&c.agreement)).sum::<f64>() / clips.len().max(1) as f64
    };
    let _ = write!(
        text,
        "\n\nmean over clips: r {:.3}, ICC(3,1) {:.3}; AUs above 1: {:.3}, {:.3}",
        mean(&|a| a.moving[0]),
        mean(&|a| a.moving[1]),
        mean(&|a| a.moving_much[0]),
        mean(&|a| a.moving_much[1])
    );
    for clip in clips {
        let units: Vec<String> = clip
            .agreement
            .units
            .iter()
            .map(|u| format!("{} {:.2}/{:.2} ({:.1} of {:.1})", u.unit, u.r, u.icc31, u.p99, u.reference_peak))
            .collect();
        let _ = write!(text, "\n{}: r/ICC (99th percentile, reference's peak): {}", clip.name, units.join(", "));
    }
    text
}

/// The figures of an agreement as the beginning of a row.
pub(crate) fn line(text: &mut String, name: &str, a: &Agreement) {
    let _ = write!(
        text,
        "\n| {name} | {} | {} | {:.3} | {:.3} | {:.3} | {:.3} | {:.1} | {:.3} | {:.3} |",
        a.frames,
        a.units.len(),
        a.moving[0],
        a.moving[1],
        a.moving_much[0],
        a.moving_much[1],
        100.0 * a.saturated_share,
        a.jitter_at_rest,
        a.cross_talk
    );
}
