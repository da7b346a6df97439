//! Videos and image folders in, videos out: upright RGB frames with their true presentation times.
//!
//! Decoding and encoding are OpenCV's (its FFmpeg part). What OpenCV gets wrong is put right here:
//!
//! * **Times** of MP4 and MOV files come from the container's own tables, edit lists included ([`Timeline`]), because
//!   OpenCV reports 0 for the last frames of H.264 files. For other containers OpenCV's times are taken; where it has
//!   none, the last interval is repeated.
//! * **Rotation** that the container asks for is applied, and a mirror too; sizes are upright. OpenCV 4.6 turns the
//!   wrong way.
//! * **Truncation**: a file cut in the middle gives its frames up to the damage, and [`Reader::truncation`] says how many
//!   are missing.

pub mod avc;
mod camera;
mod error;
pub mod fragmented;
mod images;
mod mp4;
mod orientation;
mod reader;
mod timeline;
pub mod utvideo;
mod video;
mod writer;

pub use camera::Camera;
pub use error::VideoError;
pub use reader::{Frame, Reader, Truncation, VideoInfo, read_frames};
pub use timeline::Timeline;
pub use utvideo::{RawLayout, UtEncoder, UtLayout};
pub use writer::Writer;

/// The frame rate of an image folder when nothing else is known.
pub const DEFAULT_IMAGE_FPS: f64 = 30.0;
