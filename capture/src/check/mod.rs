//! What a take is worth: verdicts that a person can act on.

mod blur;
mod flicker;
mod orbit;
mod page;
mod verdicts;

use risorius_formats::take::SourceKind;
use risorius_formats::{FrameRecord, Reporter, Take, Warning};
use risorius_video::Reader;
use serde::Serialize;

pub use flicker::Flicker;
pub use orbit::Orbit;
pub(crate) use page::word;
pub use page::write_page;

use crate::live::journal;
use crate::timing::{self, median, quantile};
use crate::{Result, media};
use verdicts::verdict;

/// A frame below this share of the median sharpness around it is blurred.
const BLURRED_SHARE: f32 = 0.5;
/// Frames on each side that say how sharp is usual.
const AROUND: usize = 60;

/// How serious a verdict is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Level {
    /// As it should be.
    Good,
    /// Usable; better is possible.
    Fair,
    /// Likely to spoil the result.
    Poor,
}

/// One sentence about one side of a take.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Verdict {
    /// What it is about: `media`, `length`, `rate`, `dropped`, `repeated`, `jitter`, `sharpness`,
    /// `motion-blur`, `exposure`, `flicker`, `upright`, `orbit`.
    pub topic: &'static str,
    /// How serious it is.
    pub level: Level,
    /// What is the case, and what to do about it.
    pub message: String,
}

/// The figures behind the verdicts. A missing figure is `null`: there were too few frames or no quality columns.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CheckReport {
    /// Number of frames.
    pub frame_count: u32,
    /// From the first to the last frame, seconds.
    pub duration_secs: f64,
    /// (frames − 1) / duration.
    pub fps_measured: f64,
    /// Frames per second that were asked for, or that the container states.
    pub fps_asked: Option<f64>,
    /// Root mean square deviation of the intervals from what is usual, milliseconds.
    pub jitter_ms: Option<f64>,
    /// Frames missing according to the times.
    pub dropped_frames: u64,
    /// Of a camera's take: frames that the driver lost.
    pub lost_by_driver: Option<u64>,
    /// Of a camera's take: frames that were let go because the disk was too slow.
    pub discarded: Option<u64>,
    /// Of a camera's take: broken frames.
    pub corrupt: Option<u64>,
    /// The longest run of missing frames.
    pub longest_drop: u32,
    /// Frames that repeat the one before.
    pub repeated_frames: u32,
    /// Median sharpness, squared 8-bit levels.
    pub sharpness_median: Option<f32>,
    /// The sharpness that 5 % of the frames stay below.
    pub sharpness_low: Option<f32>,
    /// Frames with less than half the sharpness that is usual around them.
    pub blurred_frames: u32,
    /// Share of the sharpness that is lost where the picture moves, 0–1.
    pub motion_blur: Option<f32>,
    /// The strongest pulse of the brightness.
    pub flicker: Option<Flicker>,
    /// From how many sides the head is seen, where the take was tracked.
    pub orbit: Option<Orbit>,
    /// Median of the mean luma, 0–255.
    pub luma_median: Option<f32>,
    /// Difference of the mean luma between the 95 % and the 5 % frame, levels.
    pub luma_drift: Option<f32>,
    /// Median share of black or white pixels, 0–1.
    pub clipped_median: Option<f32>,
    /// Whether the media are there and unchanged.
    pub media_intact: bool,
    /// The worst of the verdicts.
    pub overall: Level,
    /// A verdict for each side.
    pub verdicts: Vec<Verdict>,
}

