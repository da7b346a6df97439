//! What can go wrong, and what the user can do about it.

use std::borrow::Cow;
use std::path::PathBuf;

use risorius_formats::{FormatError, Hint};
use risorius_video::VideoError;

/// A failure of this library.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DatasetError {
    /// A file is missing, broken or contradictory.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// A video cannot be decoded.
    #[error(transparent)]
    Video(#[from] VideoError),
    /// An option makes no sense.
    #[error("{message}")]
    Option {
        /// Which, and why.
        message: String,
        /// What would be right.
        hint: String,
    },
    /// The track of a take has nothing to use.
    #[error("{}: none of {frames} frames has a usable face: {lost} lost, {low_confidence} below the confidence limit, {incomplete} incomplete", path.display())]
    NoValidFrames {
        /// The track's table.
        path: PathBuf,
        /// Frames of the take.
        frames: u32,
        /// Without a face.
        lost: u32,
        /// With an unsure face.
        low_confidence: u32,
        /// With missing or unreadable numbers.
        incomplete: u32,
    },
    /// Tracked frames and posed frames do not meet.
    #[error("{}: none of its {cameras} cameras belongs to one of the {valid} tracked frames", path.display())]
    NoCandidates {
        /// The folder of the poses.
        path: PathBuf,
        /// Posed frames.
        cameras: usize,
        /// Usable tracked frames.
        valid: usize,
    },
    /// Pictures, poses or takes differ in size.
    #[error("{}: is {} × {} pixels, but {what} {} × {}", path.display(), found.0, found.1, expected.0, expected.1)]
    Size {
        /// What has the wrong size.
        path: PathBuf,
        /// What it has to agree with.
        what: &'static str,
        /// The right size.
        expected: (u32, u32),
        /// Its size.
        found: (u32, u32),
    },
    /// A video ends before a frame that the take lists.
    #[error("{}: frame {frame} is not in it", path.display())]
    MissingFrame {
        /// The video or image folder.
        path: PathBuf,
        /// The first frame that did not come.
        frame: u32,
    },
    /// A picture of a dataset cannot be read.
    #[error("{}: cannot be decoded: {message}", path.display())]
    Picture {
        /// The picture.
        path: PathBuf,
        /// What the decoder said.
        message: String,
    },
    /// A picture, plot or table cannot be encoded.
    #[error("{}: cannot encode: {message}", path.display())]
    Encode {
        /// The file that was to be written.
        path: PathBuf,
        /// What the encoder said.
        message: String,
    },
    /// What was imported is no dataset that could be used; nothing was written.
    #[error("{}: cannot be imported, {problems} problems; the first: {first}", folder.display())]
    Unverified {
        /// The folder that was to be imported.
        folder: PathBuf,
        /// How many problems `dataset verify` finds.
        problems: usize,
        /// The first of them.
        first: String,
    },
    /// The user asked to stop.
    #[error("stopped; nothing was written")]
    Cancelled,
}

impl DatasetError {
    pub(crate) fn encode(path: impl Into<PathBuf>, error: &dyn std::fmt::Display) -> Self {
        Self::Encode { path: path.into(), message: error.to_string() }
    }
}

impl Hint for DatasetError {
    fn hint(&self) -> Option<Cow<'_, str>> {
        match self {
            Self::Format(e) => e.hint(),
            Self::Video(e) => e.hint(),
            Self::Option { hint, .. } => Some(Cow::Borrowed(hint)),
            Self::NoValidFrames { .. } => {
                Some("look at `tracker check TAKE`; a lower `--min-confidence` lets unsure frames in".into())
            }
            Self::NoCandidates { .. } => {
                Some("the poses belong to other frames; find them anew with `tracker poses TAKE`".into())
            }
            Self::Size { .. } => Some("track and pose the take's own video, at its full size".into()),
            Self::MissingFrame { .. } => {
                Some("the video is shorter than frames.csv says; make the take again with `capture record`".into())
            }
            Self::Picture { .. } => Some("it is missing, damaged or of another kind; see `dataset verify`".into()),
            Self::Unverified { folder, .. } => Some(
                format!(
                    "nothing was written; `dataset verify {}` lists what to correct in the folder",
                    folder.display()
                )
                .into(),
            ),
            Self::Encode { .. } | Self::Cancelled => None,
        }
    }
}

/// The result of everything here.
pub type Result<T, E = DatasetError> = std::result::Result<T, E>;
