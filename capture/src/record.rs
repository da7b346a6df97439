//! A video file or an image folder to a take.
//!
//! The media are copied and hashed while the frames are decoded and measured.

use std::path::{Path, PathBuf};
use std::time::Instant;

use risorius_formats::atomic::{AtomicDir, check_replaceable};
use risorius_formats::frame::{self, FrameRecord};
use risorius_formats::take::{SourceKind, TAKE_VERSION};
use risorius_formats::{FormatError, Reporter, TakeManifest, Warning};
use risorius_video::{Reader, TimeSource, VideoInfo};
use serde::Serialize;

use crate::measure::{Pictures, measure_all};
use crate::media::{self, Media};
use crate::negotiate::number;
use crate::{CaptureError, Result, numbered, timing};

/// What to make a take from, and how.
#[derive(Clone, Debug, Default)]
pub struct RecordOptions {
    /// A video file or a folder of images.
    pub input: PathBuf,
    /// The take's folder.
    pub out: PathBuf,
    /// Refer to the input by its absolute path instead of copying it.
    pub link: bool,
    /// Replace a take that is there.
    pub force: bool,
    /// Who is seen.
    pub subject: String,
    /// Under which consent it was recorded.
    pub consent: String,
    /// Frame rate of an image folder (30 when `None`) or of a stream without times, such as raw H.264.
    pub image_fps: Option<f64>,
    /// Turns the pictures clockwise, beyond what the file asks for: 0, 90, 180 or 270 degrees.
    pub turn_degrees: u32,
    /// Frames per second at which a slow-motion clip was filmed; its metadata tell when `None`.
    pub true_fps: Option<f64>,
}

/// What a take turned out to be.
#[derive(Clone, Debug, Serialize)]
pub struct RecordSummary {
    /// The take's folder.
    pub take: PathBuf,
    /// `take.toml`.
    pub manifest: TakeManifest,
    /// From the first to the last frame, seconds.
    pub duration_secs: f64,
    /// Median of the frames' sharpness, squared 8-bit levels.
    pub sharpness_median: Option<f32>,
    /// Median of the frames' mean luma, 0–255.
    pub luma_median: Option<f32>,
    /// Median of the frames' clipped share, 0–1.
    pub clipped_median: Option<f32>,
    /// How many times slower than filmed a slow-motion clip plays; the take's times are those of filming.
    pub slow_motion: Option<f64>,
    /// How many frames the container announces, when the file ends before them.
    pub truncated_from: Option<u64>,
    /// How long it took, seconds.
    pub elapsed_secs: f64,
}

/// What a take would be made of, as far as the container tells.
#[derive(Clone, Debug, Serialize)]
pub struct Rehearsal {
    /// Upright width, pixels.
    pub width: u32,
    /// Upright height, pixels.
    pub height: u32,
    /// Rotation that is applied, degrees clockwise.
    pub rotation_degrees: u32,
    /// Frames per second as the take would have them.
    pub fps: f64,
    /// Number of frames, an estimate for containers other than MP4 and MOV.
    pub frame_count_estimate: Option<u64>,
    /// How many times slower than filmed it plays.
    pub slow_motion: Option<f64>,
    /// How the pictures are coded, such as `yuv420p, BT.709, limited range`; empty for image folders.
    pub coding: String,
    /// What the stream is and what is done to its pictures.
    pub remarks: Vec<String>,
}

/// Says what [`record`] would make; touches nothing.
pub fn rehearse(options: &RecordOptions) -> Result<Rehearsal> {
    let reader = open(options)?;
    check_output(options)?;
    let info = reader.info();
    let slow_motion = if reader.is_image_folder() { None } else { slow_motion(info, options.true_fps) };
    Ok(Rehearsal {
        width: info.width,
        height: info.height,
        rotation_degrees: info.rotation_degrees,
        fps: info.fps * slow_motion.unwrap_or(1.0),
        frame_count_estimate: info.frame_count_estimate,
        slow_motion,
        coding: info.coding.clone(),
        remarks: info.remarks.iter().map(|r| r.text.clone()).collect(),
    })
}

