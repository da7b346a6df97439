//! Recording from a live source into a take that is playable however the recording ends.

pub mod journal;
pub mod pipeline;
pub mod queue;

mod finish;
mod grab;
mod meter;
mod pack;
mod write;

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use risorius_formats::atomic::check_replaceable;
use risorius_formats::{FormatError, Reporter, TakeManifest, Warning};
use serde::Serialize;

pub use finish::{Finished, finish, measure_take, recover};
pub use meter::{Meter, Monitor, Undisturbed};
pub use pipeline::Ended;

use crate::controls::{self, Changed, Wishes};
use crate::negotiate::{Choice, Request, negotiate, same_rate};
use crate::preview::Preview;
use crate::script::Script;
use crate::source::{FrameSource, Grab, Grabbed, Started};
use crate::timing;
use crate::{CaptureError, Result};
use journal::{Journal, Recording};
use pipeline::{Plan, Totals};

/// The driver's buffers, at least.
pub const LEAST_BUFFERS: u32 = 8;
/// The driver's buffers for compressed frames unless something else is asked for: a quarter of a second at 120 fps.
const USUAL_BUFFERS: u32 = 32;
/// The same for raw frames, which need ten times the memory.
const USUAL_RAW_BUFFERS: u32 = 16;
/// What may wait for the disk unless something else is asked for.
pub const USUAL_MEMORY_BYTES: usize = 48 << 20;
/// Room for the tables of a take: 14,400 rows take 1.5 MB.
const RESERVED_BYTES: usize = 4 << 20;
/// After controls were set, frames of before are still on their way.
const SETTLE: Duration = Duration::from_millis(200);

/// What to record, and how.
#[derive(Clone, Debug)]
pub struct LiveOptions {
    /// The camera, as it was asked for.
    pub device: String,
    /// Size, rate and format.
    pub request: Request,
    /// Stop after this time; without it the user does.
    pub duration: Option<Duration>,
    /// The take's folder.
    pub out: PathBuf,
    /// Replace a take that is there.
    pub force: bool,
    /// Who is seen.
    pub subject: String,
    /// Under which consent.
    pub consent: String,
    /// The driver's buffers; as usual for the format when `None`.
    pub buffers: Option<u32>,
    /// Bytes that may wait for the disk.
    pub memory_bytes: usize,
    /// Frames of this time at the start are not recorded: the camera settles.
    pub warm_up: Duration,
    /// Exposure, focus, white balance.
    pub wishes: Wishes,
    /// What the person is asked to do.
    pub script: Option<Script>,
}

impl LiveOptions {
    /// A recording from `device` into `out`, with everything else as usual.
    pub fn new(device: &str, out: impl Into<PathBuf>) -> Self {
        Self {
            device: device.to_owned(),
            request: Request::default(),
            duration: None,
            out: out.into(),
            force: false,
            subject: String::new(),
            consent: String::new(),
            buffers: None,
            memory_bytes: USUAL_MEMORY_BYTES,
            warm_up: Duration::from_millis(500),
            wishes: Wishes::default(),
            script: None,
        }
    }
}

/// What a recording came to.
#[derive(Debug, Serialize)]
pub struct LiveSummary {
    /// The take's folder.
    pub take: PathBuf,
    /// `take.toml`.
    pub manifest: TakeManifest,
    /// Why it ended: `complete`, `stopped`, `camera` or `disk`.
    pub ended: &'static str,
    /// From the first to the last frame, seconds.
    pub duration_secs: f64,
    /// What the frames are made of.
    pub format: String,
    /// The driver's buffers.
    pub buffers: u32,
    /// Frames that came from the driver.
    pub grabbed: u64,
    /// Frames that the driver lost, by its sequence numbers.
    pub lost_by_driver: u64,
    /// Frames that were let go because the disk was too slow.
    pub discarded: u64,
    /// Broken frames.
    pub corrupt: u64,
    /// Root mean square of the intervals' deviation, milliseconds.
    pub jitter_ms: Option<f64>,
    /// How often the driver's clock was wrong.
    pub clock_corrections: u64,
    /// The most bytes that waited for the disk.
    pub waiting_peak_bytes: usize,
    /// Bytes of the video.
    pub video_bytes: u64,
    /// Marks of the script.
    pub marks: usize,
    /// Controls that could not be put back.
    pub controls_not_restored: Vec<String>,
    /// What ended it, where that was a failure.
    #[serde(skip)]
    pub failure: Option<CaptureError>,
}

