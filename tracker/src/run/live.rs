//! `tracker live`: rows of a track as they come, from a camera or from a video at its own pace.
//!
//! A camera does not wait. One thread takes pictures and keeps the newest; the networks take that one when they are done
//! with the one before, so that a row is never older than two pictures. What a run over a whole video knows from the
//! start is learned on the way: the person's shape from the first frames, the person's rest from all frames before.

use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::{Condvar, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use image::RgbImage;
use risorius_formats::au::OPENFACE_INTENSITIES;
use risorius_formats::{FormatError, FrameIndex, Reporter, Take, Track};
use risorius_video::{Camera, Reader};
use serde::Serialize;

use super::follow::{FirstFace, Follower};
use super::observations::Observation;
use super::open_networks;
use super::rows::{Pieces, RowMaker};
use crate::aus::{Calibration, Person};
use crate::error::{Result, TrackerError};
use crate::gaze::Gazer;
use crate::head_pose::Lens;
use crate::poses::triangulate::median;
use crate::weights::Weights;

/// Where pictures come from.
#[derive(Clone, Debug)]
pub enum LiveSource {
    /// A camera by its number (`/dev/video0` is 0), asked for a size and a rate.
    Camera {
        /// Its number.
        number: i32,
        /// Width and height, pixels.
        size: (u32, u32),
        /// Frames per second.
        fps: f64,
    },
    /// A video as if it were a camera: at its own pace.
    Video(PathBuf),
    /// Every frame of a video, however long that takes.
    EveryFrame(PathBuf),
}

/// How to track live.
#[derive(Clone, Debug)]
pub struct LiveOptions {
    /// Folder with `models.toml`; `None` is [`crate::models::default_dir`].
    pub models: Option<PathBuf>,
    /// Threads for the networks; a single face rarely uses more than one.
    pub threads: usize,
    /// Which face is followed where there are several.
    pub face: FirstFace,
    /// Focal length of the camera, pixels; `None` is 1.2 × the longer side.
    pub focal_px: Option<f64>,
    /// Stops after so many rows.
    pub frames: Option<u64>,
}

/// What was tracked.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct LiveSummary {
    /// Rows written.
    pub frames: u64,
    /// Rows without a face.
    pub lost: u64,
    /// Pictures that came while the networks were busy, and were passed over.
    pub passed_over: u64,
    /// Rows per second.
    pub fps: f64,
    /// From a picture's arrival to its row, median, milliseconds.
    pub latency_ms: f64,
}

/// Frames after which the person's shape is fitted, again with each.
const SHAPE_AT: [usize; 4] = [8, 30, 90, 240];
/// How long to wait for a picture before looking whether the user has stopped it.
const PATIENCE: Duration = Duration::from_millis(100);
/// Latencies that are kept for the median.
const LATENCIES: usize = 4096;

/// A picture on its way.
struct Picture {
    index: u32,
    arrived: Instant,
    secs: f64,
    image: RgbImage,
}

/// What lies between the thread that takes pictures and the one that tracks.
#[derive(Default)]
struct Slot {
    newest: Option<Picture>,
    passed_over: u64,
    ended: bool,
    problem: Option<TrackerError>,
    /// Nobody wants pictures any more.
    closed: bool,
}

#[derive(Default)]
struct Exchange {
    slot: Mutex<Slot>,
    changed: Condvar,
}

impl Exchange {
    /// Puts a picture into the slot: over one that waits, or behind it. False when nobody wants it.
    fn offer(&self, picture: Picture, wait: bool) -> bool {
        let mut slot = self.slot.lock().unwrap_or_else(PoisonError::into_inner);
        while wait && slot.newest.is_some() && !slot.closed {
            slot = self.changed.wait(slot).unwrap_or_else(PoisonError::into_inner);
        }
        slot.passed_over += u64::from(slot.newest.is_some());
        slot.newest = Some(picture);
        self.changed.notify_all();
        !slot.closed
    }

    fn end(&self, result: Result<()>) {
        let mut slot = self.slot.lock().unwrap_or_else(PoisonError::into_inner);
        slot.ended = true;
        slot.problem = result.err();
        self.changed.notify_all();
    }