/// Judges a take by its tables, and its media by their hash.
pub fn check(take: &Take, reporter: &dyn Reporter) -> Result<CheckReport> {
    let frames = &take.frames;
    let times: Vec<i64> = frames.iter().map(|f| f.timestamp_nanos).collect();
    let column = |pick: fn(&FrameRecord) -> Option<f32>| frames.iter().filter_map(pick).collect::<Vec<f32>>();
    let (sharpness, luma, clipped) = (column(|f| f.sharpness), column(|f| f.luma_mean), column(|f| f.clipped_share));
    let media = media_verdict(take, reporter)?;
    let journal = journal::read_journal(&take.dir);
    let counted = |pick: fn(&journal::JournalRow) -> u32| {
        (!journal.is_empty()).then(|| journal.iter().map(|r| u64::from(pick(r))).sum())
    };
    let mut report = CheckReport {
        frame_count: frames.len() as u32,
        duration_secs: times.last().map_or(0.0, |&t| t as f64 * 1e-9),
        fps_measured: timing::measured_fps(&times),
        fps_asked: take.manifest.fps_asked,
        jitter_ms: timing::jitter_nanos(&times).map(|j| j * 1e-6),
        dropped_frames: frames.iter().map(|f| u64::from(f.dropped_before)).sum(),
        lost_by_driver: counted(|r| r.lost_before),
        discarded: counted(|r| r.discarded_before),
        corrupt: counted(|r| r.corrupt_before),
        longest_drop: frames.iter().map(|f| f.dropped_before).max().unwrap_or(0),
        repeated_frames: frames.iter().filter(|f| f.repeated).count() as u32,
        sharpness_median: median(&sharpness),
        sharpness_low: quantile(&sharpness, 0.05),
        blurred_frames: blurred_frames(frames).len() as u32,
        motion_blur: blur::motion_blur(frames),
        flicker: flicker::flicker(&luma, timing::measured_fps(&times)),
        // A damaged track is the tracker's trouble; the rest of the take can be judged without it.
        orbit: orbit::orbit(take).unwrap_or_else(|e| {
            reporter.warn(Warning::new("unreadable-track", format!("{e}; the orbit is not judged")));
            None
        }),
        luma_median: median(&luma),
        luma_drift: quantile(&luma, 0.95).zip(quantile(&luma, 0.05)).map(|(high, low)| high - low),
        clipped_median: median(&clipped),
        media_intact: media.level == Level::Good,
        overall: Level::Good,
        verdicts: vec![media],
    };
    let from_images = take.manifest.source == SourceKind::Images;
    let more = verdicts::all(&report, frames, from_images);
    report.verdicts.extend(more);
    report.overall = report.verdicts.iter().map(|v| v.level).max().unwrap_or(Level::Good);
    Ok(report)
}

/// The frames with less than half the sharpness that is usual around them.
pub fn blurred_frames(frames: &[FrameRecord]) -> Vec<u32> {
    let sharpness: Vec<f32> = frames.iter().map(|f| f.sharpness.unwrap_or(f32::INFINITY)).collect();
    let is_blurred = |i: usize| {
        let around = &sharpness[i.saturating_sub(AROUND)..(i + AROUND + 1).min(sharpness.len())];
        median(around).is_some_and(|usual| usual.is_finite() && sharpness[i] < BLURRED_SHARE * usual)
    };
    (0..frames.len()).filter(|&i| is_blurred(i)).map(|i| frames[i].index.0).collect()
}

fn media_verdict(take: &Take, reporter: &dyn Reporter) -> Result<Verdict> {
    let path = take.media_path();
    let found = match take.manifest.source {
        SourceKind::Images if path.is_dir() => {
            let reader = Reader::open(&path)?;
            let hashes =
                reader.image_files().iter().map(|f| media::copy(f, None, reporter)).collect::<Result<Vec<_>>>()?;
            Some(media::hash_of_hashes(&hashes))
        }
        SourceKind::Video | SourceKind::Camera if path.is_file() => Some(media::copy(&path, None, reporter)?),
        _ => None,
    };
    let name = path.display();
    Ok(match found {
        None => verdict("media", Level::Poor, format!("{name} is gone; put it back, or import the video again")),
        Some(hash) if hash != take.manifest.media_sha256 => {
            verdict("media", Level::Poor, format!("{name} has changed since the take was made; import it again"))
        }
        Some(_) => verdict("media", Level::Good, "the media are there and unchanged"),
    })
}