/// Opens the input, turned as asked.
fn open(options: &RecordOptions) -> Result<Reader> {
    let mut reader = Reader::open_with_fps(&options.input, options.image_fps)?;
    if reader.info().times == TimeSource::Unknown {
        return Err(CaptureError::NoTimes { path: options.input.clone() });
    }
    reader.turn(options.turn_degrees);
    Ok(reader)
}

/// Makes a take from a video file or an image folder; the folder appears whole or not at all.
pub fn record(options: &RecordOptions, reporter: &dyn Reporter) -> Result<RecordSummary> {
    record_with(options, reporter, |_| Ok(()))
}

/// As [`record`]; `add` may write more into the folder before it comes to its place.
pub fn record_with(
    options: &RecordOptions,
    reporter: &dyn Reporter,
    add: impl FnOnce(&Path) -> std::result::Result<(), FormatError>,
) -> Result<RecordSummary> {
    let begun = Instant::now();
    let reader = open(options)?;
    check_output(options)?;
    let info = reader.info().clone();
    let is_folder = reader.is_image_folder();
    let images = reader.image_files().to_vec();
    let slow_motion = if is_folder { None } else { slow_motion(&info, options.true_fps) };
    tell(options, &info, slow_motion, reporter);
    let dir = AtomicDir::create(&options.out)?;
    reporter.stage("reading frames", info.frame_count_estimate);
    let (media, pictures) = std::thread::scope(|scope| {
        let copying = scope.spawn(|| {
            if is_folder {
                media::take_images(&options.input, &images, dir.path(), options.link, reporter)
            } else {
                media::take_video(&options.input, dir.path(), options.link, reporter)
            }
        });
        let pictures = measure_all(reader, reporter);
        let media = copying.join().unwrap_or(Err(CaptureError::Thread { part: "copying" }));
        // Of two errors, the one about the pictures says more.
        pictures.and_then(|p| media.map(|m| (m, p)))
    })?;
    if let Some(cut) = pictures.truncation {
        let name = options.input.display();
        let lost_later = cut.expected > u64::from(cut.read) + u64::from(cut.lost_at_start);
        if cut.lost_at_start > 0 {
            let message = format!(
                "{name}: begins between two keyframes: the first {} of {} frames cannot be decoded; the take begins after them",
                cut.lost_at_start, cut.expected
            );
            reporter.warn(Warning::new("late-keyframe", message));
        }
        if lost_later {
            let message = format!(
                "{name}: is truncated: {} of {} frames could be read; the take has these",
                cut.read, cut.expected
            );
            reporter.warn(Warning::new("truncated-video", message));
        }
    }
    let Pictures { mut frames, truncation } = pictures;
    if is_folder {
        numbered::warn_about_strangers(&options.input, &images, reporter);
        numbered::spread(&mut frames, &images, info.fps, reporter);
    }
    if let Some(factor) = slow_motion {
        for frame in &mut frames {
            frame.timestamp_nanos = (frame.timestamp_nanos as f64 / factor).round() as i64;
        }
    }
    let fps_asked = slow_motion.unwrap_or(1.0) * info.fps;
    let manifest = manifest(options, &info, is_folder, fps_asked, media, &frames);
    frame::write_frames(dir.path().join("frames.csv"), &frames)?;
    manifest.write(dir.path().join("take.toml"))?;
    if reporter.cancelled() {
        return Err(CaptureError::Interrupted);
    }
    add(dir.path())?;
    dir.commit()?;
    let of =
        |pick: fn(&FrameRecord) -> Option<f32>| timing::median(&frames.iter().filter_map(pick).collect::<Vec<_>>());
    Ok(RecordSummary {
        take: options.out.clone(),
        duration_secs: frames.last().map_or(0.0, |f| f.timestamp_nanos as f64 * 1e-9),
        sharpness_median: of(|f| f.sharpness),
        luma_median: of(|f| f.luma_mean),
        clipped_median: of(|f| f.clipped_share),
        slow_motion,
        truncated_from: truncation.map(|t| t.expected),
        manifest,
        elapsed_secs: begun.elapsed().as_secs_f64(),
    })
}

