//! From a take to what is known about the face in every frame and about every frame's camera.
//!
//! * [`run::run`]: ONNX networks find landmarks, AUs and head pose and write `track/`;
//! * [`import::import`]: an OpenFace table becomes `track/openface.csv` and `track/track.parquet`;
//! * [`poses::find`]: COLMAP, a finished COLMAP model or the head's own motion become `poses/sparse` and `poses/report.json`;
//! * [`check::check`]: how good both are; [`report::write`] shows it as a page.

pub mod aus;
pub mod check;
#[doc(hidden)]
pub mod cli;
pub mod error;
pub mod gaze;
pub mod head_pose;
pub mod import;
pub mod models;
#[cfg(test)]
mod openface_install;
pub mod overlay;
pub mod parquet;
pub mod poses;
pub mod preview;
pub mod quality;
pub mod report;
pub mod run;
mod se3;
pub mod sureness;
#[cfg(test)]
mod testing;
pub mod weights;

pub use error::{Result, TrackerError};
