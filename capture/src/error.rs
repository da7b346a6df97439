//! What can go wrong while a take is made or checked.

use std::borrow::Cow;
use std::path::PathBuf;

use risorius_formats::{FormatError, Hint};
use risorius_video::VideoError;
use thiserror::Error;

use crate::negotiate::{Refusal, number};

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
    /// A stream that says neither its times nor its rate.
    #[error("{}: has no times and states no frame rate", path.display())]
    NoTimes {
        /// The video.
        path: PathBuf,
    },
    /// The camera refused.
    #[error("{device}: cannot {action} the camera: {message}")]
    Camera {
        /// The camera.
        device: String,
        /// What failed.
        action: &'static str,
        /// The system's reason.
        message: String,
    },
    /// The user may not open the camera.
    #[error("{device}: no permission to open the camera")]
    Forbidden {
        /// The camera.
        device: String,
    },
    /// There is no such device.
    #[error("{device}: there is no such camera")]
    NoSuchCamera {
        /// The camera.
        device: String,
    },
    /// A device that gives no pictures.
    #[error("{device}: is not a camera")]
    NotACamera {
        /// The device.
        device: String,
    },
    /// The camera went away.
    #[error("{device}: the camera was unplugged")]
    Unplugged {
        /// The camera.
        device: String,
    },
    /// Another program uses the camera.
    #[error("{device}: the camera is in use by another program")]
    Busy {
        /// The camera.
        device: String,
    },
    /// The camera gives no frames.
    #[error("{device}: the camera has given no frame for {secs} s")]
    Silent {
        /// The camera.
        device: String,
        /// How long.
        secs: u64,
    },
    /// The camera cannot do what is asked.
    #[error("{device}: {refusal}")]
    Refused {
        /// The camera.
        device: String,
        /// Why not, and what it can do.
        refusal: Box<Refusal>,
    },
    /// The driver set another rate than its own list has.
    #[error("{device}: was asked for {} frames/s and set {}", number(*asked), number(*given))]
    RateNotKept {
        /// The camera.
        device: String,
        /// Frames per second.
        asked: f64,
        /// Frames per second.
        given: f64,
    },
    /// A control cannot be set.
    #[error("control `{name}`: {message}")]
    Control {
        /// The control.
        name: String,
        /// The driver's reason.
        message: String,
    },
    /// A control that the camera does not have, or a name that several have.
    #[error("the camera has no control, or more than one, that is called {name}")]
    NoControl {
        /// What was asked for.
        name: String,
        /// What it has.
        known: Vec<String>,
    },
    /// An exposure longer than a frame.
    #[error("an exposure of {:.1} ms is longer than a frame ({:.1} ms)", asked.as_secs_f64() * 1e3, interval_secs * 1e3)]
    ExposureTooLong {
        /// What was asked for.
        asked: std::time::Duration,
        /// Time from frame to frame, seconds.
        interval_secs: f64,
    },
    /// This program was built without the backend.
    #[error("{device}: this program was built without a way to such cameras")]
    NoBackend {
        /// The camera.
        device: String,
        /// What it was built with.
        built_in: Vec<&'static str>,
    },
    /// Settings of the synthetic camera.
    #[error("synthetic:{text}: cannot use `{what}`")]
    Synthetic {
        /// The settings.
        text: String,
        /// The part that is wrong.
        what: String,
    },
    /// A folder without a recording.
    #[error("{}: is not a recording from a camera", path.display())]
    NotARecording {
        /// The folder.
        path: PathBuf,
    },
    /// A recording that was cut off before its first frames were on the disk.
    #[error("{}: not one frame was recorded", path.display())]
    NothingRecorded {
        /// The folder.
        path: PathBuf,
    },
    /// The page for looking at the recording.
    #[error("cannot show the preview: {message}")]
    Preview {
        /// The system's reason.
        message: String,
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
            Self::NoTimes { .. } => Some(Cow::Borrowed("state its rate with `--fps`, in frames per second")),
            Self::InputInsideOutput { .. } => Some(Cow::Borrowed("choose another `--out`")),
            Self::Refused { refusal, .. } => Some(Cow::Owned(refusal.advice())),
            Self::NoControl { known, .. } if known.is_empty() => Some(Cow::Borrowed("this camera has no controls")),
            Self::NoControl { known, .. } => Some(Cow::Owned(format!("it has {}", known.join(", ")))),
            Self::NoBackend { built_in, .. } => Some(Cow::Owned(format!(
                "it has {}; build it with `--features nokhwa` or `opencv`",
                built_in.join(", ")
            ))),
            Self::Forbidden { .. } => {
                Some(Cow::Borrowed("on Linux: add yourself to the group `video`, then log in again"))
            }
            Self::Camera { .. } | Self::NoSuchCamera { .. } | Self::NotACamera { .. } => {
                Some(Cow::Borrowed("`capture devices` lists the cameras"))
            }
            Self::Unplugged { .. } | Self::Silent { .. } => {
                Some(Cow::Borrowed("check the cable; use a port of the computer itself rather than a hub"))
            }
            Self::Busy { .. } => Some(Cow::Borrowed("close the other program, such as a browser or a video call")),
            Self::RateNotKept { .. } => {
                Some(Cow::Borrowed("try another `--format`, or one of the camera's other rates"))
            }
            Self::Control { .. } => Some(Cow::Borrowed("`capture devices` lists the controls and their ranges")),
            Self::ExposureTooLong { .. } => Some(Cow::Borrowed("shorten the exposure and add light, or lower `--fps`")),
            Self::Synthetic { .. } => {
                Some(Cow::Borrowed("such as `synthetic:1280x720@120`, `synthetic:640x480@30,yuyv`"))
            }
            Self::NotARecording { .. } => {
                Some(Cow::Borrowed("only takes of `capture record --device` can be recovered"))
            }
            Self::NothingRecorded { .. } => Some(Cow::Borrowed("record again")),
            Self::Preview { .. } => Some(Cow::Borrowed("take another port with `--preview-port`")),
            Self::Interrupted | Self::Thread { .. } => None,
        }
    }
}

impl CaptureError {
    /// Why a camera cannot be opened.
    #[cfg_attr(not(all(feature = "v4l", target_os = "linux")), expect(dead_code, reason = "for the kernel's cameras"))]
    pub(crate) fn open(device: &str, error: &std::io::Error) -> Self {
        let device = device.to_owned();
        match error.kind() {
            std::io::ErrorKind::NotFound => Self::NoSuchCamera { device },
            std::io::ErrorKind::PermissionDenied => Self::Forbidden { device },
            std::io::ErrorKind::ResourceBusy => Self::Busy { device },
            _ => Self::Camera { device, action: "open", message: error.to_string() },
        }
    }
}