/// Says what the file is and what was made of it.
fn tell(options: &RecordOptions, info: &VideoInfo, slow_motion: Option<f64>, reporter: &dyn Reporter) {
    let name = options.input.display();
    for remark in &info.remarks {
        let text = format!("{name}: {}", remark.text);
        if remark.is_warning { reporter.warn(Warning::new(remark.code, text)) } else { reporter.note(&text) }
    }
    match info.times {
        TimeSource::Container if options.image_fps.is_some() => reporter.warn(Warning::new(
            "fps-ignored",
            format!("{name}: the frame rate is for image folders; a video has its own times"),
        )),
        TimeSource::StreamRate => reporter.warn(Warning::new(
            "no-times",
            format!(
                "{name}: has no times, only a rate in its header ({:.2} frames/s), which is taken; `--fps` states another",
                info.fps
            ),
        )),
        _ => {}
    }
    let Some(factor) = slow_motion else { return };
    let rates = format!(
        "slow motion: plays {:.2} frames/s, filmed at {:.2}; the times are those of filming",
        info.peak_fps,
        factor * info.peak_fps
    );
    if options.true_fps.is_none() && factor < SURELY_SLOWED {
        let text = format!(
            "{name}: {rates}; a camera that halved its rate in dim light writes the same: if it did, say \
             `--true-fps {}`",
            number(info.fps)
        );
        reporter.warn(Warning::new("perhaps-slow-motion", text));
    } else {
        reporter.note(&rates);
    }
}

/// Slow motion is slower than this; no player slows a clip by less than a half.
const SLOWED: f64 = 1.9;
/// A camera in dim light halves its rate at most.
const SURELY_SLOWED: f64 = 2.1;

/// How many times slower than filmed a clip plays: by `true_fps`, or by its metadata against the rate of its shortest usual
/// interval. A phone's clip that says 240 and plays 240 was not slowed, nor one whose mean rate is lower for dim light.
fn slow_motion(info: &VideoInfo, true_fps: Option<f64>) -> Option<f64> {
    let factor = match true_fps {
        Some(fps) => fps / info.fps,
        None => Some(info.capture_fps? / info.peak_fps).filter(|f| *f >= SLOWED)?,
    };
    (factor.is_finite() && factor > 0.0 && (factor - 1.0).abs() > 1e-6).then_some(factor)
}

/// Refuses to replace what is not to be replaced.
fn check_output(options: &RecordOptions) -> Result<()> {
    let out = &options.out;
    if out.symlink_metadata().is_err() {
        return Ok(());
    }
    if !options.force {
        return Err(CaptureError::Exists { path: out.clone() });
    }
    check_replaceable(out, "a take", &["take.toml"])?;
    let canonical = |path: &Path| std::fs::canonicalize(path).map_err(|e| FormatError::io(path, "open", &e));
    if canonical(&options.input)?.starts_with(canonical(out)?) {
        return Err(CaptureError::InputInsideOutput { input: options.input.clone(), out: out.clone() });
    }
    Ok(())
}

fn manifest(
    options: &RecordOptions,
    info: &VideoInfo,
    is_folder: bool,
    fps_asked: f64,
    media: Media,
    frames: &[FrameRecord],
) -> TakeManifest {
    let times: Vec<i64> = frames.iter().map(|f| f.timestamp_nanos).collect();
    let name =
        std::path::absolute(&options.input).ok().and_then(|p| p.file_name().map(|n| n.to_string_lossy().into_owned()));
    TakeManifest {
        version: TAKE_VERSION,
        subject: options.subject.clone(),
        consent: options.consent.clone(),
        source: if is_folder { SourceKind::Images } else { SourceKind::Video },
        media: media.path,
        media_sha256: media.sha256,
        original_name: name.unwrap_or_default(),
        device: None,
        width: info.width,
        height: info.height,
        rotation_degrees: info.rotation_degrees,
        fps_asked: Some(fps_asked),
        fps_measured: timing::measured_fps(&times),
        frame_count: frames.len() as u32,
        dropped_frames: frames.iter().map(|f| f.dropped_before).fold(0, u32::saturating_add),
        repeated_frames: frames.iter().filter(|f| f.repeated).count() as u32,
        written_by: concat!("capture ", env!("CARGO_PKG_VERSION")).to_owned(),
    }
}