    fn close(&self) -> u64 {
        let mut slot = self.slot.lock().unwrap_or_else(PoisonError::into_inner);
        slot.closed = true;
        self.changed.notify_all();
        slot.passed_over
    }

    /// The newest picture; `None` when there will be none, or the user stops.
    fn take(&self, reporter: &dyn Reporter) -> Result<Option<Picture>> {
        let mut slot = self.slot.lock().unwrap_or_else(PoisonError::into_inner);
        loop {
            if reporter.cancelled() {
                return Ok(None);
            }
            if let Some(picture) = slot.newest.take() {
                self.changed.notify_all();
                return Ok(Some(picture));
            }
            if let Some(problem) = slot.problem.take() {
                return Err(problem);
            }
            if slot.ended {
                return Ok(None);
            }
            slot = self.changed.wait_timeout(slot, PATIENCE).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

/// Closes the exchange however tracking ends, so that the other thread ends too.
struct Closing<'a>(&'a Exchange);

impl Drop for Closing<'_> {
    fn drop(&mut self) {
        self.0.close();
    }
}

/// Tracks until the source or the reader of `out` ends, or the user stops it, and writes an OpenFace table to `out`, each
/// row as soon as it is known. `name` is what errors call `out`.
pub fn live(
    source: &LiveSource,
    options: &LiveOptions,
    out: &mut dyn Write,
    name: &Path,
    reporter: &dyn Reporter,
) -> Result<LiveSummary> {
    let (_, mut follower) = open_networks(options.models.as_deref(), options.threads, options.face, None)?;
    reporter.stage("live", options.frames);
    let exchange = Exchange::default();
    thread::scope(|scope| {
        let takes = || exchange.end(take_pictures(source, &exchange));
        thread::Builder::new()
            .name("pictures".to_owned())
            .spawn_scoped(scope, takes)
            .map_err(|e| TrackerError::Threads { message: e.to_string() })?;
        let closing = Closing(&exchange);
        let mut summary = track(&mut follower, options, &exchange, out, name, reporter)?;
        drop(closing);
        summary.passed_over = exchange.close();
        Ok(summary)
    })
}

fn track(
    follower: &mut Follower,
    options: &LiveOptions,
    exchange: &Exchange,
    out: &mut dyn Write,
    name: &Path,
    reporter: &dyn Reporter,
) -> Result<LiveSummary> {
    let units = OPENFACE_INTENSITIES.to_vec();
    let mut pieces = Pieces::default();
    let mut maker: Option<RowMaker> = None;
    let mut seen: Vec<[[f32; 2]; 68]> = Vec::new();
    let mut summary = LiveSummary::default();
    let mut latencies: Vec<f64> = Vec::new();
    let mut started = None;
    while options.frames.is_none_or(|n| summary.frames < n) {
        let Some(picture) = exchange.take(reporter)? else { break };
        let began = *started.get_or_insert(picture.arrived);
        let maker = maker.get_or_insert_with(|| {
            let lens = Lens::new(picture.image.width(), picture.image.height(), options.focal_px);
            let person = follower.readout().map(|r| Person::learn(r, &[], Calibration::Online));
            RowMaker {
                lens,
                shape: Weights::get().shape.fit(&lens, &[]),
                person,
                au_model: follower.au_model(),
                eyes: Gazer::learn(&[], Calibration::Online),
                before: None,
                pitch_apart: (0.0, 0),
                clip: None,
            }
        });
        let found = follower.block(std::slice::from_ref(&picture.image))?.pop().flatten();
        let observation = found.map(Observation::from);
        if let Some(o) = observation.as_ref().filter(|_| seen.len() < SHAPE_AT[SHAPE_AT.len() - 1]) {
            seen.push(o.points_px);
            if SHAPE_AT.contains(&seen.len()) {
                // The later fits see more of the person; all are of a few dozen frames, and short.
                let step = seen.len().div_ceil(SHAPE_AT[1]);
                let some: Vec<_> = seen.iter().step_by(step).copied().collect();
                maker.shape = Weights::get().shape.fit(&maker.lens, &some);
            }
        }
        let (row, extra) = maker.row(FrameIndex(picture.index), picture.secs, observation.as_ref());
        summary.lost += u64::from(!row.success);
        summary.frames += 1;
        let piece = Track { units: units.clone(), presence_units: units.clone(), rows: vec![row] };
        match out.write_all(&pieces.lines(&piece, &[extra])?).and_then(|()| out.flush()) {
            Ok(()) => {}
            // Whoever read the rows has seen enough.
            Err(e) if e.kind() == ErrorKind::BrokenPipe => break,
            Err(e) => return Err(FormatError::io(name, "write", &e).into()),
        }
        if latencies.len() < LATENCIES {
            latencies.push(picture.arrived.elapsed().as_secs_f64() * 1e3);
        }
        summary.fps = summary.frames as f64 / began.elapsed().as_secs_f64().max(1e-9);
        reporter.advance(1);
    }
    summary.latency_ms = median(&mut latencies).unwrap_or(0.0);
    Ok(summary)
}

/// Takes pictures until the source ends or nobody wants them.
fn take_pictures(source: &LiveSource, exchange: &Exchange) -> Result<()> {
    match source {
        LiveSource::Camera { number, size, fps } => {
            let gone = |what: &str| TrackerError::Camera { number: *number, what: what.to_owned() };
            let mut camera = Camera::open(*number).ok_or_else(|| gone("cannot be opened"))?;
            camera.start(size.0, size.1, *fps);
            let began = Instant::now();
            for index in 0.. {
                let Some(image) = camera.grab() else {
                    return Err(gone(if index == 0 { "gives no pictures" } else { "gives no more pictures" }));
                };
                let arrived = Instant::now();
                let secs = arrived.duration_since(began).as_secs_f64();
                if !exchange.offer(Picture { index, arrived, secs, image }, false) {
                    break;
                }
            }
            Ok(())
        }
        LiveSource::Video(path) | LiveSource::EveryFrame(path) => {
            let in_time = matches!(source, LiveSource::Video(_));
            let is_take = path.join("take.toml").is_file();
            let mut reader = if is_take { Reader::open_take(&Take::open(path)?)? } else { Reader::open(path)? };
            let mut began = None;
            while let Some(frame) = reader.next_frame()? {
                let secs = frame.timestamp_nanos as f64 * 1e-9;
                let due = *began.get_or_insert_with(Instant::now) + Duration::from_secs_f64(secs.max(0.0));
                if in_time {
                    thread::sleep(due.saturating_duration_since(Instant::now()));
                }
                let picture = Picture { index: frame.index, arrived: Instant::now(), secs, image: frame.image };
                if !exchange.offer(picture, !in_time) {
                    break;
                }
            }
            Ok(())
        }
    }
}

#[cfg(test)]
mod tests {
    use risorius_formats::Silent;

