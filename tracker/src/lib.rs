//! From a take to what is known about the face in every frame and about every frame's camera.
//!
//! * [`import::import`]: an OpenFace table becomes `track/openface.csv` and `track/track.parquet`;
//! * [`poses::find`]: COLMAP, a finished COLMAP model or the head's own motion become `poses/sparse` and `poses/report.json`;
//! * [`check::check`]: how good both are.
//!
//! Landmarks and AUs by this program's own models (`tracker run`) do not exist yet.

pub mod check;
#[doc(hidden)]
pub mod cli;
pub mod error;
pub mod import;
pub mod parquet;
pub mod poses;
pub mod preview;
pub mod quality;
mod se3;
#[cfg(test)]
mod testing;

pub use error::{Result, TrackerError};
