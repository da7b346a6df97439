//! What can go wrong with a video, with the file's name first.

use std::borrow::Cow;
use std::path::PathBuf;

use risorius_formats::{FormatError, Hint};
use thiserror::Error;

/// What can go wrong with a video or an image folder.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum VideoError {
    /// The operating system refused.
    #[error(transparent)]
    File(#[from] FormatError),
    /// A file of zero bytes.
    #[error("{}: is empty", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// Neither a regular file nor a folder.
    #[error("{}: is neither a file nor a folder", path.display())]
    NotAFile {
        /// The path.
        path: PathBuf,
    },
    /// The bytes are no video that can be decoded here.
    #[error("{}: is not a video that can be decoded", path.display())]
    NotAVideo {
        /// The file.
        path: PathBuf,
    },
    /// An MP4 or MOV file without its index.
    #[error("{}: is truncated: the index (`moov`) of this MP4 file is missing", path.display())]
    NoIndex {
        /// The file.
        path: PathBuf,
    },
    /// A file of sound, or of nothing that can be seen.
    #[error("{}: has no video track{}", path.display(), if *sound { " (sound only)" } else { "" })]
    NoVideoTrack {
        /// The file.
        path: PathBuf,
        /// Whether there is sound.
        sound: bool,
    },
    /// FFmpeg was built without a decoder for this.
    #[error("{}: cannot decode {codec} here: {message}", path.display())]
    NoDecoder {
        /// The file.
        path: PathBuf,
        /// FFmpeg's name of the codec.
        codec: String,
        /// FFmpeg's reason.
        message: String,
    },
    /// A video of which not one frame can be decoded.
    #[error("{}: not one frame can be decoded", path.display())]
    NoFrames {
        /// The file.
        path: PathBuf,
    },
    /// A folder without PNG or JPEG images.
    #[error("{}: has no PNG or JPEG images", path.display())]
    EmptyFolder {
        /// The folder.
        path: PathBuf,
    },
    /// One image of a folder cannot be read.
    #[error("{}: is not a readable image: {message}", path.display())]
    Image {
        /// The image file.
        path: PathBuf,
        /// The decoder's reason.
        message: String,
    },
    /// A frame of another size than the first one.
    #[error("{}: is {}×{} pixels, but the first frame has {}×{}", path.display(), found.0, found.1, expected.0, expected.1)]
    SizeChanged {
        /// The image or video.
        path: PathBuf,
        /// Width and height of the first frame, pixels.
        expected: (u32, u32),
        /// Width and height of this one, pixels.
        found: (u32, u32),
    },
    /// A video whose pictures change their size.
    #[error("{}: frame {index} is {}×{} pixels, but the frames before have {}×{}", path.display(), found.0, found.1, expected.0, expected.1)]
    StreamSizeChanged {
        /// The video.
        path: PathBuf,
        /// The frame, from 0.
        index: u32,
        /// Width and height of the frames before as stored, pixels.
        expected: (u32, u32),
        /// Width and height of this one as stored, pixels.
        found: (u32, u32),
    },
    /// A frame that was asked for is not there.
    #[error("{}: has no frame {index}: it ends after {count}", path.display())]
    FrameMissing {
        /// The video or folder.
        path: PathBuf,
        /// The frame that was asked for, from 0.
        index: u32,
        /// How many frames there are.
        count: u32,
    },
    /// The decoder failed in a way that is not the file's end.
    #[error("{}: cannot decode frame {index}: {message}", path.display())]
    Decode {
        /// The video.
        path: PathBuf,
        /// The frame, from 0.
        index: u32,
        /// The decoder's reason.
        message: String,
    },
    /// A video cannot be written.
    #[error("{}: cannot write the video: {message}", path.display())]
    Encode {
        /// The video.
        path: PathBuf,
        /// The encoder's reason.
        message: String,
    },
}

impl Hint for VideoError {
    fn hint(&self) -> Option<Cow<'_, str>> {
        let text = match self {
            Self::File(e) => return e.hint(),
            Self::Empty { .. } => "the recording or the copy of it failed; get the file again",
            Self::NotAFile { .. } => "give a video file or a folder of PNG or JPEG images",
            Self::NotAVideo { .. } => {
                "`ffprobe FILE` tells what it is; convert it to H.264 in MP4 with `ffmpeg -i FILE out.mp4`"
            }
            Self::NoIndex { .. } => {
                "the recording or the copy was cut off; get the whole file, or repair it with a tool such as `untrunc`"
            }
            Self::NoVideoTrack { .. } => "give a file with pictures; `ffprobe FILE` lists the tracks",
            Self::NoDecoder { .. } => {
                "convert it with an FFmpeg that has the codec: `ffmpeg -i FILE -c:v libx264 -crf 12 out.mp4`"
            }
            Self::StreamSizeChanged { .. } => {
                "cut the video there, or bring it to one size: `ffmpeg -i FILE -vf scale=WIDTH:HEIGHT out.mp4`"
            }
            Self::NoFrames { .. } => "the file is damaged or its codec is not supported; try `ffmpeg -i FILE out.mp4`",
            Self::EmptyFolder { .. } => {
                "give a video file, or a folder with `.png`, `.jpg` or `.jpeg` images in the order of their names"
            }
            Self::Image { .. } => "remove or replace this image",
            Self::SizeChanged { .. } => "all frames must have one size; remove the odd images or scale them",
            Self::FrameMissing { .. } => "the video is not the one that the tables were made for",
            Self::Decode { .. } => "the file is damaged here; try `ffmpeg -i FILE out.mp4`",
            Self::Encode { .. } => "check that the disk has space",
        };
        Some(Cow::Borrowed(text))
    }
}
