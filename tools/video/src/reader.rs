//! Frames in, from a video file or an image folder.

use std::path::Path;

use image::RgbImage;
use risorius_formats::{FormatError, Take};

use crate::images::ImageFolder;
use crate::orientation::Orientation;
use crate::remarks::Remark;
use crate::video::VideoFile;
use crate::{DEFAULT_IMAGE_FPS, VideoError};

/// What is known of a video before its frames are read.
#[derive(Clone, Debug, PartialEq)]
pub struct VideoInfo {
    /// Upright width, pixels.
    pub width: u32,
    /// Upright height, pixels.
    pub height: u32,
    /// Clockwise rotation that is applied, the container's and [`Reader::turn`]'s: 0, 90, 180 or 270 degrees.
    pub rotation_degrees: u32,
    /// Frames per second: what the container states if the times agree, else their mean; 30 for image folders.
    pub fps: f64,
    /// Frames per second at the shortest usual interval: dim light lowers a camera's mean rate, and not this.
    pub peak_fps: f64,
    /// Where the frames' times come from.
    pub times: TimeSource,
    /// Frames per second at which a slow-motion clip was filmed, where its metadata tell (Android's do).
    pub capture_fps: Option<f64>,
    /// Number of frames: exact for MP4, MOV and image folders, an estimate otherwise.
    pub frame_count_estimate: Option<u64>,
    /// How the pictures are coded, such as `yuv420p, BT.709, limited range`; empty for image folders.
    pub coding: String,
    /// What the stream is and what was done to its pictures, for the user to know.
    pub remarks: Vec<Remark>,
}

/// Where the times of frames come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TimeSource {
    /// The container has a time for every frame.
    Container,
    /// From the rate that was asked for: an image folder, or a stream without times.
    Asked,
    /// From the rate in the header of a stream without times, such as raw H.264.
    StreamRate,
    /// Nothing tells: counted at a rate that is nobody's.
    Unknown,
}

/// One frame, upright.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Number of the frame, from 0, in the order of presentation.
    pub index: u32,
    /// Presentation time since the first frame.
    pub timestamp_nanos: i64,
    /// The picture.
    pub image: RgbImage,
}

/// A video of which not all frames could be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Truncation {
    /// Frames that could be read.
    pub read: u32,
    /// Frames that the container announces.
    pub expected: u64,
    /// Of those that could not be read, the first ones: the file begins between two keyframes.
    pub lost_at_start: u32,
}

/// Reads the frames of a video file or an image folder, one after the other, in constant memory.
#[derive(Debug)]
pub struct Reader {
    source: Source,
    info: VideoInfo,
    next: u32,
}

#[derive(Debug)]
enum Source {
    Video(Box<VideoFile>),
    Images(ImageFolder, Orientation),
}

impl Reader {
    /// Opens a video file or a folder of PNG or JPEG images.
    pub fn open(path: impl AsRef<Path>) -> Result<Self, VideoError> {
        Self::open_with_fps(path, None)
    }

    /// The same, with the frame rate of an image folder; a video file keeps its own times.
    pub fn open_with_fps(path: impl AsRef<Path>, image_fps: Option<f64>) -> Result<Self, VideoError> {
        let path = path.as_ref();
        let kind = std::fs::metadata(path).map_err(|e| FormatError::io(path, "open", &e))?;
        if kind.is_dir() {
            let images = ImageFolder::open(path)?;
            let (width, height) = images.size();
            let frame_count_estimate = Some(images.len() as u64);
            let fps = image_fps.filter(|f| f.is_finite() && *f > 0.0).unwrap_or(DEFAULT_IMAGE_FPS);
            let info = VideoInfo {
                width,
                height,
                rotation_degrees: 0,
                fps,
                peak_fps: fps,
                times: TimeSource::Asked,
                capture_fps: None,
                frame_count_estimate,
                coding: String::new(),
                remarks: Vec::new(),
            };
            return Ok(Self { source: Source::Images(images, Orientation::default()), info, next: 0 });
        }
        if !kind.is_file() {
            return Err(VideoError::NotAFile { path: path.to_owned() });
        }
        let video = VideoFile::open(path, image_fps)?;
        let (width, height) = video.size();
        let info = VideoInfo {
            width,
            height,
            rotation_degrees: video.rotation_degrees(),
            fps: video.fps(),
            peak_fps: video.peak_fps(),
            times: video.times(),
            capture_fps: video.capture_fps(),
            frame_count_estimate: video.frame_count_estimate(),
            coding: video.coding().to_owned(),
            remarks: video.remarks().to_vec(),
        };
        Ok(Self { source: Source::Video(Box::new(video)), info, next: 0 })
    }

