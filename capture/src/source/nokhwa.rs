//! Cameras on macOS (AVFoundation) and Windows (Media Foundation) through `nokhwa`.
//!
//! It gives native frames and, on some systems, the time of capture, but no sequence numbers: lost frames are then told
//! from the times.

use std::time::Duration;

use ::nokhwa::pixel_format::RgbFormat;
use ::nokhwa::utils::{
    ApiBackend, CameraFormat, CameraIndex, FrameFormat, RequestedFormat, RequestedFormatType, Resolution,
};
use ::nokhwa::{NokhwaError, query};

use super::{FrameSource, Grab, Grabbed, Mode, PixelFormat, Rate, Rates, Started};
use crate::negotiate::Choice;
use crate::{CaptureError, Result};

/// A camera by its number.
pub(super) struct Camera {
    device: String,
    camera: ::nokhwa::Camera,
}

/// The cameras, as (device, name).
#[cfg_attr(all(feature = "v4l", target_os = "linux"), expect(dead_code, reason = "the kernel's list is used on Linux"))]
pub(super) fn list() -> Vec<(String, String)> {
    let found = query(ApiBackend::Auto).unwrap_or_default();
    found.into_iter().map(|info| (format!("nokhwa:{}", info.index()), info.human_name())).collect()
}

impl Camera {
    pub(super) fn open(name: &str) -> Result<Self> {
        let device = format!("nokhwa:{name}");
        let number = name.parse().map_err(|_| CaptureError::NotACamera { device: device.clone() })?;
        let any = RequestedFormat::new::<RgbFormat>(RequestedFormatType::None);
        let camera = ::nokhwa::Camera::new(CameraIndex::Index(number), any).map_err(|e| CaptureError::Camera {
            device: device.clone(),
            action: "open",
            message: e.to_string(),
        })?;
        Ok(Self { device, camera })
    }

    fn fail(&self, action: &'static str, error: &NokhwaError) -> CaptureError {
        CaptureError::Camera { device: self.device.clone(), action, message: error.to_string() }
    }
}

fn from_native(format: FrameFormat) -> PixelFormat {
    match format {
        FrameFormat::MJPEG => PixelFormat::Mjpeg,
        FrameFormat::YUYV => PixelFormat::Yuyv,
        FrameFormat::NV12 => PixelFormat::Nv12,
        FrameFormat::GRAY => PixelFormat::Grey,
        FrameFormat::RAWRGB => PixelFormat::Rgb24,
        FrameFormat::RAWBGR => PixelFormat::Bgr24,
    }
}

fn to_native(format: PixelFormat) -> Option<FrameFormat> {
    let all = [
        FrameFormat::MJPEG,
        FrameFormat::YUYV,
        FrameFormat::NV12,
        FrameFormat::GRAY,
        FrameFormat::RAWRGB,
        FrameFormat::RAWBGR,
    ];
    all.into_iter().find(|f| from_native(*f) == format)
}

impl FrameSource for Camera {
    fn name(&self) -> String {
        self.camera.info().human_name()
    }

    fn modes(&mut self, _wanted: Option<(u32, u32)>) -> Result<Vec<Mode>> {
        let found = self.camera.compatible_camera_formats().map_err(|e| self.fail("list the formats", &e))?;
        let mut modes: Vec<Mode> = Vec::new();
        for native in found {
            let (format, width, height) = (from_native(native.format()), native.width(), native.height());
            let rate = Rate { frames: native.frame_rate(), secs: 1 };
            let same = modes.iter_mut().find(|m| (m.format, m.width, m.height) == (format, width, height));
            match same.map(|m| &mut m.rates) {
                Some(Rates::Exactly(rates)) => rates.push(rate),
                _ => modes.push(Mode { format, width, height, rates: Rates::Exactly(vec![rate]) }),
            }
        }
        Ok(modes)
    }

    fn start(&mut self, choice: &Choice, _buffers: u32) -> Result<Started> {
        let Some(native) = to_native(choice.format) else {
            return Err(CaptureError::NotACamera { device: self.device.clone() });
        };
        let size = Resolution::new(choice.width, choice.height);
        let wanted = CameraFormat::new(size, native, choice.rate.fps().round() as u32);
        self.camera
            .set_camera_requset(RequestedFormat::new::<RgbFormat>(RequestedFormatType::Exact(wanted)))
            .map_err(|e| self.fail("set the format", &e))?;
        self.camera.open_stream().map_err(|e| self.fail("start", &e))?;
        let given = self.camera.camera_format();
        let format = from_native(given.format());
        let stride = format.raw().map_or(0, |raw| raw.row_bytes(given.width()));
        Ok(Started {
            format,
            width: given.width(),
            height: given.height(),
            stride,
            rate: Some(Rate { frames: given.frame_rate(), secs: 1 }),
            // nokhwa keeps its own.
            buffers: 0,
        })
    }

    fn grab(&mut self, _timeout: Duration, frame: &mut Grabbed) -> Result<Grab> {
        let buffer = self.camera.frame().map_err(|_| CaptureError::Unplugged { device: self.device.clone() })?;
        frame.data.clear();
        frame.data.extend_from_slice(buffer.buffer());
        frame.sequence = None;
        frame.driver_nanos = buffer.capture_timestamp().and_then(|t| i64::try_from(t.as_nanos()).ok());
        frame.is_corrupt = frame.data.is_empty();
        Ok(Grab::Frame)
    }

    fn stop(&mut self) {
        // A camera that has gone cannot be stopped, and need not be.
        let _ = self.camera.stop_stream();
    }
}
