//! Action units from the landmark network.
//!
//! A [`readout`] is linear: from the aligned mesh, the blendshape coefficients and what the landmark network thinks inside
//! (the feature maps before its points) to one score for each AU. A score alone says little, because people differ at rest
//! and the network sees a turned face differently: [`person`] finds what the scores of this person's resting face are, for
//! every pose, and the AU is what is above that.

pub mod person;
pub mod readout;

pub use person::{Calibration, Person};

/// AUs of a readout, OpenFace's intensities in their order.
pub const UNITS: usize = 17;
/// Terms of a person's resting score: 1, yaw, pitch, yaw², yaw × pitch, pitch².
pub const POSE_TERMS: usize = 6;
/// Numbers kept of every frame: scores, then yaw and pitch.
pub const FEATURES: usize = UNITS + 2;

/// Intensities and presences of one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Units {
    /// 0–5.
    pub intensities: [f32; UNITS],
    /// Whether the AU is there.
    pub presences: [bool; UNITS],
}

/// The terms of a pose.
fn pose_terms(yaw: f64, pitch: f64) -> [f64; POSE_TERMS] {
    [1.0, yaw, pitch, yaw * yaw, yaw * pitch, pitch * pitch]
}
