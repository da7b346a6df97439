//! What a stream is and what was done to its pictures, for the user to know.

use ffmpeg::frame;
use ffmpeg::{FieldOrder, format};

use crate::coding::{Coding, Matrix, Transfer};
use crate::pixels;

/// One sentence about a stream.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Remark {
    /// A short name for it, such as `hdr-video`.
    pub code: &'static str,
    /// What is the case, and what to do about it; without the file's name.
    pub text: String,
    /// Whether the result may suffer: a warning rather than a note.
    pub is_warning: bool,
}

/// What a stream's first picture and its parameters say.
pub(crate) struct Facts<'a> {
    pub(crate) first: &'a frame::Video,
    pub(crate) field_order: FieldOrder,
    pub(crate) tagged_alpha: bool,
    pub(crate) coding: Coding,
    pub(crate) other_videos: usize,
    /// Width and height as stored and as shown, where pixels are not square.
    pub(crate) widened: Option<(u32, u32)>,
}

pub(crate) fn remarks(facts: &Facts<'_>) -> Vec<Remark> {
    let mut out = Vec::new();
    let mut say = |code, is_warning, text: String| out.push(Remark { code, text, is_warning });
    let curve = match facts.coding.transfer {
        Transfer::Sdr => None,
        Transfer::Hlg => Some("HLG"),
        Transfer::Pq => Some("PQ"),
    };
    if let Some(curve) = curve {
        say(
            "hdr-video",
            false,
            format!("HDR ({curve}): mapped to SDR with diffuse white at 203 nits; brighter highlights are compressed"),
        );
    }
    if let Some((stored, shown)) = facts.widened {
        say("pixel-aspect", false, format!("pixels are not square: {stored} columns are resampled to {shown}"));
    }
    let interlaced = facts.first.is_interlaced()
        || matches!(facts.field_order, FieldOrder::TT | FieldOrder::BB | FieldOrder::TB | FieldOrder::BT);
    if interlaced {
        say(
            "interlaced-video",
            true,
            "is interlaced: every picture holds two moments, and what moves has combs; `ffmpeg -i FILE -vf bwdif -c:v \
             libx264 -crf 12 out.mp4` makes a progressive one"
                .to_owned(),
        );
    }
    if facts.tagged_alpha || pixels::has_alpha(facts.first.format()) {
        say(
            "alpha-video",
            true,
            "has an alpha channel, which is left out: what is transparent shows its hidden colours; `ffmpeg -i FILE -vf \
             premultiply=inplace=1 -pix_fmt yuv420p out.mp4` puts it on black"
                .to_owned(),
        );
    }
    if facts.other_videos > 0 {
        let (width, height) = (facts.first.width(), facts.first.height());
        say(
            "several-videos",
            true,
            format!("has {} video tracks; the one of {width}×{height} pixels is read", facts.other_videos + 1),
        );
    }
    out
}

/// The coding in words, such as `yuv420p10le, BT.2020, limited range`.
pub(crate) fn describe(format: format::Pixel, coding: Coding) -> String {
    let name = format.descriptor().map_or("?", |d| d.name());
    let matrix = match coding.matrix {
        Matrix::Bt601 => "BT.601",
        Matrix::Bt709 => "BT.709",
        Matrix::Bt2020 => "BT.2020",
        Matrix::Smpte240m => "SMPTE 240M",
        Matrix::Fcc => "FCC",
        Matrix::YCgCo => "YCgCo",
    };
    let guess = if coding.guessed { " (by its size)" } else { "" };
    let curve = match coding.transfer {
        Transfer::Sdr => "",
        Transfer::Hlg => ", HLG",
        Transfer::Pq => ", PQ",
    };
    match pixels::family(format) {
        pixels::Family::Yuv { .. } => {
            format!("{name}, {matrix}{guess}, {} range{curve}", if coding.full_range { "full" } else { "limited" })
        }
        _ => name.to_owned(),
    }
}
