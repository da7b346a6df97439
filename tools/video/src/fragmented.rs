//! Fragmented MP4 (ISO/IEC 14496-12, `moof`), which can be played up to its last whole fragment however it ends.
//!
//! The index of a plain MP4 is written last: a recording that is cut off has none. Here an empty index comes first, and
//! every fragment of half a second carries its own; each goes out in one piece. Times are in microseconds.

use std::fs::File;
use std::io::{self, Write};
use std::path::Path;

use risorius_formats::FormatError;

use crate::mp4::{self, Container};
use crate::utvideo::UtLayout;
use crate::{Timeline, VideoError};

/// Ticks per second.
const TIME_SCALE: u32 = 1_000_000;
/// A fragment ends after this time …
const FRAGMENT_MICROS: u64 = 500_000;
/// … or with this many bytes, which bounds the memory.
const FRAGMENT_BYTES: usize = 4 << 20;
/// Decoding can begin here.
const KEYFRAME: u32 = 0x0200_0000;
const NO_KEYFRAME: u32 = 0x0101_0000;

/// What the samples are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Codec {
    /// A JPEG picture a frame.
    Mjpeg,
    /// H.264 with lengths, and its `avcC`.
    Avc(Vec<u8>),
    /// Lossless, see [`UtEncoder`](crate::UtEncoder).
    UtVideo(UtLayout),
}

#[derive(Debug)]
struct Sample {
    micros: u64,
    bytes: u32,
    keyframe: bool,
}

/// Writes a fragmented MP4 with one video track.
#[derive(Debug)]
pub struct FragmentWriter<W> {
    out: W,
    /// Bytes up to the end of the last whole fragment.
    whole_bytes: u64,
    fragments: u32,
    waiting: Vec<Sample>,
    data: Vec<u8>,
    last_duration: u32,
}

impl<W: Write> FragmentWriter<W> {
    /// Begins a file of `width`×`height` pixels; `nominal_micros` is the length of the last frame if it is the only one.
    pub fn new(mut out: W, codec: &Codec, width: u32, height: u32, nominal_micros: u32) -> io::Result<Self> {
        let side = |n: u32| {
            u16::try_from(n).map_err(|_| io::Error::new(io::ErrorKind::InvalidInput, "a side is too long for MP4"))
        };
        let head = header(codec, side(width)?, side(height)?);
        out.write_all(&head)?;
        Ok(Self {
            out,
            whole_bytes: head.len() as u64,
            fragments: 0,
            waiting: Vec::new(),
            data: Vec::new(),
            last_duration: nominal_micros,
        })
    }

    /// Appends a frame that is shown at `micros`; gives how many frames went out because of it.
    ///
    /// Times have to ascend. After an error the file is whole up to [`whole_bytes`](Self::whole_bytes).
    pub fn push(&mut self, micros: u64, keyframe: bool, sample: &[u8]) -> io::Result<usize> {
        let mut sent = 0;
        if let Some(first) = self.waiting.first() {
            let full = micros.saturating_sub(first.micros) >= FRAGMENT_MICROS;
            if full || self.data.len() + sample.len() > FRAGMENT_BYTES {
                sent = self.send(Some(micros))?;
            }
        }
        self.waiting.push(Sample { micros, bytes: sample.len() as u32, keyframe });
        self.data.extend_from_slice(sample);
        Ok(sent)
    }

    /// Sends what waits; gives how many frames that were.
    pub fn finish(&mut self) -> io::Result<usize> {
        let sent = self.send(None)?;
        self.out.flush()?;
        Ok(sent)
    }

    /// Bytes up to the end of the last whole fragment.
    pub fn whole_bytes(&self) -> u64 {
        self.whole_bytes
    }

    /// Where the bytes go.
    pub fn get_mut(&mut self) -> &mut W {
        &mut self.out
    }

    fn send(&mut self, next_micros: Option<u64>) -> io::Result<usize> {
        let Some(first) = self.waiting.first() else { return Ok(0) };
        let mut durations: Vec<u32> =
            self.waiting.windows(2).map(|w| w[1].micros.saturating_sub(w[0].micros) as u32).collect();
        let last = self.waiting.last().map_or(0, |s| s.micros);
        let usual = durations.last().copied().unwrap_or(self.last_duration);
        durations.push(next_micros.map_or(usual, |next| next.saturating_sub(last) as u32));
        self.last_duration = durations.last().copied().unwrap_or(usual);
        self.fragments += 1;
        let head = fragment_header(self.fragments, first.micros, &self.waiting, &durations, self.data.len());
        self.out.write_all(&head)?;
        self.out.write_all(&self.data)?;
        self.whole_bytes += (head.len() + self.data.len()) as u64;
        let count = self.waiting.len();
        self.waiting.clear();
        self.data.clear();
        Ok(count)
    }
}

/// What is whole of a fragmented file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fragments {
    /// Bytes up to the end of the last whole fragment.
    pub whole_bytes: u64,
    /// Bytes of the file.
    pub file_bytes: u64,
}

/// Finds the end of the last whole fragment.
pub fn whole_fragments(path: &Path) -> Result<Fragments, VideoError> {
    let read = |e: io::Error| FormatError::io(path, "read", &e);
    let mut file = File::open(path).map_err(|e| FormatError::io(path, "open", &e))?;
    let (whole_bytes, file_bytes) = mp4::whole_fragments(&mut file).map_err(read)?;
    Ok(Fragments { whole_bytes, file_bytes })
}

