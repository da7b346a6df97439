//! The last resort: OpenCV's camera, which gives decoded pictures without sequence numbers or the driver's times.

use std::time::Duration;

use risorius_video::OpenCvCamera;

use super::{FrameSource, Grab, Grabbed, Mode, PixelFormat, Rate, Rates, Started};
use crate::negotiate::{COMMON_SIZES, Choice};
use crate::{CaptureError, Result};

/// A camera by its number.
pub(super) struct Camera {
    device: String,
    camera: OpenCvCamera,
}

impl Camera {
    pub(super) fn open(name: &str) -> Result<Self> {
        let device = format!("opencv:{name}");
        let number = name.parse().map_err(|_| CaptureError::NotACamera { device: device.clone() })?;
        let camera = OpenCvCamera::open(number).ok_or_else(|| CaptureError::NotACamera { device: device.clone() })?;
        Ok(Self { device, camera })
    }
}

impl FrameSource for Camera {
    fn name(&self) -> String {
        self.device.clone()
    }

    fn modes(&mut self, wanted: Option<(u32, u32)>) -> Result<Vec<Mode>> {
        let sizes = COMMON_SIZES.into_iter().chain(wanted);
        Ok(sizes
            .map(|(width, height)| Mode { format: PixelFormat::Bgr24, width, height, rates: Rates::Unknown })
            .collect())
    }

    fn start(&mut self, choice: &Choice, _buffers: u32) -> Result<Started> {
        let (width, height, fps) = self.camera.start(choice.width, choice.height, choice.rate.fps());
        if (width, height) != (choice.width, choice.height) {
            return Err(CaptureError::Camera {
                device: self.device.clone(),
                action: "set the size",
                message: format!("asked for {}×{}, OpenCV gives {width}×{height}", choice.width, choice.height),
            });
        }
        let rate = (fps > 0.0).then(|| Rate::from_fps(fps));
        Ok(Started { format: PixelFormat::Bgr24, width, height, stride: 3 * width as usize, rate, buffers: 1 })
    }

    fn grab(&mut self, _timeout: Duration, frame: &mut Grabbed) -> Result<Grab> {
        (frame.sequence, frame.driver_nanos, frame.is_corrupt) = (None, None, false);
        if self.camera.grab(&mut frame.data) {
            Ok(Grab::Frame)
        } else {
            Err(CaptureError::Unplugged { device: self.device.clone() })
        }
    }

    fn stop(&mut self) {}
}