/// Records until the time is over, the user stops, or the camera or the disk gives up.
///
/// The take is there in each case, up to the last whole fragment; [`LiveSummary::failure`] tells of a camera or disk that
/// failed. The quality columns are empty until [`measure_take`].
pub fn record_live(
    mut source: Box<dyn FrameSource>,
    options: &LiveOptions,
    preview: Option<&Preview>,
    monitor: &dyn Monitor,
) -> Result<LiveSummary> {
    let place = Place::check(options)?;
    let choice = choose(source.as_mut(), options)?;
    let usual = if choice.format.raw().is_some() { USUAL_RAW_BUFFERS } else { USUAL_BUFFERS };
    let started = source.start(&choice, options.buffers.unwrap_or(usual).max(LEAST_BUFFERS))?;
    let changed = match prepare(source.as_mut(), options, &choice, &started, monitor) {
        Ok(changed) => changed,
        Err(e) => {
            source.stop();
            return Err(e);
        }
    };
    let recorded = record_into(place, source.as_mut(), options, &started, &changed, preview, monitor);
    source.stop();
    let not_restored = controls::restore(source.as_mut(), &changed);
    let (dir, outcome) = recorded?;
    if !not_restored.is_empty() {
        let message = format!("{}: could not put back: {}", options.device, not_restored.join(", "));
        monitor.warn(Warning::new("controls-not-restored", message));
    }
    summarise(&dir, outcome, &started, not_restored, monitor)
}

/// The mode that a recording would take; a rehearsal, which touches nothing.
pub fn rehearse(source: &mut dyn FrameSource, options: &LiveOptions) -> Result<Choice> {
    Place::check(options)?;
    choose(source, options)
}

fn choose(source: &mut dyn FrameSource, options: &LiveOptions) -> Result<Choice> {
    let modes = source.modes(options.request.size)?;
    negotiate(&modes, &options.request)
        .map_err(|refusal| CaptureError::Refused { device: options.device.clone(), refusal: Box::new(refusal) })
}

/// Lets the camera settle and sets its controls.
fn prepare(
    source: &mut dyn FrameSource,
    options: &LiveOptions,
    choice: &Choice,
    started: &Started,
    monitor: &dyn Monitor,
) -> Result<Vec<Changed>> {
    if let Some(given) = started.rate.map(crate::source::Rate::fps)
        && !same_rate(given, choice.rate.fps())
    {
        let device = options.device.clone();
        return Err(CaptureError::RateNotKept { device, asked: choice.rate.fps(), given });
    }
    if started.buffers > 0 && started.buffers < LEAST_BUFFERS {
        let message = format!("{}: the driver gives {} buffers only", options.device, started.buffers);
        monitor.warn(Warning::new("few-buffers", message));
    }
    skip(source, options.warm_up, monitor)?;
    let fps = started.rate.map_or(choice.rate.fps(), crate::source::Rate::fps);
    let changed = controls::apply(source, &options.wishes, 1.0 / fps)?;
    if !changed.is_empty()
        && !options.warm_up.is_zero()
        && let Err(e) = skip(source, SETTLE, monitor)
    {
        controls::restore(source, &changed);
        return Err(e);
    }
    Ok(changed)
}

/// Grabs and forgets for a while; at least one frame has to come.
fn skip(source: &mut dyn FrameSource, time: Duration, monitor: &dyn Monitor) -> Result<()> {
    if time.is_zero() {
        return Ok(());
    }
    let begun = Instant::now();
    let (mut frame, mut came) = (Grabbed::default(), false);
    while begun.elapsed() < time || !came {
        if monitor.cancelled() {
            return Err(CaptureError::Interrupted);
        }
        came |= source.grab(Duration::from_millis(100), &mut frame)? == Grab::Frame;
        if !came && begun.elapsed() > pipeline::SILENCE {
            return Err(CaptureError::Silent { device: source.name(), secs: pipeline::SILENCE.as_secs() });
        }
    }
    Ok(())
}

fn record_into(
    place: Place,
    source: &mut dyn FrameSource,
    options: &LiveOptions,
    started: &Started,
    changed: &[Changed],
    preview: Option<&Preview>,
    monitor: &dyn Monitor,
) -> Result<(PathBuf, pipeline::Outcome)> {
    let recording = Recording {
        version: journal::RECORDING_VERSION,
        device: options.device.clone(),
        name: source.name(),
        format: started.format,
        width: started.width,
        height: started.height,
        fps_asked: options.request.fps,
        fps_promised: started.rate.map(crate::source::Rate::fps),
        subject: options.subject.clone(),
        consent: options.consent.clone(),
        controls: changed.to_vec(),
        script: options.script.clone(),
    };
    let place = place.create()?;
    let dir = place.dir.clone();
    recording.write(&dir)?;
    journal::reserve(&dir, RESERVED_BYTES)?;
    let mut table = Journal::create(&dir)?;
    let video = dir.join(journal::VIDEO_FILE);
    let sink = File::create(&video).map_err(|e| FormatError::io(&video, "create", &e))?;
    let secs = options.duration.map(|d| d.as_secs_f64());
    let plan = Plan { duration: options.duration, memory_bytes: options.memory_bytes };
    let mut waiting = 0;
    let mut keep = |row, last: bool| {
        table.push(row);
        waiting += 1;
        if last { table.send(std::mem::take(&mut waiting)) } else { Ok(()) }
    };
    let mut meter = meter::Ticker::new(&dir, started, options.script.as_ref(), secs, preview, monitor);
    let outcome = pipeline::run(source, started, &plan, sink, &mut keep, &mut |view| meter.tick(view))?;
    if matches!(outcome.ended, Ended::Disk(_)) {
        // The torn fragment gives its room to the take's tables.
        cut(&video, outcome.whole_bytes)?;
    }
    journal::release(&dir);
    if outcome.totals.written == 0 {
        return Err(match outcome.ended {
            Ended::Camera(e) => e,
            Ended::Disk(e) => FormatError::io(&video, "write", &e).into(),
            Ended::Stopped | Ended::Complete => CaptureError::Interrupted,
        });
    }
    place.keep();
    Ok((dir, outcome))
}

