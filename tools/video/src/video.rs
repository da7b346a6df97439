//! A video file through OpenCV.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Once;

use image::RgbImage;
use opencv::core::{LogLevel, Mat, MatTraitConst, Vec3b};
use opencv::prelude::{VideoCaptureTrait, VideoCaptureTraitConst};
use opencv::videoio::{self, VideoCapture};
use risorius_formats::FormatError;

use crate::mp4::{self, Container};
use crate::orientation::Orientation;
use crate::{Timeline, Truncation, VideoError};

/// Frame rates that a container may state and be believed.
const SANE_FPS: std::ops::RangeInclusive<f64> = 0.1..=2000.0;
/// The frame rate when neither the container nor the times tell.
const UNKNOWN_FPS: f64 = 30.0;

#[derive(Debug)]
pub(crate) struct VideoFile {
    path: PathBuf,
    capture: VideoCapture,
    timeline: Option<Timeline>,
    size: (u32, u32),
    orientation: Orientation,
    fps: f64,
    capture_fps: Option<f64>,
    /// Length that OpenCV derives from the container, for files without a timeline.
    stated_secs: Option<f64>,
    bgr: Mat,
    spare: Mat,
    /// The first frame is decoded at opening, to know the upright size.
    first_is_waiting: bool,
    /// How many frames have been handed out.
    count: u32,
    located: Option<usize>,
    base_msec: f64,
    last_nanos: i64,
    interval_nanos: i64,
    ended: bool,
}

impl VideoFile {
    pub(crate) fn open(path: &Path) -> Result<Self, VideoError> {
        let mut file = File::open(path).map_err(|e| FormatError::io(path, "open", &e))?;
        let length = file.metadata().map_err(|e| FormatError::io(path, "read", &e))?.len();
        if length == 0 {
            return Err(VideoError::Empty { path: path.to_owned() });
        }
        let (timeline, orientation, capture_fps) =
            match mp4::read(&mut file).map_err(|e| FormatError::io(path, "read", &e))? {
                Container::Indexed(timeline, orientation, fps) => (Some(timeline), Some(orientation), fps),
                Container::NoIndex => return Err(VideoError::NoIndex { path: path.to_owned() }),
                Container::Other => (None, None, None),
            };
        silence();
        // An absolute path: FFmpeg would take `a:b.mp4` for a protocol.
        let absolute = std::path::absolute(path).map_err(|e| FormatError::io(path, "open", &e))?;
        let capture = VideoCapture::from_file(&absolute, videoio::CAP_FFMPEG)
            .ok()
            .filter(|c| c.is_opened().unwrap_or(false))
            .ok_or_else(|| VideoError::NotAVideo { path: path.to_owned() })?;
        let mut this = Self {
            path: path.to_owned(),
            capture,
            timeline,
            size: (0, 0),
            orientation: Orientation::default(),
            fps: UNKNOWN_FPS,
            capture_fps,
            stated_secs: None,
            bgr: Mat::default(),
            spare: Mat::default(),
            first_is_waiting: false,
            count: 0,
            located: None,
            base_msec: 0.0,
            last_nanos: 0,
            interval_nanos: 0,
            ended: false,
        };
        // Where it cannot be switched off it is not there.
        let _ = this.capture.set(videoio::CAP_PROP_ORIENTATION_AUTO, 0.0);
        let reported = this.get(videoio::CAP_PROP_ORIENTATION_META);
        this.orientation = orientation.unwrap_or_else(|| Orientation::from_opencv(reported));
        this.read_first()?;
        Ok(this)
    }

    fn read_first(&mut self) -> Result<(), VideoError> {
        if !self.capture.grab().unwrap_or(false)
            || !self.capture.retrieve_def(&mut self.bgr).unwrap_or(false)
            || self.bgr.empty()
        {
            return Err(VideoError::NoFrames { path: self.path.clone() });
        }
        self.first_is_waiting = true;
        let fail = |e: opencv::Error| VideoError::Decode { path: self.path.clone(), index: 0, message: e.message };
        self.orientation.apply(&mut self.bgr, &mut self.spare).map_err(fail)?;
        self.size = (self.bgr.cols() as u32, self.bgr.rows() as u32);
        // Below 0 it is a decoding time, which OpenCV gives for the first frame of some files; the others count from 0.
        self.base_msec = self.get(videoio::CAP_PROP_POS_MSEC).max(0.0);
        let stated = Some(self.get(videoio::CAP_PROP_FPS)).filter(|f| SANE_FPS.contains(f));
        self.fps = choose_fps(stated, self.timeline.as_ref());
        let frames = self.get(videoio::CAP_PROP_FRAME_COUNT);
        self.stated_secs = stated.filter(|_| frames > 0.0).map(|fps| frames / fps);
        self.interval_nanos = (1e9 / self.fps) as i64;
        Ok(())
    }

    pub(crate) fn size(&self) -> (u32, u32) {
        self.size
    }

    pub(crate) fn rotation_degrees(&self) -> u32 {
        self.orientation.clockwise_degrees
    }

    pub(crate) fn fps(&self) -> f64 {
        self.fps
    }

    pub(crate) fn capture_fps(&self) -> Option<f64> {
        self.capture_fps
    }

    pub(crate) fn frame_count_estimate(&self) -> Option<u64> {
        match &self.timeline {
            Some(timeline) => Some(timeline.nanos().len() as u64),
            None => self.stated_secs.map(|s| (s * self.fps).round() as u64),
        }
    }

