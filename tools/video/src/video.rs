//! A video file through FFmpeg's libraries.

use std::fs::File;
use std::path::{Path, PathBuf};

use ffmpeg::format::context::Input;
use ffmpeg::{Packet, Rational, decoder, frame};
use image::RgbImage;
use risorius_formats::FormatError;

use crate::coding::Coding;
use crate::convert::Converter;
use crate::mp4::{self, Container};
use crate::orientation::{Orientation, Widening};
use crate::remarks::{Facts, Remark, describe, remarks};
use crate::times::{self, Rates};
use crate::{TimeSource, Timeline, Truncation, VideoError, pixels, stream};

/// The frame rate when neither the container nor the times tell.
const UNKNOWN_FPS: f64 = 25.0;
/// A decoder that fails so often in a row without taking a packet is stuck.
const PATIENCE: usize = 1000;

pub(crate) struct VideoFile {
    path: PathBuf,
    input: Input,
    decoder: decoder::Video,
    stream: usize,
    time_base: Rational,
    packet: Packet,
    picture: frame::Video,
    converter: Converter,
    /// Of MP4 and MOV files: when every frame is shown.
    timeline: Option<Timeline>,
    stored_size: (u32, u32),
    orientation: Orientation,
    /// Turned by the container; the rest of `orientation` was asked for.
    rotation_degrees: u32,
    widening: Option<Widening>,
    fps: f64,
    peak_fps: f64,
    times: TimeSource,
    capture_fps: Option<f64>,
    /// Length that the container states.
    stated_secs: Option<f64>,
    remarks: Vec<Remark>,
    coding: String,
    /// The first frame is decoded at opening, to know what the pictures are.
    first_is_waiting: bool,
    /// How many frames have been handed out.
    count: u32,
    /// Packets of frames that are shown before the first one that can be decoded.
    lost_at_start: u32,
    /// Times of the packets before the first picture came out.
    sent_ticks: Vec<i64>,
    first_ticks: Option<i64>,
    last_nanos: i64,
    interval_nanos: i64,
    draining: bool,
    ended: bool,
}

/// Whether a decoder wants a packet before it gives a picture.
fn is_hungry(error: ffmpeg::Error) -> bool {
    let ffmpeg::Error::Other { errno } = error else { return false };
    std::io::Error::from_raw_os_error(errno).kind() == std::io::ErrorKind::WouldBlock
}

impl std::fmt::Debug for VideoFile {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("VideoFile").field("path", &self.path).field("count", &self.count).finish_non_exhaustive()
    }
}

impl VideoFile {
    /// Opens a video; `rate` is for streams whose container has no times.
    pub(crate) fn open(path: &Path, rate: Option<f64>) -> Result<Self, VideoError> {
        let mut file = File::open(path).map_err(|e| FormatError::io(path, "open", &e))?;
        let length = file.metadata().map_err(|e| FormatError::io(path, "read", &e))?.len();
        if length == 0 {
            return Err(VideoError::Empty { path: path.to_owned() });
        }
        // The index says more than FFmpeg: whether it is there, and every frame's time before the first is decoded.
        if matches!(mp4::read(&mut file, None).map_err(|e| FormatError::io(path, "read", &e))?, Container::NoIndex) {
            return Err(VideoError::NoIndex { path: path.to_owned() });
        }
        let input = stream::open_input(path)?;
        let choice = stream::choose(&input, path)?;
        let chosen = input.stream(choice.index).ok_or_else(|| VideoError::NotAVideo { path: path.to_owned() })?;
        let (track, time_base, order) = (chosen.id(), chosen.time_base(), chosen.parameters().field_order());
        let tagged_alpha = chosen.metadata().get("alpha_mode") == Some("1");
        let stated_fps = times::sane(chosen.avg_frame_rate(), time_base);
        let secs = |ticks: i64, base: f64| Some(ticks as f64 * base).filter(|s| *s > 0.0);
        let base = f64::from(time_base.numerator()) / f64::from(time_base.denominator());
        let stated_secs = secs(chosen.duration(), base).or_else(|| secs(input.duration(), 1e-6));
        let decoder = stream::open_decoder(&chosen, path)?;
        let turn = stream::orientation(&chosen);
        let timed = stream::has_times(&input);
        let (timeline, capture_fps) = match mp4::read(&mut file, Some(track)) {
            Ok(Container::Indexed(timeline, fps)) => (Some(timeline), fps),
            _ => (None, None),
        };
        // Tools that copy the clip write the number as text.
        let as_text = || input.metadata().get("com.android.capture.fps").and_then(|t| t.parse().ok());
        let capture_fps = capture_fps.or_else(as_text).filter(|fps: &f64| (1.0..=10_000.0).contains(fps));
        let rates = match &timeline {
            Some(timeline) => Rates::of(timeline.nanos()),
            None if timed => times::sample(&mut stream::open_input(path)?, choice.index, time_base),
            None => None,
        };
        let mut this = Self {
            path: path.to_owned(),
            stream: choice.index,
            time_base,
            packet: Packet::empty(),
            picture: frame::Video::empty(),
            converter: Converter::default(),
            timeline,
            stored_size: (0, 0),
            orientation: Orientation::default(),
            rotation_degrees: 0,
            widening: None,
            fps: UNKNOWN_FPS,
            peak_fps: UNKNOWN_FPS,
            times: TimeSource::Container,
            capture_fps,
            stated_secs,
            remarks: Vec::new(),
            coding: String::new(),
            first_is_waiting: true,
            count: 0,
            lost_at_start: 0,
            sent_ticks: Vec::new(),
            first_ticks: None,
            last_nanos: 0,
            interval_nanos: 0,
            draining: false,
            ended: false,
            input,
            decoder,
        };
        if !this.decode() {
            return Err(VideoError::NoFrames { path: path.to_owned() });
        }
        let header_fps = this.decoder.frame_rate().and_then(|r| times::sane(r, Rational::new(1, 90_000)));
        let header_fps = header_fps.filter(|&fps| fps != stream::NOBODYS_FPS);
        this.choose_rates(stated_fps, rates, timed, header_fps, rate);
        this.look_at_first(turn, order, tagged_alpha, choice.others);
        Ok(this)
    }