    /// Opens a take's media, turned as the take is.
    pub fn open_take(take: &Take) -> Result<Self, VideoError> {
        let mut reader = Self::open(take.media_path())?;
        // The take's rotation is the container's and what `capture record --rotate` added.
        reader.turn((360 + take.manifest.rotation_degrees % 360 - reader.info.rotation_degrees) % 360);
        Ok(reader)
    }

    /// Turns all pictures by 0, 90, 180 or 270 degrees clockwise, beyond what the container asks for; call it before the
    /// first frame is read.
    pub fn turn(&mut self, degrees: u32) {
        let more = Orientation::default().turned(degrees);
        match &mut self.source {
            Source::Video(video) => video.turn(degrees),
            Source::Images(_, turn) => *turn = turn.turned(degrees),
        }
        (self.info.width, self.info.height) = more.size((self.info.width, self.info.height));
        self.info.rotation_degrees = (self.info.rotation_degrees + degrees) % 360;
    }

    /// What is known of the video.
    pub fn info(&self) -> &VideoInfo {
        &self.info
    }

    /// Whether this is an image folder.
    pub fn is_image_folder(&self) -> bool {
        matches!(self.source, Source::Images(..))
    }

    /// The image files, in the order they are read; empty for a video file.
    pub fn image_files(&self) -> &[std::path::PathBuf] {
        match &self.source {
            Source::Images(images, _) => images.files(),
            Source::Video(_) => &[],
        }
    }

    /// The next frame, upright; `None` after the last one.
    pub fn next_frame(&mut self) -> Result<Option<Frame>, VideoError> {
        let (timestamp_nanos, image) = match &mut self.source {
            Source::Video(video) => match video.grab()? {
                Some(nanos) => (nanos, video.retrieve()?),
                None => return Ok(None),
            },
            Source::Images(images, turn) => match images.next_image()? {
                Some(image) => ((f64::from(self.next) * 1e9 / self.info.fps).round() as i64, turn.apply(image)),
                None => return Ok(None),
            },
        };
        let index = self.next;
        self.next += 1;
        Ok(Some(Frame { index, timestamp_nanos, image }))
    }

    /// Passes over a frame without converting its pixels; false after the last one.
    pub fn skip_frame(&mut self) -> Result<bool, VideoError> {
        let there = match &mut self.source {
            Source::Video(video) => video.grab()?.is_some(),
            Source::Images(images, _) => images.skip(),
        };
        self.next += u32::from(there);
        Ok(there)
    }

    /// Once the end was reached: which frames could not be read.
    pub fn truncation(&self) -> Option<Truncation> {
        match &self.source {
            Source::Video(video) => video.truncation(),
            Source::Images(..) => None,
        }
    }
}

/// Calls `each(index, image)` for the wanted frames, in ascending order, once for each.
///
/// The frames between are decoded, as they have to be, but not converted; nothing after the last wanted frame is read.
pub fn read_frames<E: From<VideoError>>(
    path: impl AsRef<Path>,
    indices: &[u32],
    each: impl FnMut(u32, RgbImage) -> Result<(), E>,
) -> Result<(), E> {
    let path = path.as_ref();
    wanted_frames(path, || Reader::open(path), indices, each)
}

/// As [`read_frames`], of a take's media, turned as the take is.
pub fn read_take_frames<E: From<VideoError>>(
    take: &Take,
    indices: &[u32],
    each: impl FnMut(u32, RgbImage) -> Result<(), E>,
) -> Result<(), E> {
    wanted_frames(&take.media_path(), || Reader::open_take(take), indices, each)
}

fn wanted_frames<E: From<VideoError>>(
    path: &Path,
    open: impl FnOnce() -> Result<Reader, VideoError>,
    indices: &[u32],
    mut each: impl FnMut(u32, RgbImage) -> Result<(), E>,
) -> Result<(), E> {
    let mut wanted = indices.to_vec();
    wanted.sort_unstable();
    wanted.dedup();
    if wanted.is_empty() {
        return Ok(());
    }
    let mut reader = open()?;
    let missing = |index, count| VideoError::FrameMissing { path: path.to_owned(), index, count };
    for index in wanted {
        while reader.next < index {
            if !reader.skip_frame()? {
                return Err(missing(index, reader.next).into());
            }
        }
        let frame = reader.next_frame()?.ok_or_else(|| missing(index, reader.next))?;
        each(index, frame.image)?;
    }
    Ok(())
}