    /// Moves to the next frame without converting it; gives its time since the first frame.
    pub(crate) fn grab(&mut self) -> Option<i64> {
        if self.ended {
            return None;
        }
        if !std::mem::take(&mut self.first_is_waiting) && !self.capture.grab().unwrap_or(false) {
            self.ended = true;
            return None;
        }
        let nanos = self.time_of_grabbed();
        self.count += 1;
        if self.count > 1 {
            self.interval_nanos = nanos - self.last_nanos;
        }
        self.last_nanos = nanos;
        Some(nanos)
    }

    fn time_of_grabbed(&mut self) -> i64 {
        if self.count == 0 {
            self.located = Some(0);
            return 0;
        }
        // OpenCV has no time for the last frames of a stream whose frames are reordered, and says 0.
        let msec = Some(self.get(videoio::CAP_PROP_POS_MSEC)).filter(|&m| m > self.base_msec);
        let reported = msec.map(|m| ((m - self.base_msec) * 1e6).round() as i64);
        let following = self.last_nanos.saturating_add(self.interval_nanos);
        if let Some(timeline) = &self.timeline {
            let found = timeline.locate(self.located, reported);
            self.located = found.or(self.located);
            found.and_then(|i| timeline.nanos().get(i).copied()).unwrap_or(following)
        } else {
            reported.filter(|&t| t > self.last_nanos).unwrap_or(following)
        }
    }

    /// The frame that was grabbed last, as RGB.
    pub(crate) fn retrieve(&mut self) -> Result<RgbImage, VideoError> {
        let index = self.count.saturating_sub(1);
        let (path, size) = (&self.path, self.size);
        let fail = |message: String| VideoError::Decode { path: path.clone(), index, message };
        // The first frame lies in the buffer already.
        if index > 0 {
            if !self.capture.retrieve_def(&mut self.bgr).map_err(|e| fail(e.message))? {
                return Err(fail("the decoder gives no picture".to_owned()));
            }
            self.orientation.apply(&mut self.bgr, &mut self.spare).map_err(|e| fail(e.message))?;
        }
        let found = (self.bgr.cols() as u32, self.bgr.rows() as u32);
        if found != size {
            return Err(VideoError::SizeChanged { path: path.clone(), expected: size, found });
        }
        bgr_to_rgb(&self.bgr).map_err(|e| fail(e.message))
    }

    /// What is missing, once the end has been reached.
    pub(crate) fn truncation(&self) -> Option<Truncation> {
        if !self.ended {
            return None;
        }
        let expected = if let Some(timeline) = &self.timeline {
            timeline.nanos().len() as u64
        } else {
            // Other containers only state a length, which sound may stretch a little.
            let secs = self.last_nanos.saturating_add(self.interval_nanos) as f64 * 1e-9;
            let stated = self.stated_secs.filter(|s| s - secs > 1.0 && secs < 0.95 * s)?;
            (f64::from(self.count) * stated / secs).round() as u64
        };
        (u64::from(self.count) < expected).then_some(Truncation { read: self.count, expected })
    }

    fn get(&self, property: i32) -> f64 {
        self.capture.get(property).unwrap_or(0.0)
    }
}

/// The stated rate where the times agree with it, else the mean rate of the times.
fn choose_fps(stated: Option<f64>, timeline: Option<&Timeline>) -> f64 {
    let nanos = timeline.map_or(&[][..], Timeline::nanos);
    let mean = nanos.last().filter(|&&last| last > 0).map(|&last| (nanos.len() - 1) as f64 * 1e9 / last as f64);
    match (stated, mean) {
        (Some(stated), Some(mean)) if (stated / mean - 1.0).abs() < 0.005 => stated,
        (_, Some(mean)) => mean,
        (Some(stated), None) => stated,
        (None, None) => UNKNOWN_FPS,
    }
}

pub(crate) fn bgr_to_rgb(bgr: &Mat) -> opencv::Result<RgbImage> {
    let mut bytes = vec![0u8; bgr.total() * 3];
    let mut rgb = Mat::new_rows_cols_with_bytes_mut::<Vec3b>(bgr.rows(), bgr.cols(), &mut bytes)?;
    opencv::imgproc::cvt_color_def(bgr, &mut rgb, opencv::imgproc::COLOR_BGR2RGB)?;
    drop(rgb);
    RgbImage::from_raw(bgr.cols() as u32, bgr.rows() as u32, bytes)
        .ok_or_else(|| opencv::Error::new(opencv::core::StsUnmatchedSizes, "the picture has a wrong size"))
}

/// Keeps OpenCV and FFmpeg from writing to stderr: what went wrong comes back as an error.
pub(crate) fn silence() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        const LEVEL: &str = "OPENCV_FFMPEG_LOGLEVEL";
        if std::env::var_os(LEVEL).is_none() {
            // -8 is FFmpeg's AV_LOG_QUIET; OpenCV reads it once, when it first touches FFmpeg.
            #[expect(
                unsafe_code,
                reason = "the only switch OpenCV has; set once, under a lock, before FFmpeg starts its threads"
            )]
            // SAFETY: Rust's own readers of the environment are locked out; nothing else here reads it from C.
            unsafe {
                std::env::set_var(LEVEL, "-8");
            }
        }
        // Without it OpenCV is only more talkative.
        let _ = opencv::core::set_log_level(LogLevel::LOG_LEVEL_SILENT);
    });
}
