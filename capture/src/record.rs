//! A video file or an image folder to a take.
//!
//! One thread decodes and compares neighbours, the workers of the thread pool measure, one thread copies and hashes the
//! media: a bounded channel between them keeps the memory constant, whatever the length of the video.

use std::path::{Path, PathBuf};
use std::sync::mpsc;
use std::time::Instant;

use rayon::iter::{ParallelBridge, ParallelIterator};
use risorius_formats::atomic::{AtomicDir, check_replaceable};
use risorius_formats::frame::{self, FrameIndex, FrameRecord};
use risorius_formats::take::{SourceKind, TAKE_VERSION};
use risorius_formats::{FormatError, Reporter, TakeManifest, Warning};
use risorius_video::{Frame, Reader, Truncation};
use serde::Serialize;

use crate::media::{self, Media};
use crate::quality::{self, Quality, Samples};
use crate::timing;
use crate::{CaptureError, Result};

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
    /// Frame rate of an image folder; 30 when `None`.
    pub image_fps: Option<f64>,
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
    /// How many frames the container announces, when the file ends before them.
    pub truncated_from: Option<u64>,
    /// How long it took, seconds.
    pub elapsed_secs: f64,
}

/// Makes a take from a video file or an image folder; the folder appears whole or not at all.
pub fn record(options: &RecordOptions, reporter: &dyn Reporter) -> Result<RecordSummary> {
    let begun = Instant::now();
    let reader = Reader::open_with_fps(&options.input, options.image_fps)?;
    check_output(options)?;
    let info = reader.info().clone();
    let is_folder = reader.is_image_folder();
    let images = reader.image_files().to_vec();
    if !is_folder && options.image_fps.is_some() {
        reporter.warn(Warning::new(
            "fps-ignored",
            format!("{}: the frame rate is for image folders; a video has its own times", options.input.display()),
        ));
    }
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
        let message = format!(
            "{}: is truncated: {} of {} frames could be read; the take has these",
            options.input.display(),
            cut.read,
            cut.expected
        );
        reporter.warn(Warning::new("truncated-video", message));
    }
    let Pictures { frames, truncation } = pictures;
    let manifest = manifest(options, &info, is_folder, media, &frames);
    frame::write_frames(dir.path().join("frames.csv"), &frames)?;
    manifest.write(dir.path().join("take.toml"))?;
    if reporter.cancelled() {
        return Err(CaptureError::Interrupted);
    }
    dir.commit()?;
    let of =
        |pick: fn(&FrameRecord) -> Option<f32>| timing::median(&frames.iter().filter_map(pick).collect::<Vec<_>>());
    Ok(RecordSummary {
        take: options.out.clone(),
        duration_secs: frames.last().map_or(0.0, |f| f.timestamp_nanos as f64 * 1e-9),
        sharpness_median: of(|f| f.sharpness),
        luma_median: of(|f| f.luma_mean),
        clipped_median: of(|f| f.clipped_share),
        truncated_from: truncation.map(|t| t.expected),
        manifest,
        elapsed_secs: begun.elapsed().as_secs_f64(),
    })
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

struct Pictures {
    frames: Vec<FrameRecord>,
    truncation: Option<Truncation>,
}

struct Measured {
    index: u32,
    timestamp_nanos: i64,
    quality: Quality,
}

fn measure_all(reader: Reader, reporter: &dyn Reporter) -> Result<Pictures> {
    let depth = 2 * rayon::current_num_threads();
    let (sender, receiver) = mpsc::sync_channel::<Frame>(depth);
    std::thread::scope(|scope| {
        let decoding = scope.spawn(move || decode(reader, &sender, reporter));
        let mut measured: Vec<Measured> = receiver
            .into_iter()
            .par_bridge()
            .map(|frame| {
                let quality = quality::measure(&frame.image);
                reporter.advance(1);
                Measured { index: frame.index, timestamp_nanos: frame.timestamp_nanos, quality }
            })
            .collect();
        let (differences, truncation) = decoding.join().unwrap_or(Err(CaptureError::Thread { part: "decoding" }))?;
        measured.sort_unstable_by_key(|m| m.index);
        Ok(Pictures { frames: to_records(&measured, &differences), truncation })
    })
}

/// Decodes to the end; gives how much each frame differs from the one before.
fn decode(
    mut reader: Reader,
    sender: &mpsc::SyncSender<Frame>,
    reporter: &dyn Reporter,
) -> Result<(Vec<f32>, Option<Truncation>)> {
    let mut differences = Vec::new();
    let mut before: Option<Samples> = None;
    while let Some(frame) = reader.next_frame()? {
        if reporter.cancelled() {
            return Err(CaptureError::Interrupted);
        }
        let samples = Samples::of(&frame.image);
        if let Some(before) = before.replace(samples.clone()) {
            differences.push(samples.difference(&before));
        }
        if sender.send(frame).is_err() {
            return Err(CaptureError::Thread { part: "measuring" });
        }
    }
    Ok((differences, reader.truncation()))
}

fn to_records(measured: &[Measured], differences: &[f32]) -> Vec<FrameRecord> {
    let times: Vec<i64> = measured.iter().map(|m| m.timestamp_nanos).collect();
    let dropped = timing::dropped_before(&times);
    let repeated = timing::repeated(differences);
    let judged = dropped.into_iter().zip(repeated);
    measured
        .iter()
        .zip(judged)
        .map(|(m, (dropped_before, repeated))| FrameRecord {
            index: FrameIndex(m.index),
            timestamp_nanos: m.timestamp_nanos,
            dropped_before,
            repeated,
            sharpness: Some(m.quality.sharpness),
            luma_mean: Some(m.quality.luma_mean),
            clipped_share: Some(m.quality.clipped_share),
        })
        .collect()
}

fn manifest(
    options: &RecordOptions,
    info: &risorius_video::VideoInfo,
    is_folder: bool,
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
        fps_asked: Some(info.fps),
        fps_measured: timing::measured_fps(&times),
        frame_count: frames.len() as u32,
        dropped_frames: frames.iter().map(|f| f.dropped_before).fold(0, u32::saturating_add),
        repeated_frames: frames.iter().filter(|f| f.repeated).count() as u32,
        written_by: concat!("capture ", env!("CARGO_PKG_VERSION")).to_owned(),
    }
}
