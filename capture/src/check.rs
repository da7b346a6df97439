//! What a take is worth: verdicts that a person can act on.

use risorius_formats::take::SourceKind;
use risorius_formats::{FrameRecord, Reporter, Take};
use risorius_video::Reader;
use serde::Serialize;

use crate::Result;
use crate::media;
use crate::timing::{self, median, quantile};

/// A frame below this share of the median sharpness around it is blurred.
const BLURRED_SHARE: f32 = 0.5;
/// Frames on each side that say how sharp is usual.
const AROUND: usize = 60;
/// Median sharpness below which the whole take is soft, squared 8-bit levels.
const SOFT: f32 = 15.0;
/// Mean luma outside this range is too dark or too bright.
const LUMA_RANGE: std::ops::RangeInclusive<f32> = 50.0..=205.0;
/// The picture may brighten or darken by so many levels over a take.
const LUMA_DRIFT: f32 = 20.0;
/// Share of pixels that may be black or white.
const CLIPPED: f32 = 0.05;
/// Below this rate blinks and quick lips fall between frames.
const GOOD_FPS: f64 = 59.0;
/// Fewer frames hardly make an avatar.
const FEW_FRAMES: u32 = 300;

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
    /// What it is about: `media`, `length`, `rate`, `dropped`, `repeated`, `jitter`, `sharpness`, `exposure`.
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
    /// Root mean square deviation of the intervals from what is usual, milliseconds.
    pub jitter_ms: Option<f64>,
    /// Frames missing according to the times.
    pub dropped_frames: u64,
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
    let mut report = CheckReport {
        frame_count: frames.len() as u32,
        duration_secs: times.last().map_or(0.0, |&t| t as f64 * 1e-9),
        fps_measured: timing::measured_fps(&times),
        jitter_ms: timing::jitter_nanos(&times).map(|j| j * 1e-6),
        dropped_frames: frames.iter().map(|f| u64::from(f.dropped_before)).sum(),
        longest_drop: frames.iter().map(|f| f.dropped_before).max().unwrap_or(0),
        repeated_frames: frames.iter().filter(|f| f.repeated).count() as u32,
        sharpness_median: median(&sharpness),
        sharpness_low: quantile(&sharpness, 0.05),
        blurred_frames: blurred_frames(frames).len() as u32,
        luma_median: median(&luma),
        luma_drift: quantile(&luma, 0.95).zip(quantile(&luma, 0.05)).map(|(high, low)| high - low),
        clipped_median: median(&clipped),
        media_intact: media.level == Level::Good,
        overall: Level::Good,
        verdicts: vec![media],
    };
    let from_images = take.manifest.source == SourceKind::Images;
    let (rate, jitter, sharp) = (rate(&report, from_images), jitter(&report), sharp(&report, frames));
    let times = [Some(length(&report)), rate, Some(dropped(&report, frames)), Some(repeated(&report)), jitter, sharp];
    report.verdicts.extend(times.into_iter().flatten());
    report.verdicts.extend(exposure(&report));
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

