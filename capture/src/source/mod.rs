//! Where live frames come from: one trait, and a backend for each way to a camera.
//!
//! A source hands out native frames (compressed or raw, never converted) with the driver's sequence number and time. The
//! recorder does all the rest, so that a backend is only what differs between systems.

mod synthetic;

#[cfg(feature = "nokhwa")]
mod nokhwa;
#[cfg(feature = "opencv")]
mod opencv;
#[cfg(all(feature = "v4l", target_os = "linux"))]
mod v4l;

use std::time::Duration;

use risorius_video::RawLayout;
use serde::{Deserialize, Serialize};

pub use synthetic::{Faults, Synthetic};

use crate::negotiate::Choice;
use crate::{CaptureError, Result};

/// What a camera's frames are made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PixelFormat {
    /// A JPEG picture a frame.
    Mjpeg,
    /// H.264 with start codes.
    H264,
    /// Raw 4:2:2, Y U Y V.
    Yuyv,
    /// Raw 4:2:2, U Y V Y.
    Uyvy,
    /// Raw 4:2:0, Y, then U V pairs.
    Nv12,
    /// Raw 4:2:0, Y, U, V.
    I420,
    /// One byte a pixel.
    Grey,
    /// R G B.
    Rgb24,
    /// B G R.
    Bgr24,
}

impl PixelFormat {
    /// All of them, the lighter ones first.
    pub const ALL: [Self; 9] =
        [Self::Nv12, Self::I420, Self::Yuyv, Self::Uyvy, Self::Grey, Self::Rgb24, Self::Bgr24, Self::Mjpeg, Self::H264];

    /// The name that Linux drivers use.
    pub fn fourcc(self) -> [u8; 4] {
        match self {
            Self::Mjpeg => *b"MJPG",
            Self::H264 => *b"H264",
            Self::Yuyv => *b"YUYV",
            Self::Uyvy => *b"UYVY",
            Self::Nv12 => *b"NV12",
            Self::I420 => *b"YU12",
            Self::Grey => *b"GREY",
            Self::Rgb24 => *b"RGB3",
            Self::Bgr24 => *b"BGR3",
        }
    }

    /// The format of that name; `JPEG` is another name of MJPEG.
    pub fn from_fourcc(name: [u8; 4]) -> Option<Self> {
        if &name == b"JPEG" {
            return Some(Self::Mjpeg);
        }
        Self::ALL.into_iter().find(|f| f.fourcc() == name)
    }

    /// How raw pictures lie in memory; `None` for compressed ones.
    pub fn raw(self) -> Option<RawLayout> {
        match self {
            Self::Mjpeg | Self::H264 => None,
            Self::Yuyv => Some(RawLayout::Yuyv),
            Self::Uyvy => Some(RawLayout::Uyvy),
            Self::Nv12 => Some(RawLayout::Nv12),
            Self::I420 => Some(RawLayout::I420),
            Self::Grey => Some(RawLayout::Grey),
            Self::Rgb24 => Some(RawLayout::Rgb24),
            Self::Bgr24 => Some(RawLayout::Bgr24),
        }
    }

    /// The name in commands and files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Mjpeg => "mjpeg",
            Self::H264 => "h264",
            Self::Yuyv => "yuyv",
            Self::Uyvy => "uyvy",
            Self::Nv12 => "nv12",
            Self::I420 => "i420",
            Self::Grey => "grey",
            Self::Rgb24 => "rgb24",
            Self::Bgr24 => "bgr24",
        }
    }
}

impl std::fmt::Display for PixelFormat {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl std::str::FromStr for PixelFormat {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL.into_iter().find(|f| f.name().eq_ignore_ascii_case(text)).ok_or_else(|| {
            let names: Vec<_> = Self::ALL.iter().map(|f| f.name()).collect();
            format!("expected one of {}", names.join(", "))
        })
    }
}

/// A frame rate as the driver states it: `frames` in `secs` seconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Rate {
    /// Frames …
    pub frames: u32,
    /// … in so many seconds.
    pub secs: u32,
}

impl Rate {
    /// Frames per second; 0 for a rate without time.
    pub fn fps(self) -> f64 {
        if self.secs == 0 { 0.0 } else { f64::from(self.frames) / f64::from(self.secs) }
    }

    /// The nearest rate in thousandths, as a driver's fraction.
    pub fn from_fps(fps: f64) -> Self {
        if fps.fract().abs() < 1e-9 {
            return Self { frames: fps as u32, secs: 1 };
        }
        Self { frames: (fps * 1000.0).round() as u32, secs: 1000 }
    }
}

/// The rates of a mode.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Rates {
    /// These and no others.
    Exactly(Vec<Rate>),
    /// Any between the two, frames per second.
    Between {
        /// The lowest.
        lowest: f64,
        /// The highest.
        highest: f64,
    },
    /// The driver does not say.
    Unknown,
}

/// A way in which a camera can work.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Mode {
    /// What its frames are made of.
    pub format: PixelFormat,
    /// Pixels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Its frame rates.
    pub rates: Rates,
}