/// Shortens a file.
fn cut(path: &Path, bytes: u64) -> Result<()> {
    let file = File::options().write(true).open(path).map_err(|e| FormatError::io(path, "open", &e))?;
    file.set_len(bytes).and_then(|()| file.sync_all()).map_err(|e| FormatError::io(path, "shorten", &e))?;
    Ok(())
}

fn summarise(
    dir: &Path,
    outcome: pipeline::Outcome,
    started: &Started,
    controls_not_restored: Vec<String>,
    reporter: &dyn Reporter,
) -> Result<LiveSummary> {
    let Finished { manifest, frames, marks, .. } = finish(dir, &Undisturbed(reporter))?;
    let times: Vec<i64> = frames.iter().map(|f| f.timestamp_nanos).collect();
    warn_of_rate(&manifest, started, reporter);
    let Totals { grabbed, lost, discarded, corrupt, bytes, waiting_peak_bytes, .. } = outcome.totals;
    let (ended, failure) = match outcome.ended {
        Ended::Complete => ("complete", None),
        Ended::Stopped => ("stopped", None),
        Ended::Camera(e) => ("camera", Some(e)),
        Ended::Disk(e) => ("disk", Some(FormatError::io(dir.join(journal::VIDEO_FILE), "write", &e).into())),
    };
    Ok(LiveSummary {
        take: dir.to_owned(),
        ended,
        duration_secs: times.last().map_or(0.0, |&t| t as f64 * 1e-9),
        format: started.format.to_string(),
        buffers: started.buffers,
        grabbed,
        lost_by_driver: lost,
        discarded,
        corrupt,
        jitter_ms: timing::jitter_nanos(&times).map(|j| j * 1e-6),
        clock_corrections: outcome.clock_corrections,
        waiting_peak_bytes,
        video_bytes: bytes,
        marks,
        controls_not_restored,
        failure,
        manifest,
    })
}

/// A camera may promise a rate and keep another, as in dim light.
const RATE_KEPT: f64 = 0.97;
/// Over a shorter time the rate is not known.
const RATE_KNOWN_SECS: f64 = 1.0;

fn warn_of_rate(manifest: &TakeManifest, started: &Started, reporter: &dyn Reporter) {
    let Some(promised) = started.rate.map(crate::source::Rate::fps) else { return };
    // Frames that were lost on the way were given all the same.
    let count = f64::from(manifest.frame_count);
    let given = manifest.fps_measured * (1.0 + f64::from(manifest.dropped_frames) / count.max(1.0));
    if given > 0.0 && given < RATE_KEPT * promised && count > RATE_KNOWN_SECS * given {
        let device = manifest.device.as_deref().unwrap_or_default();
        let message = format!(
            "{device}: gave {given:.1} frames/s instead of {promised:.1}: more light, or a shorter `--exposure`, lets it keep its rate"
        );
        reporter.warn(Warning::new("rate-not-kept", message));
    }
}

/// Where the take is going to be, and what was there before: put back if nothing comes of the recording.
struct Place {
    dir: PathBuf,
    before: Option<PathBuf>,
    created: bool,
}

impl Place {
    fn check(options: &LiveOptions) -> Result<Self> {
        let dir = options.out.clone();
        let is_there = dir.symlink_metadata().is_ok();
        if is_there && !options.force {
            return Err(CaptureError::Exists { path: dir });
        }
        check_replaceable(&dir, "a take", &["take.toml", journal::RECORDING_FILE])?;
        let name = dir.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let before = is_there.then(|| dir.with_file_name(format!(".{name}.{}.old", std::process::id())));
        Ok(Self { dir, before, created: false })
    }

    fn create(mut self) -> Result<Self> {
        if let Some(before) = &self.before {
            fs::rename(&self.dir, before).map_err(|e| FormatError::io(&self.dir, "move aside", &e))?;
        }
        self.created = true;
        fs::create_dir_all(&self.dir).map_err(|e| FormatError::io(&self.dir, "create the folder", &e))?;
        Ok(self)
    }

    /// The recording stays; what was there before goes.
    fn keep(mut self) {
        self.created = false;
        if let Some(before) = &self.before {
            let _ = fs::remove_dir_all(before);
        }
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        if self.created {
            let _ = fs::remove_dir_all(&self.dir);
            if let Some(before) = &self.before {
                let _ = fs::rename(before, &self.dir);
            }
        }
    }
}
