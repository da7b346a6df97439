//! What is shown while a recording runs: rate, drops, sharpness, exposure, free disk, and the script's prompts.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use risorius_formats::Reporter;
use serde::Serialize;

use super::pipeline::{Totals, View};
use crate::picture;
use crate::preview::Preview;
use crate::quality;
use crate::script::{Prompt, Script};
use crate::source::Started;

/// How often the figures are renewed.
const METER_EVERY: Duration = Duration::from_millis(500);
/// How often the preview's picture is renewed.
const PREVIEW_EVERY: Duration = Duration::from_millis(100);

/// The figures of a running recording.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Meter {
    /// Seconds since the first frame.
    pub secs: f64,
    /// Seconds that were asked for.
    pub of_secs: Option<f64>,
    /// Frames per second, over the last half second.
    pub fps: f64,
    /// Frames in the video.
    pub written: u64,
    /// Frames that the driver lost.
    pub lost: u64,
    /// Frames that were let go because the disk was too slow.
    pub discarded: u64,
    /// Broken frames.
    pub corrupt: u64,
    /// Bytes that wait for the disk.
    pub waiting_bytes: usize,
    /// Sharpness of a recent frame, squared 8-bit levels.
    pub sharpness: Option<f32>,
    /// Mean luma of a recent frame, 0–255.
    pub luma: Option<f32>,
    /// Share of black and white pixels of a recent frame, 0–1.
    pub clipped: Option<f32>,
    /// Free room on the disk.
    pub free_bytes: Option<u64>,
    /// Until the disk is full at this rate, seconds.
    pub disk_secs_left: Option<f64>,
    /// What the script asks for.
    pub prompt: Option<String>,
    /// How long it asks for it, seconds.
    pub prompt_secs_left: Option<f64>,
}

/// Where the figures go.
pub trait Monitor: Reporter {
    /// The figures, twice a second.
    fn meter(&self, meter: &Meter) {
        let _ = meter;
    }

    /// A new prompt of the script; `None` at its end.
    fn prompt(&self, prompt: Option<&Prompt>) {
        let _ = prompt;
    }
}

impl Monitor for risorius_formats::Silent {}
impl Monitor for risorius_formats::report::Collected {}

/// A reporter that is not asked whether to stop: what follows a recording goes on after the Ctrl-C that ended it. A second
/// one ends the process.
pub struct Undisturbed<'a>(pub &'a dyn Reporter);

impl Reporter for Undisturbed<'_> {
    fn stage(&self, name: &str, total: Option<u64>) {
        self.0.stage(name, total);
    }
    fn advance(&self, steps: u64) {
        self.0.advance(steps);
    }
    fn note(&self, text: &str) {
        self.0.note(text);
    }
    fn warn(&self, warning: risorius_formats::Warning) {
        self.0.warn(warning);
    }
}

/// Looks at a running recording now and then.
pub(super) struct Ticker<'a> {
    dir: PathBuf,
    started: &'a Started,
    script: Option<&'a Script>,
    secs: Option<f64>,
    preview: Option<&'a Preview>,
    monitor: &'a dyn Monitor,
    meter: Meter,
    last_meter: Option<(Instant, Totals)>,
    last_picture: Option<Instant>,
    shown: Option<(usize, bool)>,
    warned_of_disk: bool,
}

impl<'a> Ticker<'a> {
    pub(super) fn new(
        dir: &Path,
        started: &'a Started,
        script: Option<&'a Script>,
        secs: Option<f64>,
        preview: Option<&'a Preview>,
        monitor: &'a dyn Monitor,
    ) -> Self {
        let total = secs.zip(started.rate).map(|(s, rate)| (s * rate.fps()).round() as u64);
        monitor.stage("recording", total);
        Self {
            dir: dir.to_owned(),
            started,
            script,
            secs,
            preview,
            monitor,
            meter: Meter { of_secs: secs, ..Meter::default() },
            last_meter: None,
            last_picture: None,
            shown: None,
            warned_of_disk: false,
        }
    }