/// The times of an MP4 file's frames.
pub fn timeline(path: &Path) -> Result<Timeline, VideoError> {
    let mut file = File::open(path).map_err(|e| FormatError::io(path, "open", &e))?;
    match mp4::read(&mut file, None).map_err(|e| FormatError::io(path, "read", &e))? {
        Container::Indexed(timeline, ..) => Ok(timeline),
        Container::NoIndex => Err(VideoError::NoIndex { path: path.to_owned() }),
        Container::NoTrack | Container::Other => Err(VideoError::NotAVideo { path: path.to_owned() }),
    }
}

fn boxed(name: [u8; 4], parts: &[&[u8]]) -> Vec<u8> {
    let size = 8 + parts.iter().map(|p| p.len()).sum::<usize>();
    let mut out = Vec::with_capacity(size);
    out.extend_from_slice(&(size as u32).to_be_bytes());
    out.extend_from_slice(&name);
    for part in parts {
        out.extend_from_slice(part);
    }
    out
}

fn words(values: &[u32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_be_bytes()).collect()
}

const MATRIX: [u32; 9] = [1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30];

fn header(codec: &Codec, width: u16, height: u16) -> Vec<u8> {
    let ftyp = boxed(*b"ftyp", &[b"isom", &words(&[0x200]), b"isomiso5iso6mp41"]);
    let mvhd = boxed(
        *b"mvhd",
        &[
            &words(&[0, 0, 0, TIME_SCALE, 0, 1 << 16]),
            &[1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0],
            &words(&MATRIX),
            &words(&[0, 0, 0, 0, 0, 0, 2]),
        ],
    );
    let tkhd = boxed(
        *b"tkhd",
        &[
            // Enabled, in the movie; track 1.
            &words(&[3, 0, 0, 1, 0, 0, 0, 0, 0, 0]),
            &words(&MATRIX),
            &words(&[u32::from(width) << 16, u32::from(height) << 16]),
        ],
    );
    // 0x55c4: language "und".
    let mdhd = boxed(*b"mdhd", &[&words(&[0, 0, 0, TIME_SCALE, 0, 0x55c4 << 16])]);
    let hdlr = boxed(*b"hdlr", &[&words(&[0, 0]), b"vide", &[0; 12], b"camera\0"]);
    let dref = boxed(*b"dref", &[&words(&[0, 1]), &boxed(*b"url ", &[&words(&[1])])]);
    let stsd = boxed(*b"stsd", &[&words(&[0, 1]), &sample_entry(codec, width, height)]);
    let empty = |name: [u8; 4], n: usize| boxed(name, &[&vec![0; 4 * n]]);
    let stbl =
        boxed(*b"stbl", &[&stsd, &empty(*b"stts", 2), &empty(*b"stsc", 2), &empty(*b"stsz", 3), &empty(*b"stco", 2)]);
    let minf = boxed(*b"minf", &[&boxed(*b"vmhd", &[&words(&[1, 0, 0])]), &boxed(*b"dinf", &[&dref]), &stbl]);
    let mdia = boxed(*b"mdia", &[&mdhd, &hdlr, &minf]);
    let trak = boxed(*b"trak", &[&tkhd, &mdia]);
    let mvex = boxed(*b"mvex", &[&boxed(*b"trex", &[&words(&[0, 1, 1, 0, 0, 0])])]);
    [ftyp, boxed(*b"moov", &[&mvhd, &trak, &mvex])].concat()
}

fn sample_entry(codec: &Codec, width: u16, height: u16) -> Vec<u8> {
    let (name, setup) = match codec {
        // MPEG-4 systems' number for JPEG: object type 0x6c in a stream of kind "visual".
        Codec::Mjpeg => {
            let mut decoder = vec![0x6c, 0x11, 0, 0, 0];
            decoder.extend_from_slice(&[0; 8]);
            let descriptor = |tag: u8, body: &[u8]| [&[tag, body.len() as u8], body].concat();
            let body = [&[0, 1, 0][..], &descriptor(4, &decoder), &descriptor(6, &[2])].concat();
            (*b"mp4v", boxed(*b"esds", &[&words(&[0]), &descriptor(3, &body)]))
        }
        Codec::Avc(config) => (*b"avc1", boxed(*b"avcC", &[config])),
        Codec::UtVideo(layout) => (layout.fourcc(), boxed(*b"glbl", &[&layout.extradata()])),
    };
    boxed(
        name,
        &[
            &[0, 0, 0, 0, 0, 0, 0, 1],
            &[0; 16],
            &width.to_be_bytes(),
            &height.to_be_bytes(),
            // 72 dpi, one frame a sample, no name of the encoder, 24 bits.
            &words(&[72 << 16, 72 << 16, 0]),
            &[0, 1],
            &[0; 32],
            &[0, 24, 0xff, 0xff],
            &setup,
        ],
    )
}

fn fragment_header(number: u32, start: u64, samples: &[Sample], durations: &[u32], data: usize) -> Vec<u8> {
    let mfhd = boxed(*b"mfhd", &[&words(&[0, number])]);
    // Offsets count from the fragment's first byte.
    let tfhd = boxed(*b"tfhd", &[&words(&[0x0002_0000, 1])]);
    let tfdt = boxed(*b"tfdt", &[&words(&[1 << 24]), &start.to_be_bytes()]);
    let rows: Vec<u8> = samples
        .iter()
        .zip(durations)
        .flat_map(|(s, &d)| words(&[d, s.bytes, if s.keyframe { KEYFRAME } else { NO_KEYFRAME }]))
        .collect();
    // With an offset, durations, sizes and flags.
    let trun = |offset: u32| boxed(*b"trun", &[&words(&[0x701, samples.len() as u32, offset]), &rows]);
    let moof = |offset: u32| boxed(*b"moof", &[&mfhd, &boxed(*b"traf", &[&tfhd, &tfdt, &trun(offset)])]);
    let length = moof(0).len() as u32;
    [moof(length + 8), words(&[data as u32 + 8]), b"mdat".to_vec()].concat()
}