fn verdict(topic: &'static str, level: Level, message: impl Into<String>) -> Verdict {
    Verdict { topic, level, message: message.into() }
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

fn length(r: &CheckReport) -> Verdict {
    let text = format!("{} frames, {:.1} s", r.frame_count, r.duration_secs);
    if r.frame_count < FEW_FRAMES {
        verdict("length", Level::Fair, format!("{text}: short; 20 s or more show every expression from several sides"))
    } else {
        verdict("length", Level::Good, text)
    }
}

fn rate(r: &CheckReport, from_images: bool) -> Option<Verdict> {
    if from_images || r.fps_measured <= 0.0 {
        return None;
    }
    let text = format!("{:.2} frames/s", r.fps_measured);
    Some(if r.fps_measured < GOOD_FPS {
        verdict(
            "rate",
            Level::Fair,
            format!("{text}: blinks and quick lips fall between frames; record at 60 or 120 if the camera can"),
        )
    } else {
        verdict("rate", Level::Good, text)
    })
}

fn dropped(r: &CheckReport, frames: &[FrameRecord]) -> Verdict {
    if r.dropped_frames == 0 {
        return verdict("dropped", Level::Good, "no frames are missing");
    }
    let share = r.dropped_frames as f64 / (r.dropped_frames as f64 + f64::from(r.frame_count));
    let worst = frames.iter().find(|f| f.dropped_before == r.longest_drop).map_or(0, |f| f.index.0);
    let level = if share > 0.02 || r.longest_drop > 12 { Level::Poor } else { Level::Fair };
    verdict(
        "dropped",
        level,
        format!(
            "{} frames are missing ({:.1} %), at most {} in a row, before frame {worst}: record to a faster disk, with nothing else running",
            r.dropped_frames,
            100.0 * share,
            r.longest_drop
        ),
    )
}

fn repeated(r: &CheckReport) -> Verdict {
    let share = f64::from(r.repeated_frames) / f64::from(r.frame_count.max(1));
    let text = format!("{} frames repeat the one before ({:.1} %)", r.repeated_frames, 100.0 * share);
    match r.repeated_frames {
        0 => verdict("repeated", Level::Good, "no frame repeats the one before"),
        _ if share > 0.1 => verdict(
            "repeated",
            Level::Poor,
            format!("{text}: the camera gives fewer frames than the file claims; record at its true rate"),
        ),
        _ => verdict("repeated", Level::Fair, format!("{text}: more light lets the camera keep its rate")),
    }
}

fn jitter(r: &CheckReport) -> Option<Verdict> {
    let jitter = r.jitter_ms?;
    let share = jitter * 1e-3 * r.fps_measured;
    let text = format!("frames come {jitter:.2} ms off their time (rms)");
    Some(if share > 0.1 {
        verdict(
            "jitter",
            Level::Fair,
            format!(
                "{text}, {:.0} % of an interval: times are used as they are, but lock the frame rate if the camera can",
                100.0 * share
            ),
        )
    } else {
        verdict("jitter", Level::Good, text)
    })
}

fn sharp(r: &CheckReport, frames: &[FrameRecord]) -> Option<Verdict> {
    let median = r.sharpness_median?;
    let share = f64::from(r.blurred_frames) / f64::from(r.frame_count.max(1));
    let where_to_look = || {
        let first = blurred_frames(frames).iter().take(5).map(u32::to_string).collect::<Vec<_>>().join(", ");
        format!("{} frames are blurred ({:.1} %), such as {first}", r.blurred_frames, 100.0 * share)
    };
    Some(if median < SOFT {
        verdict(
            "sharpness",
            Level::Poor,
            format!("the pictures are soft ({median:.0}): clean the lens, focus on the eyes, add light"),
        )
    } else if share > 0.05 {
        verdict("sharpness", Level::Poor, format!("{}: move more slowly, or use a shorter exposure", where_to_look()))
    } else if r.blurred_frames > 0 {
        verdict("sharpness", Level::Fair, format!("{}: the dataset prefers their neighbours", where_to_look()))
    } else {
        verdict("sharpness", Level::Good, format!("evenly sharp ({median:.0})"))
    })
}

fn exposure(r: &CheckReport) -> Vec<Verdict> {
    let (Some(luma), Some(drift), Some(clipped)) = (r.luma_median, r.luma_drift, r.clipped_median) else {
        return Vec::new();
    };
    let mut out = Vec::new();
    if luma < *LUMA_RANGE.start() {
        out.push(verdict(
            "exposure",
            Level::Fair,
            format!("dark (mean luma {luma:.0} of 255): add light or open the exposure"),
        ));
    } else if luma > *LUMA_RANGE.end() {
        out.push(verdict(
            "exposure",
            Level::Fair,
            format!("bright (mean luma {luma:.0} of 255): reduce the light or the exposure"),
        ));
    }
    if clipped > CLIPPED {
        let percent = 100.0 * clipped;
        out.push(verdict(
            "exposure",
            Level::Fair,
            format!("{percent:.0} % of the pixels are black or white: softer light keeps the skin's detail"),
        ));
    }
    if drift > LUMA_DRIFT {
        out.push(verdict(
            "exposure",
            Level::Fair,
            format!("brightness wanders by {drift:.0} levels: lock exposure and white balance"),
        ));
    }
    if out.is_empty() {
        out.push(verdict(
            "exposure",
            Level::Good,
            format!("mean luma {luma:.0} of 255, {:.1} % clipped", 100.0 * clipped),
        ));
    }
    out
}
