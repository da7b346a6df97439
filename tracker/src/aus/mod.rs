//! Action units from one face.
//!
//! Two linear readouts score each AU: one reads gradients of the masked, aligned face ([`face`], [`fhog`]), the other the
//! aligned mesh, the blendshape coefficients and the landmark network's feature map ([`readout`]). A score alone says
//! little, because people differ at rest and a turned face scores differently: [`person`] finds the scores of this
//! person's resting face, and the AU is what is above them. How far the two readouts agree is the AU's confidence.

pub mod face;
pub mod fhog;
pub mod memory;
pub mod openface;
pub mod person;
pub mod readout;

pub use person::{Calibration, Person};

/// AUs of a readout, OpenFace's intensities in their order.
pub const UNITS: usize = 17;
/// Scores of a frame: one of each readout for each AU.
pub const SCORES: usize = 2 * UNITS;
/// Where yaw lies in a frame's features.
pub const YAW: usize = SCORES;
/// Where pitch lies in a frame's features.
pub const PITCH: usize = YAW + 1;
/// Numbers kept of every frame: two scores of each AU, then yaw and pitch.
pub const FEATURES: usize = PITCH + 1;

/// Where AUs come from.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum AuSource {
    /// This project's readout, or the AU network of the manifest.
    #[default]
    Own,
    /// OpenFace's models in this folder: see [`openface`].
    OpenFace(std::path::PathBuf),
}

/// Intensities, presences and confidences of one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Units {
    /// 0–5.
    pub intensities: [f32; UNITS],
    /// Whether the AU is there.
    pub presences: [bool; UNITS],
    /// How sure the intensity is, 0–1.
    pub confidences: [f32; UNITS],
}