    /// Whether to go on.
    pub(super) fn tick(&mut self, view: &View<'_>) -> bool {
        let totals = view.totals();
        self.prompt(totals.time_nanos as f64 * 1e-9, totals.grabbed > 0);
        if let Some(sample) = view.sample() {
            self.look(&sample);
        }
        let every = if self.preview.is_some() { PREVIEW_EVERY } else { METER_EVERY };
        if self.last_picture.is_none_or(|t| t.elapsed() >= every) {
            self.last_picture = Some(Instant::now());
            view.want_sample();
        }
        if self.last_meter.is_none_or(|(t, _)| t.elapsed() >= METER_EVERY) {
            self.figures(totals);
        }
        !self.monitor.cancelled()
    }

    fn prompt(&mut self, secs: f64, has_begun: bool) {
        let Some(script) = self.script.filter(|_| has_begun) else { return };
        let prompt = script.at(secs);
        self.meter.prompt_secs_left = prompt.as_ref().map(|p| p.secs_left);
        let now = prompt.as_ref().map(|p| (p.step, p.is_rest));
        if now != self.shown {
            self.shown = now;
            self.meter.prompt = prompt.as_ref().map(|p| p.text.clone());
            self.monitor.prompt(prompt.as_ref());
        }
        if let Some(preview) = self.preview {
            preview.set_meter(&self.meter);
        }
    }

    /// Measures a frame, and shows it.
    fn look(&mut self, sample: &[u8]) {
        let due = self.last_meter.is_none_or(|(t, _)| t.elapsed() >= METER_EVERY.mul_f64(0.7));
        let measures = due || self.meter.sharpness.is_none();
        let is_jpeg = self.started.format == crate::source::PixelFormat::Mjpeg;
        let rgb =
            if measures || (self.preview.is_some() && !is_jpeg) { picture::rgb(self.started, sample) } else { None };
        if let (true, Some(rgb)) = (measures, &rgb) {
            let quality = quality::measure(rgb);
            self.meter.sharpness = Some(quality.sharpness);
            self.meter.luma = Some(quality.luma_mean);
            self.meter.clipped = Some(quality.clipped_share);
        }
        if let Some(preview) = self.preview {
            if is_jpeg {
                preview.set_picture(sample.to_vec());
            } else if let Some(jpeg) = rgb.as_ref().and_then(picture::small_jpeg) {
                preview.set_picture(jpeg);
            }
        }
    }

    fn figures(&mut self, totals: Totals) {
        let now = Instant::now();
        let before = self.last_meter.replace((now, totals));
        let m = &mut self.meter;
        m.secs = totals.time_nanos as f64 * 1e-9;
        (m.written, m.lost, m.discarded, m.corrupt) = (totals.written, totals.lost, totals.discarded, totals.corrupt);
        m.waiting_bytes = totals.waiting_bytes;
        m.free_bytes = fs4::available_space(&self.dir).ok();
        if let Some((then, before)) = before {
            let secs = now.duration_since(then).as_secs_f64();
            m.fps = (totals.grabbed - before.grabbed) as f64 / secs;
            self.monitor.advance(totals.grabbed - before.grabbed);
        }
        // Over the whole recording, as fragments go out in bursts.
        let bytes_per_sec = totals.bytes as f64 / m.secs.max(0.5);
        m.disk_secs_left = m.free_bytes.filter(|_| totals.bytes > 0).map(|free| free as f64 / bytes_per_sec);
        let needed = self.secs.map(|s| s - m.secs);
        if let (Some(left), Some(needed)) = (m.disk_secs_left, needed)
            && m.secs > 2.0
            && left < needed
            && !std::mem::replace(&mut self.warned_of_disk, true)
        {
            let text = format!("{}: the disk will be full in {left:.0} s, before the end", self.dir.display());
            self.monitor.warn(risorius_formats::Warning::new("disk-fills", text));
        }
        self.monitor.meter(m);
        if let Some(preview) = self.preview {
            preview.set_meter(m);
        }
    }
}
