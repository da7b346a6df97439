//! What can go wrong in the trainer.

use std::borrow::Cow;
use std::path::PathBuf;

use risorius_formats::{FormatError, Hint};
use risorius_video::VideoError;

/// An error of the trainer.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrainerError {
    /// A file is missing, broken or of another kind.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// A video could not be written.
    #[error(transparent)]
    Video(#[from] VideoError),
    /// An image could not be read or written.
    #[error("{}: {message}", path.display())]
    Image {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        message: String,
    },
    /// The dataset cannot be fitted.
    #[error("{}: {message}", path.display())]
    Dataset {
        /// The dataset's folder or the file in it.
        path: PathBuf,
        /// What is wrong.
        message: String,
        /// What to do.
        hint: String,
    },
    /// A run's folder does not hold what is asked of it.
    #[error("{}: {message}", path.display())]
    Run {
        /// The run's folder or the file in it.
        path: PathBuf,
        /// What is wrong.
        message: String,
        /// What to do.
        hint: String,
    },
    /// A number left the range of numbers.
    #[error("step {step}: {what} is not a finite number")]
    NotFinite {
        /// The step of the fit.
        step: u64,
        /// Which number.
        what: String,
    },
    /// The device is not there, or not built in.
    #[error("device `{device}`: {message}")]
    Device {
        /// What was asked for.
        device: String,
        /// Why not.
        message: String,
        /// What to do.
        hint: String,
    },
    /// A setting makes no sense or names something that is not there.
    #[error("{message}")]
    Setting {
        /// Which and why.
        message: String,
        /// What to do.
        hint: String,
    },
    /// The user asked to stop; everything up to the last checkpoint is on disk.
    #[error("stopped by the user after {done}")]
    Interrupted {
        /// How far it got.
        done: String,
    },
}

impl Hint for TrainerError {
    fn hint(&self) -> Option<Cow<'_, str>> {
        match self {
            Self::Format(e) => e.hint(),
            Self::Video(e) => e.hint(),
            Self::Image { .. } => None,
            Self::Dataset { hint, .. }
            | Self::Run { hint, .. }
            | Self::Device { hint, .. }
            | Self::Setting { hint, .. } => (!hint.is_empty()).then_some(Cow::Borrowed(hint)),
            Self::NotFinite { .. } => Some(Cow::Borrowed(
                "the last checkpoint is whole; resume it with a smaller learning rate, or look at the frame's AUs and camera",
            )),
            Self::Interrupted { .. } => Some(Cow::Borrowed("go on with `--resume`")),
        }
    }
}

/// The result of the trainer's functions.
pub type Result<T, E = TrainerError> = std::result::Result<T, E>;