/// What a control means to a recording, where that is known.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Role {
    /// 1 is manual; what else it may be depends on the camera.
    ExposureAuto,
    /// In steps of 100 µs.
    ExposureTime,
    /// Whether the rate may fall to lengthen the exposure.
    ExposureMayLowerRate,
    /// The sensor's amplification.
    Gain,
    /// Whether the focus follows.
    FocusAuto,
    /// The lens.
    Focus,
    /// Whether the white balance follows.
    WhiteBalanceAuto,
    /// The white balance, kelvin.
    WhiteBalance,
}

/// A control of a camera.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Control {
    /// The backend's number of it.
    pub id: u32,
    /// The driver's name of it.
    pub name: String,
    /// What it means, where that is known.
    pub role: Option<Role>,
    /// The lowest value.
    pub lowest: i64,
    /// The highest value.
    pub highest: i64,
    /// Values are the lowest plus a multiple of this.
    pub step: i64,
    /// The driver's default.
    pub default: i64,
    /// The value now.
    pub value: i64,
    /// Whether it can be set just now; a manual exposure cannot while the automatic one works.
    pub settable: bool,
}

/// What a camera agreed to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Started {
    /// What its frames are made of.
    pub format: PixelFormat,
    /// Pixels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Bytes from a row of a raw picture to the next.
    pub stride: usize,
    /// The rate; `None` where the driver does not say.
    pub rate: Option<Rate>,
    /// Buffers that the driver fills.
    pub buffers: u32,
}

/// A frame as it came.
#[derive(Clone, Debug, Default)]
pub struct Grabbed {
    /// The native bytes.
    pub data: Vec<u8>,
    /// The driver's count of frames, lost ones included; it wraps.
    pub sequence: Option<u32>,
    /// The driver's time of the exposure, on any clock that ascends.
    pub driver_nanos: Option<i64>,
    /// The driver says that something is wrong with the picture.
    pub is_corrupt: bool,
}

/// What became of an attempt to get a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Grab {
    /// A frame came.
    Frame,
    /// None came in time.
    Timeout,
}

/// A camera, or what stands for one.
pub trait FrameSource: Send {
    /// The name that people know it by.
    fn name(&self) -> String;

    /// Its modes; where a driver allows any size, the usual ones and `wanted`.
    fn modes(&mut self, wanted: Option<(u32, u32)>) -> Result<Vec<Mode>>;

    /// Its controls; none where the backend has none.
    fn controls(&mut self) -> Result<Vec<Control>> {
        Ok(Vec::new())
    }

    /// Sets a control.
    fn set_control(&mut self, control: &Control, value: i64) -> Result<()> {
        let _ = value;
        Err(CaptureError::Control { name: control.name.clone(), message: "this backend has no controls".to_owned() })
    }

    /// Begins to stream into `buffers` of the driver's buffers.
    fn start(&mut self, choice: &Choice, buffers: u32) -> Result<Started>;

    /// Waits at most `timeout` for the next frame and copies it into `frame`, whose memory is used again.
    fn grab(&mut self, timeout: Duration, frame: &mut Grabbed) -> Result<Grab>;

    /// Ends streaming; harmless when it has not begun.
    fn stop(&mut self);
}

/// Opens a camera by its name: `synthetic:1280x720@120`, `/dev/video0`, `0`, `nokhwa:0` or `opencv:0`.
pub fn open(device: &str) -> Result<Box<dyn FrameSource>> {
    if let Some(settings) = device.strip_prefix("synthetic:").or((device == "synthetic").then_some("")) {
        return Ok(Box::new(Synthetic::parse(settings)?));
    }
    let (backend, rest) = device.split_once(':').map_or(("", device), |(b, rest)| (b, rest));
    match backend {
        #[cfg(feature = "nokhwa")]
        "nokhwa" => Ok(Box::new(nokhwa::Camera::open(rest)?)),
        #[cfg(feature = "opencv")]
        "opencv" => Ok(Box::new(opencv::Camera::open(rest)?)),
        #[cfg(all(feature = "v4l", target_os = "linux"))]
        "" | "v4l" => Ok(Box::new(v4l::Camera::open(rest)?)),
        #[cfg(all(feature = "nokhwa", not(all(feature = "v4l", target_os = "linux"))))]
        "" => Ok(Box::new(nokhwa::Camera::open(rest)?)),
        #[cfg(all(feature = "opencv", not(feature = "nokhwa"), not(all(feature = "v4l", target_os = "linux"))))]
        "" => Ok(Box::new(opencv::Camera::open(rest)?)),
        _ => {
            // Used by the backends, if there are any.
            let _ = rest;
            Err(CaptureError::NoBackend { device: device.to_owned(), built_in: backends() })
        }
    }
}

/// The backends that this program was built with.
pub fn backends() -> Vec<&'static str> {
    let mut out = Vec::new();
    if cfg!(all(feature = "v4l", target_os = "linux")) {
        out.push("v4l");
    }
    if cfg!(feature = "nokhwa") {
        out.push("nokhwa");
    }
    if cfg!(feature = "opencv") {
        out.push("opencv");
    }
    out.push("synthetic");
    out
}

/// The cameras that the backends other than the kernel's list know, as (device, name).
pub(crate) fn other_cameras() -> Vec<(String, String)> {
    #[cfg(all(feature = "nokhwa", not(all(feature = "v4l", target_os = "linux"))))]
    return nokhwa::list();
    #[cfg(not(all(feature = "nokhwa", not(all(feature = "v4l", target_os = "linux")))))]
    Vec::new()
}
