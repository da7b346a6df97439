//! Frames out, into an MP4 file.

use std::fs::{self, File};
use std::path::{Path, PathBuf};

use image::RgbImage;
use opencv::core::{self, Mat, Scalar, Size, Vec3b};
use opencv::imgproc;
use opencv::prelude::{VideoWriterTrait, VideoWriterTraitConst};
use opencv::videoio::{self, VideoWriter};
use risorius_formats::FormatError;
use risorius_formats::staging::Staging;

use crate::VideoError;
use crate::mp4::{self, Container};
use crate::video::silence;

/// Writes an MP4 video: H.264 where OpenCV's FFmpeg has an encoder, else MPEG-4 part 2.
///
/// The file appears when [`finish`](Self::finish) returns; dropped before, it leaves nothing behind. Odd sizes are padded
/// to even ones by repeating the last column and row, as these codecs need.
#[derive(Debug)]
pub struct Writer {
    path: PathBuf,
    // Before the staging file: it closes it.
    encoder: VideoWriter,
    staging: Staging,
    width: u32,
    height: u32,
    count: u32,
    bgr: Mat,
    padded: Mat,
}

impl Writer {
    /// Begins a video of `width`×`height` pixels at `fps` frames per second.
    pub fn create(path: impl AsRef<Path>, width: u32, height: u32, fps: f64) -> Result<Self, VideoError> {
        let path = path.as_ref().to_owned();
        let fail = |message: String| VideoError::Encode { path: path.clone(), message };
        if !path.extension().is_some_and(|e| e.eq_ignore_ascii_case("mp4")) {
            return Err(fail("the name has to end in `.mp4`".to_owned()));
        }
        if width == 0 || height == 0 || width > 16384 || height > 16384 {
            return Err(fail(format!("a size of {width}×{height} pixels is not possible")));
        }
        if !(fps.is_finite() && fps > 0.0) {
            return Err(fail(format!("a frame rate of {fps} is not possible")));
        }
        silence();
        let wrap = |e: std::io::Error| FormatError::io(&path, "create", &e);
        let whole = std::path::absolute(&path).map_err(wrap)?;
        if let Some(parent) = whole.parent() {
            fs::create_dir_all(parent).map_err(|e| FormatError::io(parent, "create the folder", &e))?;
        }
        // Here the reason is known, such as a missing permission; OpenCV only says no. It takes the container's kind
        // from the name.
        let (staging, _) = Staging::file(&whole, ".mp4").map_err(wrap)?;
        match open(staging.path(), width.next_multiple_of(2), height.next_multiple_of(2), fps) {
            Ok(encoder) => Ok(Self {
                path,
                staging,
                encoder,
                width,
                height,
                count: 0,
                bgr: Mat::default(),
                padded: Mat::default(),
            }),
            Err(message) => Err(no_room(&staging, &path).unwrap_or_else(|| fail(message))),
        }
    }

    /// Appends a frame, which must have the size of the video.
    pub fn push(&mut self, image: &RgbImage) -> Result<(), VideoError> {
        let expected = (self.width, self.height);
        if image.dimensions() != expected {
            return Err(VideoError::SizeChanged { path: self.path.clone(), expected, found: image.dimensions() });
        }
        self.encode(image).map_err(|e| VideoError::Encode { path: self.path.clone(), message: e.message })?;
        self.count += 1;
        Ok(())
    }

    fn encode(&mut self, image: &RgbImage) -> opencv::Result<()> {
        let rgb = Mat::new_rows_cols_with_bytes::<Vec3b>(self.height as i32, self.width as i32, image.as_raw())?;
        imgproc::cvt_color_def(&rgb, &mut self.bgr, imgproc::COLOR_RGB2BGR)?;
        let (right, bottom) = ((self.width % 2) as i32, (self.height % 2) as i32);
        if right + bottom == 0 {
            return self.encoder.write(&self.bgr);
        }
        core::copy_make_border(
            &self.bgr,
            &mut self.padded,
            0,
            bottom,
            0,
            right,
            core::BORDER_REPLICATE,
            Scalar::default(),
        )?;
        self.encoder.write(&self.padded)
    }

    /// Completes the video and puts it in its place.
    pub fn finish(mut self) -> Result<(), VideoError> {
        let fail = |message: String| VideoError::Encode { path: self.path.clone(), message };
        if self.count == 0 {
            return Err(fail("it has no frames".to_owned()));
        }
        self.encoder.release().map_err(|e| fail(e.message))?;
        // OpenCV does not tell of a full disk: count what is there.
        let wrap = |e: std::io::Error| FormatError::io(&self.path, "write", &e);
        let mut file = File::open(self.staging.path()).map_err(wrap)?;
        let written = match mp4::read(&mut file).map_err(wrap)? {
            Container::Indexed(timeline, ..) => timeline.nanos().len(),
            Container::NoIndex | Container::Other => 0,
        };
        if written != self.count as usize {
            let message = format!("the encoder wrote {written} of {} frames", self.count);
            return Err(no_room(&self.staging, &self.path).unwrap_or_else(|| fail(message)));
        }
        file.sync_all().map_err(wrap)?;
        fs::rename(self.staging.path(), &self.path).map_err(wrap)?;
        Ok(())
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        // Closed before its file goes, with what is dropped next; after `finish` there is nothing to do.
        let _ = self.encoder.release();
    }
}

/// OpenCV does not say why it fails: whether the disk is full.
fn no_room(staging: &Staging, path: &Path) -> Option<VideoError> {
    use std::io::Write as _;
    let probe = || -> std::io::Result<()> {
        let mut file = File::options().append(true).open(staging.path())?;
        file.write_all(&vec![0; 1 << 18])?;
        file.sync_all()
    };
    probe().err().map(|e| FormatError::io(path, "write", &e).into())
}

fn open(path: &Path, width: u32, height: u32, fps: f64) -> Result<VideoWriter, String> {
    let size = Size::new(width as i32, height as i32);
    for codec in [*b"avc1", *b"mp4v"] {
        let fourcc = i32::from_le_bytes(codec);
        let writer = VideoWriter::new_with_backend(path, videoio::CAP_FFMPEG, fourcc, fps, size, true);
        if let Ok(writer) = writer
            && writer.is_opened().unwrap_or(false)
        {
            return Ok(writer);
        }
    }
    Err("OpenCV has neither an H.264 nor an MPEG-4 encoder here".to_owned())
}
