//! Frames out, into an MP4 file.

use std::fs::{self, File};
use std::path::{Path, PathBuf};

use ffmpeg::format::context::Output;
use ffmpeg::{Dictionary, Packet, Rational, codec, color, encoder, format, frame};
use image::RgbImage;
use risorius_formats::FormatError;
use risorius_formats::staging::Staging;

use crate::VideoError;
use crate::mp4::{self, Container};
use crate::stream::silence;
use crate::yuv::fill;

/// Writes an MP4 video: H.264 where FFmpeg has an encoder, else MPEG-4 part 2; BT.709, limited range, and tagged so.
///
/// The file appears when [`finish`](Self::finish) returns; dropped before, it leaves nothing behind. Odd sizes are padded
/// to even ones by repeating the last column and row, as these codecs need.
pub struct Writer {
    path: PathBuf,
    // Before the staging file: it closes it.
    output: Output,
    encoder: encoder::Video,
    staging: Staging,
    width: u32,
    height: u32,
    interval: Rational,
    count: u32,
    picture: frame::Video,
}

impl std::fmt::Debug for Writer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Writer").field("path", &self.path).field("count", &self.count).finish_non_exhaustive()
    }
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
        let interval = interval(fps).ok_or_else(|| fail(format!("a frame rate of {fps} is not possible")))?;
        silence();
        let wrap = |e: std::io::Error| FormatError::io(&path, "create", &e);
        let whole = std::path::absolute(&path).map_err(wrap)?;
        if let Some(parent) = whole.parent() {
            fs::create_dir_all(parent).map_err(|e| FormatError::io(parent, "create the folder", &e))?;
        }
        // Here the reason is known, such as a missing permission.
        let (staging, _) = Staging::file(&whole, ".mp4").map_err(wrap)?;
        let size = (width.next_multiple_of(2), height.next_multiple_of(2));
        let (output, encoder) = open(staging.path(), size, interval).map_err(|e| failure(&path, e))?;
        let picture = frame::Video::new(format::Pixel::YUV420P, size.0, size.1);
        Ok(Self { path, output, encoder, staging, width, height, interval, count: 0, picture })
    }

    /// Appends a frame, which must have the size of the video.
    pub fn push(&mut self, image: &RgbImage) -> Result<(), VideoError> {
        let expected = (self.width, self.height);
        if image.dimensions() != expected {
            return Err(VideoError::SizeChanged { path: self.path.clone(), expected, found: image.dimensions() });
        }
        // The encoder keeps pictures that it has not coded yet: each is one of its own.
        let mut picture = frame::Video::new(format::Pixel::YUV420P, self.picture.width(), self.picture.height());
        fill(&mut picture, image);
        picture.set_pts(Some(self.count.into()));
        self.picture = picture;
        self.encoder.send_frame(&self.picture).map_err(|e| failure(&self.path, e))?;
        self.count += 1;
        self.write_packets()
    }

    /// Writes what the encoder has ready.
    fn write_packets(&mut self) -> Result<(), VideoError> {
        let mut packet = Packet::empty();
        while self.encoder.receive_packet(&mut packet).is_ok() {
            packet.set_stream(0);
            packet.set_duration(1);
            let base = self.output.stream(0).map_or(self.interval, |s| s.time_base());
            packet.rescale_ts(self.interval, base);
            packet.write_interleaved(&mut self.output).map_err(|e| failure(&self.path, e))?;
        }
        Ok(())
    }

    /// Completes the video and puts it in its place.
    pub fn finish(mut self) -> Result<(), VideoError> {
        let fail = |message: String| VideoError::Encode { path: self.path.clone(), message };
        if self.count == 0 {
            return Err(fail("it has no frames".to_owned()));
        }
        self.encoder.send_eof().map_err(|e| failure(&self.path, e))?;
        self.write_packets()?;
        self.output.write_trailer().map_err(|e| failure(&self.path, e))?;
        let Self { path, output, staging, count, .. } = self;
        // Closes the file: its last bytes go out.
        drop(output);
        // Closing does not tell of a full disk: count what is there.
        let wrap = |e: std::io::Error| FormatError::io(&path, "write", &e);
        let mut file = File::open(staging.path()).map_err(wrap)?;
        let written = match mp4::read(&mut file, None).map_err(wrap)? {
            Container::Indexed(timeline, ..) => timeline.nanos().len(),
            _ => 0,
        };
        if written != count as usize {
            let message = format!("the encoder wrote {written} of {count} frames");
            return Err(no_room(&staging, &path).unwrap_or_else(|| VideoError::Encode { path: path.clone(), message }));
        }
        file.sync_all().map_err(wrap)?;
        fs::rename(staging.path(), &path).map_err(wrap)?;
        Ok(())
    }
}

