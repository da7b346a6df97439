//! Opening a file with FFmpeg and finding the stream that is the video.

use std::path::Path;
use std::sync::Once;

use ffmpeg::codec::{self, threading};
use ffmpeg::format::context::Input;
use ffmpeg::format::stream::Disposition;
use ffmpeg::{Dictionary, Stream, decoder, format, media};
use risorius_formats::FormatError;

use crate::VideoError;
use crate::orientation::Orientation;

/// Opens a local file, and nothing that it may refer to over a network.
pub(crate) fn open_input(path: &Path) -> Result<Input, VideoError> {
    silence();
    let absolute = std::path::absolute(path).map_err(|e| FormatError::io(path, "open", &e))?;
    // With the protocol in front, a name such as `a:b.mp4` is a name.
    let mut url = std::ffi::OsString::from("file:");
    url.push(absolute);
    let mut options = Dictionary::new();
    options.set("protocol_whitelist", "file");
    format::input_with_dictionary(&url, options).map_err(|_| VideoError::NotAVideo { path: path.to_owned() })
}

/// Streams without a container: FFmpeg counts their frames at a rate of its own.
const BARE: [&str; 14] = [
    "h264",
    "hevc",
    "vvc",
    "mjpeg",
    "mpegvideo",
    "m4v",
    "h263",
    "h261",
    "cavsvideo",
    "vc1",
    "dirac",
    "obu",
    "rawvideo",
    "image2",
];
/// That rate, which FFmpeg from 6.1 on also states as the decoder's where the stream says nothing.
pub(crate) const NOBODYS_FPS: f64 = 25.0;

/// Whether the container has a time for every frame.
pub(crate) fn has_times(input: &Input) -> bool {
    let name = input.format().name();
    let bare = name.ends_with("_pipe") || BARE.contains(&name);
    !bare && !input.format().flags().contains(format::Flags::NO_TIMESTAMPS)
}

/// Keeps FFmpeg from writing to stderr: what went wrong comes back as an error.
pub(crate) fn silence() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| ffmpeg::log::set_level(ffmpeg::log::Level::Quiet));
}

/// The stream that is the video, and how many others are videos too.
pub(crate) struct Choice {
    pub(crate) index: usize,
    pub(crate) others: usize,
}

/// Of the streams with pictures, covers left out, the default one; of equals the larger, of these the first.
pub(crate) fn choose(input: &Input, path: &Path) -> Result<Choice, VideoError> {
    let is = |stream: &Stream<'_>, kind| stream.parameters().medium() == kind;
    let videos: Vec<Stream<'_>> = input
        .streams()
        .filter(|s| is(s, media::Type::Video) && !s.disposition().contains(Disposition::ATTACHED_PIC))
        .collect();
    // A cover may also be a track of one picture.
    let moving: Vec<&Stream<'_>> = videos.iter().filter(|s| s.frames() != 1).collect();
    let candidates: Vec<&Stream<'_>> = if moving.is_empty() { videos.iter().collect() } else { moving };
    let rank = |s: &Stream<'_>| {
        let area = u64::from(s.parameters().width()) * u64::from(s.parameters().height());
        (s.disposition().contains(Disposition::DEFAULT), area, std::cmp::Reverse(s.index()))
    };
    if let Some(best) = candidates.iter().max_by_key(|s| rank(s)) {
        return Ok(Choice { index: best.index(), others: candidates.len() - 1 });
    }
    let sound = input.streams().any(|s| is(&s, media::Type::Audio));
    Err(VideoError::NoVideoTrack { path: path.to_owned(), sound })
}

/// A decoder for a stream, with as many threads as there are processors.
pub(crate) fn open_decoder(stream: &Stream<'_>, path: &Path) -> Result<decoder::Video, VideoError> {
    let fail = |e: ffmpeg::Error| VideoError::NoDecoder {
        path: path.to_owned(),
        codec: stream.parameters().id().name().to_owned(),
        message: e.to_string(),
    };
    let mut context = codec::Context::from_parameters(stream.parameters()).map_err(fail)?;
    context.set_threading(threading::Config { kind: threading::Type::Frame, count: 0, ..threading::Config::default() });
    context.decoder().video().map_err(fail)
}

/// The turn that the container asks for.
pub(crate) fn orientation(stream: &Stream<'_>) -> Option<Orientation> {
    let matrix = stream.side_data().find(|d| d.kind() == codec::packet::side_data::Type::DisplayMatrix)?;
    Orientation::from_side_data(matrix.data())
}

/// How much wider than high the stream says that its pixels are.
pub(crate) fn pixel_aspect(stream: &Stream<'_>, of_frame: ffmpeg::Rational) -> f64 {
    let ratios = [stream.sample_aspect_ratio(), stream.parameters().sample_aspect_ratio(), of_frame];
    let ratio = ratios.into_iter().find(|r| r.numerator() > 0 && r.denominator() > 0);
    let ratio = ratio.map_or(1.0, |r| f64::from(r.numerator()) / f64::from(r.denominator()));
    // Beyond this it is no camera's.
    if (0.2..=5.0).contains(&ratio) { ratio } else { 1.0 }
}
