//! Videos and image folders in, videos out: upright RGB frames with their true presentation times.
//!
//! Files are decoded and encoded by FFmpeg's libraries; nothing of a picture's meaning is left to their defaults:
//!
//! * **Which stream**: covers and attached pictures are passed over; a file of sound alone is called so.
//! * **Colours**: matrix, range and transfer curve are the stream's, and HDR is mapped to SDR (`coding`, `convert`, `hdr`).
//! * **Shape**: pixels that are not square are resampled, rotation and mirror applied; sizes are upright.
//! * **Times** are the container's, counted from the first frame, edit lists included; [`TimeSource`] says where a
//!   container has none.
//! * **Truncation**: a file cut in the middle gives its frames up to the damage, and [`Reader::truncation`] says how many
//!   are missing.
//!
//! [`Camera`] gives a camera's pictures without times: on Linux through the kernel's interface (feature `v4l`), elsewhere
//! through OpenCV (feature `opencv`).

pub mod avc;
mod camera;
mod coding;
mod convert;
mod error;
mod fast;
pub mod fragmented;
mod hdr;
mod images;
mod mp4;
#[cfg(feature = "opencv")]
mod opencv;
mod orientation;
mod pixels;
mod reader;
mod remarks;
mod stream;
mod timeline;
mod times;
pub mod utvideo;
mod video;
mod writer;
mod yuv;

pub use camera::Camera;
pub use error::VideoError;
#[cfg(feature = "opencv")]
pub use opencv::OpenCvCamera;
pub use reader::{Frame, Reader, TimeSource, Truncation, VideoInfo, read_frames, read_take_frames};
pub use remarks::Remark;
pub use timeline::Timeline;
pub use utvideo::{RawLayout, UtEncoder, UtLayout};
pub use writer::Writer;

/// The frame rate of an image folder when nothing else is known.
pub const DEFAULT_IMAGE_FPS: f64 = 30.0;
