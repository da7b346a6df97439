//! What to make.

use serde::{Deserialize, Serialize};

use crate::error::SynthError;
use crate::table::Noise;

/// The settings of a capture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Frames of the video.
    pub frames: u32,
    /// Frames per second.
    pub fps: f64,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Drives everything that is random.
    pub seed: u64,
    /// Whether a second person and the truth of the transfer are made too.
    pub driver: bool,
    /// Whether the camera stands still.
    pub static_camera: bool,
    /// Whether the table is noisy.
    pub noise: bool,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            frames: 360,
            fps: 60.0,
            width: 270,
            height: 480,
            seed: 1,
            driver: false,
            static_camera: false,
            noise: true,
        }
    }
}

impl Settings {
    /// Fails where a setting is out of its range.
    pub fn validate(&self) -> Result<(), SynthError> {
        let fail = |name, value: String, expected| Err(SynthError::Setting { name, value, expected });
        if !(2..=100_000).contains(&self.frames) {
            return fail("frames", self.frames.to_string(), "2 to 100000");
        }
        if !(self.fps.is_finite() && self.fps > 0.0 && self.fps <= 1000.0) {
            return fail("fps", self.fps.to_string(), "a rate of up to 1000 frames per second");
        }
        if !(16..=4096).contains(&self.width) || !(16..=4096).contains(&self.height) {
            return fail("size", format!("{}x{}", self.width, self.height), "16 to 4096 pixels a side");
        }
        Ok(())
    }

    /// The noise of the tables.
    pub fn table_noise(&self) -> Noise {
        if self.noise { Noise::ON } else { Noise::OFF }
    }
}
