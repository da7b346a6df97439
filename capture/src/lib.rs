//! From a video to a take: true times, dropped and repeated frames, sharpness and exposure of every frame.
//!
//! [`record`] streams a video file or an image folder into a take's folder; [`check`] says what a take is worth, in
//! sentences a person can act on. Recording from a camera comes later; [`devices`] lists what the kernel knows.

pub mod check;
pub mod cli;
pub mod devices;
mod error;
mod media;
pub mod quality;
pub mod record;
pub mod sheet;
pub mod timing;

pub use error::CaptureError;

/// The result of this crate's functions.
pub type Result<T, E = CaptureError> = std::result::Result<T, E>;