/// Seconds from frame to frame, as a fraction.
fn interval(fps: f64) -> Option<Rational> {
    if !(0.001..=100_000.0).contains(&fps) {
        return None;
    }
    let fits = |denominator: &i32| {
        let frames = fps * f64::from(*denominator);
        frames >= 1.0 && (frames.round() / frames - 1.0).abs() < 1e-7
    };
    let denominator = [1, 1001, 1000, 10_000].into_iter().find(fits).unwrap_or(10_000);
    Some(Rational::new(denominator, (fps * f64::from(denominator)).round().max(1.0) as i32))
}

fn open(
    path: &Path,
    (width, height): (u32, u32),
    interval: Rational,
) -> Result<(Output, encoder::Video), ffmpeg::Error> {
    let mut url = std::ffi::OsString::from("file:");
    url.push(path);
    let mut output = format::output_as(&url, "mp4")?;
    let h264 = encoder::find_by_name("libx264").or_else(|| encoder::find(codec::Id::H264));
    let found = h264.or_else(|| encoder::find(codec::Id::MPEG4)).ok_or(ffmpeg::Error::EncoderNotFound)?;
    let mut video = codec::Context::new_with_codec(found).encoder().video()?;
    video.set_width(width);
    video.set_height(height);
    video.set_format(format::Pixel::YUV420P);
    video.set_time_base(interval);
    video.set_frame_rate(Some(interval.invert()));
    video.set_colorspace(color::Space::BT709);
    video.set_color_range(color::Range::MPEG);
    video.set_flags(codec::Flags::GLOBAL_HEADER);
    let mut options = Dictionary::new();
    options.set("color_primaries", "bt709");
    options.set("color_trc", "bt709");
    if found.name() == "libx264" {
        options.set("crf", QUALITY);
        options.set("preset", "fast");
    } else {
        // Of the encoders without a quality setting in common; four bits a pixel leave no visible traces.
        let rate = f64::from(width) * f64::from(height) * f64::from(interval.invert()) * 4.0;
        video.set_bit_rate(rate.min(f64::from(i32::MAX / 2)) as usize);
    }
    let opened = video.open_with(options)?;
    let mut stream = output.add_stream(found)?;
    stream.set_time_base(interval);
    stream.set_avg_frame_rate(interval.invert());
    stream.copy_parameters_from_context(&opened);
    output.write_header()?;
    Ok((output, opened))
}

/// x264's constant rate factor: pictures of faces come back within a level or two on average.
const QUALITY: &str = "12";

/// What FFmpeg says, as the system's error where it is one.
fn failure(path: &Path, error: ffmpeg::Error) -> VideoError {
    match error {
        ffmpeg::Error::Other { errno } => {
            FormatError::io(path, "write", &std::io::Error::from_raw_os_error(errno)).into()
        }
        ffmpeg::Error::EncoderNotFound => {
            let message = "FFmpeg has neither an H.264 nor an MPEG-4 encoder here".to_owned();
            VideoError::Encode { path: path.to_owned(), message }
        }
        other => VideoError::Encode { path: path.to_owned(), message: other.to_string() },
    }
}

/// Whether the disk is full: FFmpeg does not always say why it fails.
fn no_room(staging: &Staging, path: &Path) -> Option<VideoError> {
    use std::io::Write as _;
    let probe = || -> std::io::Result<()> {
        let mut file = File::options().append(true).open(staging.path())?;
        file.write_all(&vec![0; 1 << 18])?;
        file.sync_all()
    };
    probe().err().map(|e| FormatError::io(path, "write", &e).into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_are_the_fractions_that_broadcasters_use() {
        let of = |fps| interval(fps).map(|i| (i.numerator(), i.denominator()));
        assert_eq!(of(120.0), Some((1, 120)));
        assert_eq!(of(30_000.0 / 1001.0), Some((1001, 30_000)));
        assert_eq!(of(12.5), Some((1000, 12_500)));
        assert_eq!([of(0.0), of(f64::NAN), of(-1.0)], [None; 3]);
    }
}