    fn choose_rates(
        &mut self,
        stated: Option<f64>,
        rates: Option<Rates>,
        timed: bool,
        of_header: Option<f64>,
        asked: Option<f64>,
    ) {
        if timed {
            self.fps = match (stated, rates) {
                (Some(stated), Some(rates)) if (stated / rates.mean - 1.0).abs() < 0.005 => stated,
                (_, Some(rates)) => rates.mean,
                (Some(stated), None) => stated,
                (None, None) => UNKNOWN_FPS,
            };
            self.peak_fps = rates.map_or(self.fps, |r| r.peak);
        } else {
            (self.fps, self.times) = match (asked, of_header) {
                (Some(fps), _) => (fps, TimeSource::Asked),
                (None, Some(fps)) => (fps, TimeSource::StreamRate),
                (None, None) => (UNKNOWN_FPS, TimeSource::Unknown),
            };
            self.peak_fps = self.fps;
        }
        self.interval_nanos = (1e9 / self.fps) as i64;
    }

    fn look_at_first(
        &mut self,
        turn: Option<Orientation>,
        field_order: ffmpeg::FieldOrder,
        tagged_alpha: bool,
        other_videos: usize,
    ) {
        let first = &self.picture;
        self.stored_size = (first.width(), first.height());
        let in_stream = || {
            let matrix = first.side_data(frame::side_data::Type::DisplayMatrix)?;
            Orientation::from_side_data(matrix.data())
        };
        self.orientation = turn.or_else(in_stream).unwrap_or_default();
        self.rotation_degrees = self.orientation.clockwise_degrees;
        let aspect = self.input.stream(self.stream).map_or(1.0, |s| stream::pixel_aspect(&s, first.aspect_ratio()));
        self.widening = Widening::new(first.width(), aspect);
        let coding = Coding::of(first, pixels::family(first.format()));
        let widened = self.widening.as_ref().map(|w| (first.width(), w.width()));
        self.remarks = remarks(&Facts { first, field_order, tagged_alpha, coding, other_videos, widened });
        self.coding = describe(first.format(), coding);
        self.first_ticks = first.timestamp();
        if let Some(shown) = self.first_ticks {
            self.lost_at_start = self.sent_ticks.iter().filter(|&&t| t < shown).count() as u32;
        }
        self.sent_ticks = Vec::new();
    }

    /// Width and height as shown, pixels.
    pub(crate) fn size(&self) -> (u32, u32) {
        let width = self.widening.as_ref().map_or(self.stored_size.0, Widening::width);
        self.orientation.size((width, self.stored_size.1))
    }

    pub(crate) fn rotation_degrees(&self) -> u32 {
        self.rotation_degrees
    }

    /// Turns all pictures further, clockwise.
    pub(crate) fn turn(&mut self, degrees: u32) {
        self.orientation = self.orientation.turned(degrees);
    }

    pub(crate) fn fps(&self) -> f64 {
        self.fps
    }

    pub(crate) fn peak_fps(&self) -> f64 {
        self.peak_fps
    }

    pub(crate) fn times(&self) -> TimeSource {
        self.times
    }

    pub(crate) fn capture_fps(&self) -> Option<f64> {
        self.capture_fps
    }

