//! Sharpness, exposure and repetition of every frame of a video.
//!
//! One thread decodes and compares neighbours, the workers of the thread pool measure: a bounded channel between them
//! keeps the memory constant, whatever the length of the video.

use std::sync::mpsc;

use rayon::iter::{ParallelBridge, ParallelIterator};
use risorius_formats::Reporter;
use risorius_formats::frame::{FrameIndex, FrameRecord};
use risorius_video::{Frame, Reader, Truncation};

use crate::quality::{self, Quality, Samples};
use crate::timing;
use crate::{CaptureError, Result};

/// The frames of a video, measured.
pub(crate) struct Pictures {
    pub(crate) frames: Vec<FrameRecord>,
    pub(crate) truncation: Option<Truncation>,
}

struct Measured {
    index: u32,
    timestamp_nanos: i64,
    quality: Quality,
}

/// Decodes a video to its end and measures every frame; drops are told from the times.
pub(crate) fn measure_all(reader: Reader, reporter: &dyn Reporter) -> Result<Pictures> {
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
            motion: m.index.checked_sub(1).and_then(|before| differences.get(before as usize)).copied(),
        })
        .collect()
}
