//! `tracker check --report`: the track of a take as one page of HTML without outside parts.
//!
//! Per AU: the curve over time, the face at its peaks, percentiles, saturation, how sure it is and what to do about it.
//! Then gaze, and frames without a face. No script; pictures are JPEG inside the page.

pub mod chart;
pub mod peaks;
pub mod thumbnails;

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use risorius_formats::html::escaped;
use risorius_formats::{Landmarks68, Reporter, Take, TrackRow, Warning, atomic};

use crate::check::CheckReport;
use crate::error::{Result, TrackerError};
use crate::import::MIN_CONFIDENCE;
use crate::parquet;
use crate::poses::read_track;
use crate::quality::{SATURATED_FROM, TrackQuality, UnitRange};
use crate::sureness::{self, FAIRLY_SURE_FROM, SURE_FROM};
use chart::{Chart, Line};
use thumbnails::Thumbnails;

/// Peaks of an AU that are shown.
const PEAKS: usize = 4;
/// Peaks lie at least so far apart, seconds; in short takes, a twelfth of the take.
const APART_SECS: f64 = 1.0;
/// What is less than this above the lowest value is no peak, 0–5.
const PEAK_FROM: f32 = 0.3;
/// Height of an AU's curve, units of the drawing.
const HEIGHT: f64 = 90.0;
/// Lost runs that are listed.
const LISTED: usize = 12;

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:62rem;padding:0 1rem;color:#1c1c22;background:#fff}\
h1{font-size:1.5rem}h2{font-size:1.15rem;margin:2rem 0 .3rem}h3{font-size:1rem;margin:1.6rem 0 .2rem}\
table{border-collapse:collapse;margin:.5rem 0}th,td{padding:.15rem .6rem;text-align:right;border-bottom:1px solid #ddd;font-variant-numeric:tabular-nums;vertical-align:top}\
th{white-space:nowrap}th:first-child,td:first-child,.left{text-align:left}.quiet{color:#63636e}a{color:inherit}\
.sure{color:#187a2f}.fairly-sure{color:#a86400}.not-sure{color:#b3261e;font-weight:600}\
.faces{display:flex;flex-wrap:wrap;gap:.5rem;margin:.2rem 0 .4rem 2.1rem}figure{margin:0}figure img{height:96px;display:block}\
figcaption{font-size:.8rem;color:#63636e}svg{width:100%;display:block}svg text{font-size:10px;fill:#63636e}svg .mark{font-size:11px;fill:#1c1c22}\
.grid{stroke:#e4e4ea;fill:none}.line{fill:none;stroke-width:1.1}.lost{fill:#f3d9d7}circle{fill:#1c1c22}";

/// Where the page lies unless the user names a place.
pub fn default_path(take_dir: &Path) -> PathBuf {
    take_dir.join("track").join("report.html")
}

/// Writes the page of a take that was checked to `out`.
pub fn write(take_dir: impl AsRef<Path>, check: &CheckReport, out: &Path, reporter: &dyn Reporter) -> Result<()> {
    let take = Take::open(take_dir)?;
    let track = read_track(&take)?;
    let mut rows: Vec<Option<&TrackRow>> = vec![None; take.frames.len()];
    for row in track.rows.iter().filter(|r| r.is_valid(MIN_CONFIDENCE)) {
        if let Some(slot) = rows.get_mut(row.frame.0 as usize) {
            slot.get_or_insert(row);
        }
    }
    let curve = |k: usize| rows.iter().map(|r| r.and_then(|r| r.intensities.get(k).copied().flatten())).collect();
    let curves: Vec<Vec<Option<f32>>> = (0..track.units.len()).map(curve).collect();
    let seconds: Vec<f64> = take.frames.iter().map(|f| f.timestamp_nanos as f64 * 1e-9).collect();
    let length = seconds.last().copied().unwrap_or(0.0) - seconds.first().copied().unwrap_or(0.0);
    let apart = APART_SECS.min(length / 12.0);
    let lowest = |c: &[Option<f32>]| c.iter().flatten().copied().fold(f32::MAX, f32::min);
    let peaks_of = |c: &Vec<_>| peaks::peaks(c, &seconds, PEAKS, apart, lowest(c) + PEAK_FROM);
    let peaks = curves.iter().map(peaks_of).collect();
    let rest = peaks::rest(&curves);
    let mut page = Page { take: &take, quality: &check.track, seconds, curves, peaks, rest, faces: Thumbnails::new() };
    page.faces = page.thumbnails(&rows, reporter)?;
    let gaze = ["gaze_angle_x", "gaze_angle_y"].map(str::to_owned);
    let columns = parquet::read_floats(&parquet::path(&take), &gaze)?;
    let gaze = gaze.map(|name| columns.get(&name).cloned().unwrap_or_default());
    Ok(atomic::write_file(out, page.html(&gaze).as_bytes())?)
}

struct Page<'a> {
    take: &'a Take,
    quality: &'a TrackQuality,
    seconds: Vec<f64>,
    /// Intensities by AU and frame; `None` where the frame is lost.
    curves: Vec<Vec<Option<f32>>>,
    /// Frames of the peaks of each AU.
    peaks: Vec<Vec<usize>>,
    /// The frame with the least expression.
    rest: Option<usize>,
    faces: Thumbnails,
}

impl Page<'_> {
    /// The faces of peaks and rest; none, with a warning, where the video cannot be read.
    fn thumbnails(&self, rows: &[Option<&TrackRow>], reporter: &dyn Reporter) -> Result<Thumbnails> {
        let frames = self.peaks.iter().flatten().chain(&self.rest);
        let face = |frame: &usize| Some((*frame as u32, rows.get(*frame).copied()??.landmarks.as_deref()?));
        let faces: BTreeMap<u32, &Landmarks68> = frames.filter_map(face).collect();
        match thumbnails::draw(self.take, &faces, reporter) {
            Err(TrackerError::Video(e)) => {
                reporter.warn(Warning::new("no-pictures", format!("{e}; the page has no pictures")));
                Ok(Thumbnails::new())
            }
            result => result,
        }
    }

    fn html(&self, gaze: &[Vec<Option<f32>>; 2]) -> String {
        let name = escaped(&self.take.dir.display().to_string());
        let mut page = format!(
            "<!doctype html>\n<html lang=\"en\"><meta charset=\"utf-8\"><title>{name}: track</title><style>{STYLE}</style>\n<h1>{name}: track</h1>\n"
        );
        self.summary(&mut page);
        self.table(&mut page);
        self.units(&mut page);
        self.gaze(&mut page, gaze);
        self.lost(&mut page);
        page.push_str("</html>\n");
        page
    }

    fn summary(&self, page: &mut String) {
        let q = self.quality;
        let _ = write!(page, "<p>{} of {} frames have a face", q.valid_frames, q.frames);
        if let Some(px) = q.outer_eye_distance_px {
            let _ = write!(page, "; outer eye corners {px:.0} px apart");
        }
        if let Some(px) = q.landmark_jitter_px {
            let _ = write!(page, "; noise of landmarks {px:.2} px");
        }
        if let Some(jitter) = q.au_jitter {
            let _ = write!(page, ", of AUs {jitter:.2}");
        }
        let saturated = 100.0 * q.saturated_share;
        let _ = writeln!(page, ". An AU stands at {SATURATED_FROM} or more in {saturated:.1} % of the frames.</p>");
        match sureness::not_sure(&q.units) {
            Some(names) => {
                let _ = writeln!(page, "<p><span class=\"not-sure\">Not sure:</span> {names}.</p>");
            }
            None if q.units.iter().all(|u| u.sureness.is_none()) => page.push_str(
                "<p class=\"quiet\">How sure the AUs are is not known: they do not come from the tracker's own readout.</p>\n",
            ),
            None => {}
        }
        if let Some(names) = sureness::still(&q.units) {
            let _ = writeln!(page, "<p>Hardly move in this take: {names}.</p>");
        }
        if let Some(face) = self.rest.and_then(|frame| self.face(frame, &self.moment(frame))) {
            let _ = writeln!(
                page,
                "<p class=\"quiet\">The frame with the least expression. If this is no resting face, all intensities are too low or too high.</p><div class=\"faces\">{face}</div>"
            );
        }
    }

    fn table(&self, page: &mut String) {
        page.push_str(
            "<h2>AUs</h2>\n<table><tr><th>AU</th><th class=\"left\">name</th><th>median</th><th>99 %</th><th>greatest</th><th>saturated</th><th>confidence</th><th class=\"left\">how sure, what to do</th></tr>\n",
        );
        let number = |v: Option<f32>| v.map_or_else(|| "–".to_owned(), |v| format!("{v:.2}"));
        for unit in &self.quality.units {
            let _ = writeln!(
                page,
                "<tr><td><a href=\"#{0}\">{0}</a></td><td class=\"left\">{1}</td><td>{2}</td><td>{3}</td><td>{4}</td><td>{5:.1} %</td><td>{6}</td><td class=\"left\">{7}{8}</td></tr>",
                unit.unit,
                unit.unit.facs_name(),
                number(unit.median),
                number(unit.p99),
                number(unit.max),
                100.0 * unit.saturated_share,
                number(unit.confidence),
                sure(unit),
                escaped(&sureness::advice(unit))
            );
        }
        let _ = writeln!(
            page,
            "</table>\n<p class=\"quiet\">Confidence is a mean over the frames: sure from {SURE_FROM}, fairly sure from {FAIRLY_SURE_FROM}. Saturated: share of the frames at {SATURATED_FROM} or more.</p>"
        );
    }

    fn units(&self, page: &mut String) {
        page.push_str(
            "<h2>Curves</h2>\n<p class=\"quiet\">Intensity 0 to 5 over time. Dots are the highest peaks, with the face below in the same order; frames without a face are shaded.</p>\n",
        );
        for ((unit, values), peaks) in self.quality.units.iter().zip(&self.curves).zip(&self.peaks) {
            let _ = writeln!(page, "<h3 id=\"{0}\">{0} {1} {2}</h3>", unit.unit, unit.unit.facs_name(), sure(unit));
            let title = format!("{} over time", unit.unit);
            let chart = Chart {
                title: &title,
                seconds: &self.seconds,
                range: [0.0, 5.0],
                grid: &[0.0, 1.0, 2.0, 3.0, 4.0, 5.0],
                lines: &[Line { values, colour: "#285aa0" }],
                lost: &self.quality.lost_runs,
                marks: peaks,
                height: HEIGHT,
            };
            let _ = writeln!(page, "{}", chart.svg());
            let caption = |(i, frame): (usize, &usize)| {
                let value = values.get(*frame).copied().flatten().unwrap_or(0.0);
                self.face(*frame, &format!("{}: {value:.1} at {}", i + 1, self.moment(*frame)))
            };
            let faces: String = peaks.iter().enumerate().filter_map(caption).collect();
            if peaks.is_empty() {
                let _ = writeln!(page, "<p class=\"quiet\">No peak of {PEAK_FROM} above the lowest value.</p>");
            } else if !faces.is_empty() {
                let _ = writeln!(page, "<div class=\"faces\">{faces}</div>");
            }
        }
    }

    fn gaze(&self, page: &mut String, gaze: &[Vec<Option<f32>>; 2]) {
        let known = gaze[0].iter().flatten().count();
        if known == 0 {
            page.push_str("<h2>Gaze</h2>\n<p class=\"quiet\">Not known in this track.</p>\n");
            return;
        }
        let degrees = gaze.each_ref().map(|g| g.iter().map(|v| v.map(f32::to_degrees)).collect::<Vec<_>>());
        let reach = degrees.iter().flatten().flatten().fold(10.0f32, |m, v| m.max(v.abs())).min(60.0);
        let reach = (reach / 10.0).ceil() * 10.0;
        let closed = self.quality.valid_frames.saturating_sub(known);
        let _ = writeln!(
            page,
            "<h2>Gaze</h2>\n<p class=\"quiet\">Degrees against the camera: <span style=\"color:#285aa0\">to the image's right</span>, <span style=\"color:#a86400\">down</span>. No line where an eye is closed: {closed} of {} frames.</p>",
            self.quality.valid_frames
        );
        let chart = Chart {
            title: "gaze over time",
            seconds: &self.seconds,
            range: [-reach, reach],
            grid: &[-reach, 0.0, reach],
            lines: &[Line { values: &degrees[0], colour: "#285aa0" }, Line { values: &degrees[1], colour: "#a86400" }],
            lost: &self.quality.lost_runs,
            marks: &[],
            height: 1.4 * HEIGHT,
        };
        let _ = writeln!(page, "{}", chart.svg());
    }

    fn lost(&self, page: &mut String) {
        page.push_str("<h2>Frames without a face</h2>\n");
        let runs = &self.quality.lost_runs;
        if runs.is_empty() {
            page.push_str("<p>None.</p>\n");
            return;
        }
        let time = |frame: u32| self.seconds.get(frame as usize).copied().unwrap_or(0.0);
        let run = |r: &[u32; 2]| format!("{}–{} ({:.2}–{:.2} s)", r[0], r[1], time(r[0]), time(r[1]));
        let listed = runs.iter().take(LISTED).map(run).collect::<Vec<_>>().join(", ");
        let more = if runs.len() > LISTED { ", …" } else { "" };
        let _ = writeln!(
            page,
            "<p>{} of {} frames, in {} run{}: {listed}{more}.</p>\n<p class=\"quiet\">A face is lost where it leaves the picture, turns to the side, is covered or too dark; these frames take no part in a dataset.</p>",
            self.quality.lost_frames,
            self.quality.frames,
            runs.len(),
            if runs.len() == 1 { "" } else { "s" }
        );
    }

    fn moment(&self, frame: usize) -> String {
        format!("{:.2} s (frame {frame})", self.seconds.get(frame).copied().unwrap_or(0.0))
    }

    fn face(&self, frame: usize, caption: &str) -> Option<String> {
        let address = self.faces.get(&(frame as u32))?;
        Some(format!(
            "<figure><img alt=\"face in frame {frame}\" src=\"{address}\"><figcaption>{caption}</figcaption></figure>"
        ))
    }
}

/// How sure an AU is, as a coloured word and a space.
fn sure(unit: &UnitRange) -> String {
    unit.sureness
        .map_or_else(String::new, |s| format!("<span class=\"{}\">{}</span> ", s.word().replace(' ', "-"), s.word()))
}

#[cfg(test)]
#[path = "page_tests.rs"]
mod tests;