    use super::*;

    fn picture(index: u32) -> Picture {
        Picture { index, arrived: Instant::now(), secs: 0.0, image: RgbImage::new(1, 1) }
    }

    #[test]
    fn the_newest_picture_is_taken_and_those_before_are_counted() {
        let exchange = Exchange::default();
        assert!((0..3).all(|i| exchange.offer(picture(i), false)));
        assert_eq!(exchange.take(&Silent).unwrap().unwrap().index, 2);
        exchange.end(Ok(()));
        assert!(exchange.take(&Silent).unwrap().is_none());
        assert_eq!(exchange.close(), 2);
        assert!(!exchange.offer(picture(3), false), "nobody listens any more");
    }

    #[test]
    fn every_picture_waits_its_turn_when_none_may_be_lost() {
        let exchange = Exchange::default();
        thread::scope(|scope| {
            scope.spawn(|| {
                (0..20).for_each(|i| assert!(exchange.offer(picture(i), true)));
                exchange.end(Err(TrackerError::Camera { number: 3, what: "broke".to_owned() }));
            });
            let seen: Vec<u32> = (0..20).map(|_| exchange.take(&Silent).unwrap().unwrap().index).collect();
            assert_eq!(seen, (0..20).collect::<Vec<_>>());
            let said = exchange.take(&Silent).err().unwrap().to_string();
            assert!(said.contains("camera 3") && said.contains("broke"), "{said}");
        });
        assert_eq!(exchange.close(), 0);
    }
}
