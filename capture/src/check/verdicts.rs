//! From figures to sentences that a person can act on.

use risorius_formats::FrameRecord;

use super::{CheckReport, Level, Verdict, blurred_frames};

/// Median sharpness below which the whole take is soft, squared 8-bit levels.
const SOFT: f32 = 15.0;
/// Mean luma outside this range is too dark or too bright.
const LUMA_RANGE: std::ops::RangeInclusive<f32> = 50.0..=205.0;
/// The picture may brighten or darken by so many levels over a take.
const LUMA_DRIFT: f32 = 20.0;
/// Share of pixels that may be black or white.
const CLIPPED: f32 = 0.05;
/// A camera keeps its rate if it gives this share of it.
const RATE_KEPT: f64 = 0.97;
/// Below this rate blinks and quick lips fall between frames.
const GOOD_FPS: f64 = 59.0;
/// Fewer frames hardly make an avatar.
const FEW_FRAMES: u32 = 300;

/// Brightness may pulse by this share of its mean …
const FLICKER: f64 = 0.01;
/// … and by so much it spoils colours.
const STRONG_FLICKER: f64 = 0.04;
/// Share of the sharpness that motion may cost.
const MOTION_BLUR: f32 = 0.35;
/// An orbit should show the head from so many degrees.
const GOOD_ORBIT: f64 = 50.0;
/// From fewer the depth is hardly known.
const POOR_ORBIT: f64 = 20.0;

pub(super) fn verdict(topic: &'static str, level: Level, message: impl Into<String>) -> Verdict {
    Verdict { topic, level, message: message.into() }
}

/// A verdict for each side but the media.
pub(super) fn all(r: &CheckReport, frames: &[FrameRecord], from_images: bool) -> Vec<Verdict> {
    let times = [Some(length(r)), rate(r, from_images), Some(dropped(r, frames)), Some(repeated(r)), jitter(r)];
    let pictures = [sharp(r, frames), motion_blur(r)];
    let mut out: Vec<Verdict> = times.into_iter().chain(pictures).flatten().collect();
    out.extend(exposure(r));
    out.extend(flicker(r).into_iter().chain(upright(r)).chain(orbit(r)));
    out
}

fn motion_blur(r: &CheckReport) -> Option<Verdict> {
    let blur = r.motion_blur?;
    let percent = 100.0 * blur;
    Some(if blur > MOTION_BLUR {
        let advice = "move more slowly, or use a shorter exposure and more light";
        verdict("motion-blur", Level::Fair, format!("motion costs {percent:.0} % of the sharpness: {advice}"))
    } else {
        verdict("motion-blur", Level::Good, format!("motion costs {:.0} % of the sharpness", percent.max(0.0)))
    })
}

fn flicker(r: &CheckReport) -> Option<Verdict> {
    let luma = f64::from(r.luma_median?);
    let Some(found) = r.flicker.filter(|f| f.amplitude > FLICKER * luma) else {
        return Some(verdict("flicker", Level::Good, "the light is steady"));
    };
    let level = if found.amplitude > STRONG_FLICKER * luma { Level::Poor } else { Level::Fair };
    let advice = match found.mains_hz {
        Some(hz) => format!(
            "lamps on the mains of {hz} Hz; use daylight or flicker-free lamps, or an exposure that is a multiple of {:.1} ms",
            500.0 / f64::from(hz)
        ),
        None => "look for a lamp that is dimmed, or lock the exposure".to_owned(),
    };
    let text =
        format!("the brightness pulses {:.1} times a second by {:.1} levels", found.frequency_hz, found.amplitude);
    Some(verdict("flicker", level, format!("{text}: {advice}")))
}

/// Only said where the face does not stand upright.
fn upright(r: &CheckReport) -> Option<Verdict> {
    let roll = r.orbit.as_ref()?.roll_degrees?;
    // Clockwise quarter turns that the face is away from upright.
    let quarters = (roll / 90.0).round() as i64;
    let back = 90 * (-quarters).rem_euclid(4);
    let lies = if back == 180 { "stands on its head" } else { "lies on its side" };
    let text = format!("the face {lies}: record it again with `--rotate {back}`");
    (back != 0).then(|| verdict("upright", Level::Poor, text))
}

fn orbit(r: &CheckReport) -> Option<Verdict> {
    let orbit = r.orbit.as_ref()?;
    let text = format!("the head is seen from {:.0}° left to right", orbit.yaw_range_degrees);
    let lost = 1.0 - orbit.tracked_share;
    let holes: Vec<String> = orbit.missing_views_degrees.iter().map(|d| format!("{d:.0}°")).collect();
    Some(if orbit.yaw_range_degrees < POOR_ORBIT {
        verdict("orbit", Level::Poor, format!("{text}: too little for depth; record a slow orbit of 60° or more"))
    } else if orbit.yaw_range_degrees < GOOD_ORBIT {
        verdict("orbit", Level::Fair, format!("{text}: a slow orbit of 60° or more gives better views from the side"))
    } else if !holes.is_empty() {
        verdict("orbit", Level::Fair, format!("{text}, but hardly at {}: move more evenly", holes.join(", ")))
    } else if lost > 0.1 {
        verdict("orbit", Level::Fair, format!("{text}, but the face is lost in {:.0} % of the frames", 100.0 * lost))
    } else {
        verdict("orbit", Level::Good, text)
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
    // What is missing is told elsewhere; this is about what the camera gave.
    let given = r.fps_measured * (1.0 + r.dropped_frames as f64 / f64::from(r.frame_count.max(1)));
    if let Some(asked) = r.fps_asked.filter(|asked| r.lost_by_driver.is_some() && given < RATE_KEPT * asked) {
        let advice = "the camera lowers its rate in dim light: add light, or shorten the exposure";
        return Some(verdict("rate", Level::Fair, format!("{text} instead of {asked:.0}: {advice}")));
    }
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
    let (lost, discarded) = (r.lost_by_driver.unwrap_or(0), r.discarded.unwrap_or(0));
    let advice = if discarded > lost {
        "the disk was too slow: record to a faster one"
    } else if lost > 0 {
        "the camera's driver lost them: use a port of the computer itself, and close other programs"
    } else if r.corrupt.unwrap_or(0) > 0 {
        "they came broken: try another cable or port"
    } else {
        "record to a faster disk, with nothing else running"
    };
    verdict(
        "dropped",
        level,
        format!(
            "{} frames are missing ({:.1} %), at most {} in a row, before frame {worst}: {advice}",
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
