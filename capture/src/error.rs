//! What can go wrong while a take is made or checked.

use std::borrow::Cow;
use std::path::PathBuf;

use risorius_formats::{FormatError, Hint};
use risorius_video::VideoError;
use thiserror::Error;

/// What can go wrong while a take is made or checked.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CaptureError {
    /// A file of the take or the copy of the media.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// The video or the images.
    #[error(transparent)]
    Video(#[from] VideoError),
    /// There is something at the take's place.
    #[error("{}: already exists", path.display())]
    Exists {
        /// The take's folder.
        path: PathBuf,
    },
    /// The take would swallow its own source.
    #[error("{}: lies in the take's folder `{}`, which is going to be replaced", input.display(), out.display())]
    InputInsideOutput {
        /// The video or folder.
        input: PathBuf,
        /// The take's folder.
        out: PathBuf,
    },
    /// The user asked to stop.
    #[error("stopped by Ctrl-C: nothing was written")]
    Interrupted,
    /// A part of the program broke down.
    #[error("the {part} thread broke down")]
    Thread {
        /// Which part.
        part: &'static str,
    },
}

impl Hint for CaptureError {
    fn hint(&self) -> Option<Cow<'_, str>> {
        match self {
            Self::Format(e) => e.hint(),
            Self::Video(e) => e.hint(),
            Self::Exists { .. } => Some(Cow::Borrowed("choose another `--out`, or replace it with `--force`")),
            Self::InputInsideOutput { .. } => Some(Cow::Borrowed("choose another `--out`")),
            Self::Interrupted | Self::Thread { .. } => None,
        }
    }
}
