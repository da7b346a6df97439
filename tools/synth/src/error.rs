//! What can go wrong while a capture is made.

use std::borrow::Cow;

use risorius_formats::{FormatError, Hint};
use risorius_video::VideoError;

/// Why there is no capture.
#[derive(Debug, thiserror::Error)]
pub enum SynthError {
    /// The settings make no sense.
    #[error("{name} is `{value}`, expected {expected}")]
    Setting {
        /// Which setting.
        name: &'static str,
        /// What it was.
        value: String,
        /// What it may be.
        expected: &'static str,
    },
    /// The user stopped the work; nothing was left behind.
    #[error("stopped; nothing was written")]
    Cancelled,
    /// A file could not be written.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// The video could not be written.
    #[error(transparent)]
    Video(#[from] VideoError),
}

impl Hint for SynthError {
    fn hint(&self) -> Option<Cow<'_, str>> {
        match self {
            Self::Setting { .. } | Self::Cancelled => None,
            Self::Format(e) => e.hint(),
            Self::Video(e) => e.hint(),
        }
    }
}
