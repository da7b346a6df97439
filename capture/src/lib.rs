//! From a video to a take: true times, dropped and repeated frames, sharpness and exposure of every frame.
//!
//! [`record`] streams a video file or an image folder into a take's folder; [`live`] records from a camera
//! ([`source`]: one trait, several ways to a camera); [`check`] says what a take is worth, in sentences a person can act
//! on.

pub mod check;
pub mod cli;
pub mod clock;
pub mod controls;
pub mod devices;
mod error;
pub mod live;
mod measure;
mod media;
pub mod negotiate;
mod numbered;
mod picture;
pub mod preview;
pub mod quality;
pub mod record;
pub mod script;
pub mod sheet;
pub mod source;
pub mod timing;

pub use error::CaptureError;

/// The result of this crate's functions.
pub type Result<T, E = CaptureError> = std::result::Result<T, E>;