    pub(crate) fn remarks(&self) -> &[Remark] {
        &self.remarks
    }

    pub(crate) fn coding(&self) -> &str {
        &self.coding
    }

    pub(crate) fn frame_count_estimate(&self) -> Option<u64> {
        match &self.timeline {
            Some(timeline) => Some(timeline.nanos().len() as u64),
            None => self.stated_secs.map(|s| (s * self.fps).round() as u64),
        }
    }

    /// Moves to the next frame without converting it; gives its time since the first frame.
    pub(crate) fn grab(&mut self) -> Result<Option<i64>, VideoError> {
        if self.ended {
            return Ok(None);
        }
        if !std::mem::take(&mut self.first_is_waiting) && !self.decode() {
            self.ended = true;
            return Ok(None);
        }
        let found = (self.picture.width(), self.picture.height());
        if found != self.stored_size {
            let expected = self.stored_size;
            return Err(VideoError::StreamSizeChanged { path: self.path.clone(), index: self.count, expected, found });
        }
        let nanos = self.time_of_picture();
        self.count += 1;
        if self.count > 1 {
            self.interval_nanos = nanos - self.last_nanos;
        }
        self.last_nanos = nanos;
        Ok(Some(nanos))
    }

    fn time_of_picture(&self) -> i64 {
        if self.count == 0 {
            return 0;
        }
        if self.times != TimeSource::Container {
            return (f64::from(self.count) * 1e9 / self.fps).round() as i64;
        }
        let found = self.picture.timestamp().zip(self.first_ticks);
        let found = found.map(|(now, first)| times::nanos(now.saturating_sub(first), self.time_base));
        // Where a container has no time for a picture, the last interval is repeated.
        found.filter(|&t| t >= self.last_nanos).unwrap_or_else(|| self.last_nanos.saturating_add(self.interval_nanos))
    }

    /// Decodes the next picture; false at the end.
    fn decode(&mut self) -> bool {
        let mut failures = 0;
        while failures < PATIENCE {
            match self.decoder.receive_frame(&mut self.picture) {
                Ok(()) => return true,
                Err(ffmpeg::Error::Eof) => return false,
                Err(e) if is_hungry(e) && self.draining => return false,
                Err(e) if is_hungry(e) => self.feed(),
                // What is damaged gives no picture; what follows does.
                Err(_) => failures += 1,
            }
        }
        false
    }

    /// Gives the decoder the next packet, or the word that there is none.
    fn feed(&mut self) {
        loop {
            match self.packet.read(&mut self.input) {
                Ok(()) if self.packet.stream() != self.stream => {}
                Ok(()) => {
                    if self.first_is_waiting && self.first_ticks.is_none() {
                        self.sent_ticks.extend(self.packet.pts());
                    }
                    let _ = self.decoder.send_packet(&self.packet);
                    return;
                }
                Err(_) => {
                    self.draining = true;
                    let _ = self.decoder.send_eof();
                    return;
                }
            }
        }
    }

    /// The frame that was grabbed last, as RGB.
    pub(crate) fn retrieve(&mut self) -> Result<RgbImage, VideoError> {
        let index = self.count.saturating_sub(1);
        let coding = Coding::of(&self.picture, pixels::family(self.picture.format()));
        let converter = &mut self.converter;
        let stored = pixels::with_planes(&self.picture, |planes| converter.run(planes, coding));
        let stored = stored.map_err(|message| VideoError::Decode { path: self.path.clone(), index, message })?;
        let square = match &self.widening {
            Some(widening) => widening.apply(&stored),
            None => stored,
        };
        Ok(self.orientation.apply(square))
    }

    /// What is missing, once the end has been reached.
    pub(crate) fn truncation(&self) -> Option<Truncation> {
        if !self.ended {
            return None;
        }
        if let Some(timeline) = &self.timeline {
            let expected = timeline.nanos().len() as u64;
            let missing = expected.saturating_sub(self.count.into());
            let lost_at_start = u64::from(self.lost_at_start).min(missing) as u32;
            return (missing > 0).then_some(Truncation { read: self.count, expected, lost_at_start });
        }
        // Other containers only state a length, which sound may stretch a little.
        let secs = self.last_nanos.saturating_add(self.interval_nanos) as f64 * 1e-9;
        let stated = self.stated_secs.filter(|s| secs > 0.0 && s - secs > 1.0 && secs < 0.95 * s);
        let whole = u64::from(self.count) + u64::from(self.lost_at_start);
        let expected = stated.map_or(whole, |s| (f64::from(self.count) * s / secs).round() as u64).max(whole);
        let lost_at_start = self.lost_at_start;
        (expected > u64::from(self.count)).then_some(Truncation { read: self.count, expected, lost_at_start })
    }
}
