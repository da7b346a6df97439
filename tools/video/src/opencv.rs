//! A camera through OpenCV: decoded pictures, and nothing about when they were taken.

use opencv::core::{Mat, MatTraitConst, MatTraitConstManual};
use opencv::prelude::{VideoCaptureTrait, VideoCaptureTraitConst};
use opencv::videoio::{self, VideoCapture};

/// A camera by OpenCV's number of it.
#[derive(Debug)]
pub struct OpenCvCamera {
    capture: VideoCapture,
    bgr: Mat,
}

impl OpenCvCamera {
    /// Opens a camera; `None` if there is none of this number.
    pub fn open(number: i32) -> Option<Self> {
        let capture = VideoCapture::new(number, videoio::CAP_ANY).ok()?;
        capture.is_opened().unwrap_or(false).then(|| Self { capture, bgr: Mat::default() })
    }

    /// Asks for a size and a rate; gives those that the camera took, 0 for an unknown rate.
    pub fn start(&mut self, width: u32, height: u32, fps: f64) -> (u32, u32, f64) {
        let wishes = [
            (videoio::CAP_PROP_FRAME_WIDTH, f64::from(width)),
            (videoio::CAP_PROP_FRAME_HEIGHT, f64::from(height)),
            (videoio::CAP_PROP_FPS, fps),
        ];
        let taken = wishes.map(|(property, value)| {
            // What it does not take shows in the values below.
            let _ = self.capture.set(property, value);
            self.capture.get(property).unwrap_or(0.0)
        });
        (taken[0] as u32, taken[1] as u32, taken[2])
    }

    /// Waits for the next picture and puts it into `bgr`, 3 bytes a pixel; false when none comes any more.
    pub fn grab(&mut self, bgr: &mut Vec<u8>) -> bool {
        let came = self.capture.read(&mut self.bgr).unwrap_or(false) && !self.bgr.empty();
        bgr.clear();
        match self.bgr.data_bytes() {
            Ok(bytes) if came => bgr.extend_from_slice(bytes),
            _ => return false,
        }
        true
    }
}
