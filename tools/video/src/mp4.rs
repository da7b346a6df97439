//! The timing tables of an MP4 or MOV file (ISO/IEC 14496-12), and nothing else of it.
//!
//! Only the `moov` box and `moof` boxes are read; every length is checked against what is there, so that damaged files
//! give fewer boxes, never a panic or a large allocation.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};

use crate::timeline::{Edit, Sample, Timeline};

/// Larger indexes are taken for garbage: 64 MiB describe a day of video.
const MAX_INDEX_BYTES: u64 = 64 << 20;
/// More frames than this are taken for garbage.
const MAX_SAMPLES: usize = 1 << 24;

/// What the container says.
#[derive(Debug)]
pub(crate) enum Container {
    /// An MP4 or MOV file with a video track; the rate at which it was filmed, where a slow-motion clip tells.
    Indexed(Timeline, Option<f64>),
    /// An MP4 or MOV file without a usable index.
    NoIndex,
    /// An MP4 or MOV file whose index is there, and has no such track.
    NoTrack,
    /// Something else.
    Other,
}

/// Reads the timing tables of a video track: the one of this number, else the first.
pub(crate) fn read(file: &mut File, track: Option<i32>) -> io::Result<Container> {
    let length = file.metadata()?.len();
    let mut position = 0;
    let mut is_mp4 = false;
    let mut moov = None;
    let mut fragments = Vec::new();
    while let Some(header) = read_header(file, position, length)? {
        match &header.name {
            b"ftyp" | b"moov" | b"mdat" | b"free" | b"wide" | b"skip" | b"styp" | b"sidx" | b"pnot" | b"uuid"
            | b"moof" | b"mfra" | b"meta" => {
                is_mp4 |= matches!(&header.name, b"ftyp" | b"moov" | b"mdat");
            }
            // Anything may follow after the known boxes of an MP4 file, but not come first.
            _ if !is_mp4 => return Ok(Container::Other),
            _ => {}
        }
        let whole = header.end <= length && header.end - header.body <= MAX_INDEX_BYTES;
        if whole && &header.name == b"moov" {
            moov = Some(read_body(file, &header)?);
        } else if whole && &header.name == b"moof" {
            fragments.push(read_body(file, &header)?);
        }
        position = header.end;
    }
    if !is_mp4 {
        return Ok(Container::Other);
    }
    let Some(moov) = moov else { return Ok(Container::NoIndex) };
    if let Some((timeline, capture_fps)) = index(&moov, &fragments, track) {
        return Ok(Container::Indexed(timeline, capture_fps));
    }
    // A track that is no video has its kind in its place: the index is sound.
    let of_other_kinds =
        boxes(&moov).any(|(n, b)| &n == b"trak" && !is_video(b) && find(b, &[b"mdia", b"hdlr"]).is_some());
    Ok(if of_other_kinds { Container::NoTrack } else { Container::NoIndex })
}

/// The end of the last `mdat` (or of the index before the first) that is whole, and the file's length.
pub(crate) fn whole_fragments(file: &mut File) -> io::Result<(u64, u64)> {
    let length = file.metadata()?.len();
    let (mut position, mut whole) = (0, 0);
    while let Some(header) = read_header(file, position, length)? {
        if header.end > length {
            break;
        }
        position = header.end;
        if matches!(&header.name, b"moov" | b"mdat") {
            whole = position;
        }
    }
    Ok((whole, length))
}

struct Header {
    name: [u8; 4],
    body: u64,
    end: u64,
}

fn read_header(file: &mut File, position: u64, length: u64) -> io::Result<Option<Header>> {
    if position.saturating_add(8) > length {
        return Ok(None);
    }
    let mut bytes = [0; 16];
    file.seek(SeekFrom::Start(position))?;
    file.read_exact(&mut bytes[..8])?;
    let name = [bytes[4], bytes[5], bytes[6], bytes[7]];
    let (size, head) = match be32(&bytes, 0) {
        Some(0) => (length - position, 8),
        Some(1) if position + 16 <= length => {
            file.read_exact(&mut bytes[8..])?;
            (be64(&bytes, 8).unwrap_or(0), 16)
        }
        Some(size) => (u64::from(size), 8),
        None => (0, 8),
    };
    let end = position.checked_add(size);
    Ok(end.filter(|_| size >= head).map(|end| Header { name, body: position + head, end }))
}

fn read_body(file: &mut File, header: &Header) -> io::Result<Vec<u8>> {
    let mut bytes = vec![0; (header.end - header.body) as usize];
    file.seek(SeekFrom::Start(header.body))?;
    file.read_exact(&mut bytes)?;
    Ok(bytes)
}

fn be32(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_be_bytes(bytes.get(at..at.checked_add(4)?)?.try_into().ok()?))
}

fn be64(bytes: &[u8], at: usize) -> Option<u64> {
    Some(u64::from_be_bytes(bytes.get(at..at.checked_add(8)?)?.try_into().ok()?))
}

/// The boxes inside a box, as (name, body).
fn boxes(mut bytes: &[u8]) -> impl Iterator<Item = ([u8; 4], &[u8])> {
    std::iter::from_fn(move || {
        let size = be32(bytes, 0)? as usize;
        let name: [u8; 4] = bytes.get(4..8)?.try_into().ok()?;
        let body = bytes.get(8..size)?;
        bytes = &bytes[size..];
        Some((name, body))
    })
}

fn find<'a>(bytes: &'a [u8], path: &[&[u8; 4]]) -> Option<&'a [u8]> {
    path.iter().try_fold(bytes, |bytes, name| boxes(bytes).find(|(n, _)| n == *name).map(|(_, body)| body))
}

/// Version of a full box, and where its fields begin.
fn full(body: &[u8]) -> Option<(u8, &[u8])> {
    Some((*body.first()?, body.get(4..)?))
}

fn index(moov: &[u8], fragments: &[Vec<u8>], wanted: Option<i32>) -> Option<(Timeline, Option<f64>)> {
    let is_wanted = |track: &[u8]| wanted.is_none_or(|id| track_id(track) == u32::try_from(id).ok());
    let track = boxes(moov).filter(|(n, _)| n == b"trak").map(|(_, b)| b).find(|t| is_video(t) && is_wanted(t))?;
    let (version, mvhd) = full(find(moov, &[b"mvhd"])?)?;
    let movie_scale = be32(mvhd, if version == 1 { 16 } else { 8 })?;
    let (version, mdhd) = full(find(track, &[b"mdia", b"mdhd"])?)?;
    let time_scale = be32(mdhd, if version == 1 { 16 } else { 8 }).filter(|&s| s > 0)?;
    let mut samples = samples_of_table(find(track, &[b"mdia", b"minf", b"stbl"])?)?;
    let track_id = track_id(track)?;
    let defaults = boxes(find(moov, &[b"mvex"]).unwrap_or_default())
        .filter(|(n, body)| n == b"trex" && be32(body, 4) == Some(track_id))
        .find_map(|(_, body)| be32(body, 12))
        .unwrap_or(0);
    for fragment in fragments {
        append_fragment(&mut samples, fragment, track_id, defaults);
    }
    let edits = find(track, &[b"edts", b"elst"]).and_then(edits).unwrap_or_default();
    let timeline = Timeline::new(&samples, &edits, time_scale, movie_scale);
    Some((timeline, capture_fps(moov)))
}

/// The key under which Android writes how fast a clip was filmed, however slowly it plays.
const CAPTURE_FPS: &[u8] = b"com.android.capture.fps";

/// The rate of filming in the movie's metadata: `keys` names the items of `ilst`, counted from 1.
fn capture_fps(moov: &[u8]) -> Option<f64> {
    let meta = find(moov, &[b"meta"])?;
    // QuickTime's box has no version and flags, that of ISO files has.
    let inner = if find(meta, &[b"keys"]).is_some() { meta } else { meta.get(4..)? };
    let keys = find(inner, &[b"keys"])?;
    let at = boxes(keys.get(8..)?).position(|(_, name)| name == CAPTURE_FPS)?;
    let number = u32::try_from(at + 1).ok()?.to_be_bytes();
    let item = find(inner, &[b"ilst", &number])?;
    // The value follows its type and locale: 23 is a 32-bit float, 21 to 22 and 65 to 67 are integers.
    let data = find(item, &[b"data"])?;
    let fps = match (be32(data, 0)?, data.get(8..)?) {
        (23, bytes) => f64::from(f32::from_be_bytes(bytes.try_into().ok()?)),
        (24, bytes) => f64::from_be_bytes(bytes.try_into().ok()?),
        (21 | 22 | 67 | 77, bytes) => f64::from(be32(bytes, 0)?),
        _ => return None,
    };
    (1.0..=10_000.0).contains(&fps).then_some(fps)
}

fn track_id(track: &[u8]) -> Option<u32> {
    let (version, tkhd) = full(find(track, &[b"tkhd"])?)?;
    be32(tkhd, if version == 1 { 16 } else { 8 })
}

fn is_video(track: &[u8]) -> bool {
    find(track, &[b"mdia", b"hdlr"]).and_then(|h| h.get(8..12)) == Some(b"vide")
}

/// `stts` (durations) and `ctts` (presentation minus decoding time), as far as `stsz` has samples.
fn samples_of_table(table: &[u8]) -> Option<Vec<Sample>> {
    let count = find(table, &[b"stsz"])
        .and_then(|b| be32(b, 8))
        .or_else(|| find(table, &[b"stz2"]).and_then(|b| be32(b, 8)))?;
    let count = (count as usize).min(MAX_SAMPLES);
    let mut samples = Vec::new();
    let mut time = 0i64;
    'runs: for (n, duration) in pairs(find(table, &[b"stts"])?) {
        for _ in 0..n {
            if samples.len() == count {
                break 'runs;
            }
            samples.push(Sample { presented: time, duration: duration.into() });
            time += i64::from(duration);
        }
    }
    let offsets = find(table, &[b"ctts"])
        .map(|b| pairs(b).flat_map(|(n, offset)| std::iter::repeat_n(offset as i32, n as usize)));
    for (sample, offset) in samples.iter_mut().zip(offsets.into_iter().flatten()) {
        sample.presented += i64::from(offset);
    }
    Some(samples)
}

/// The rows of `stts` or `ctts`.
fn pairs(body: &[u8]) -> impl Iterator<Item = (u32, u32)> {
    let count = be32(body, 4).unwrap_or(0) as usize;
    (0..count).map_while(move |i| Some((be32(body, 8 + 8 * i)?, be32(body, 12 + 8 * i)?)))
}

fn edits(body: &[u8]) -> Option<Vec<Edit>> {
    let (version, fields) = full(body)?;
    let count = be32(fields, 0)? as usize;
    let edit = |i: usize| {
        if version == 1 {
            Some(Edit { duration: be64(fields, 4 + 20 * i)?, media_time: be64(fields, 12 + 20 * i)? as i64 })
        } else {
            Some(Edit {
                duration: be32(fields, 4 + 12 * i)?.into(),
                media_time: (be32(fields, 8 + 12 * i)? as i32).into(),
            })
        }
    };
    Some((0..count).map_while(edit).collect())
}

/// The samples of one `moof`: `tfhd`, `tfdt` and `trun` of our track.
fn append_fragment(samples: &mut Vec<Sample>, fragment: &[u8], track_id: u32, default_duration: u32) {
    for (_, traf) in boxes(fragment).filter(|(n, _)| n == b"traf") {
        let Some(tfhd) = find(traf, &[b"tfhd"]) else { continue };
        if be32(tfhd, 4) != Some(track_id) {
            continue;
        }
        let flags = be32(tfhd, 0).unwrap_or(0);
        let skip = if flags & 1 != 0 { 8 } else { 0 } + if flags & 2 != 0 { 4 } else { 0 };
        let default_duration =
            if flags & 8 != 0 { be32(tfhd, 8 + skip).unwrap_or(default_duration) } else { default_duration };
        let start = find(traf, &[b"tfdt"]).and_then(full).and_then(|(version, f)| {
            if version == 1 { be64(f, 0).map(|t| t as i64) } else { be32(f, 0).map(i64::from) }
        });
        // Without `tfdt` a fragment continues where the one before ended.
        let mut time = start.unwrap_or_else(|| samples.last().map_or(0, |s| s.presented.saturating_add(s.duration)));
        for (_, trun) in boxes(traf).filter(|(n, _)| n == b"trun") {
            append_run(samples, trun, &mut time, default_duration);
        }
    }
}

fn append_run(samples: &mut Vec<Sample>, trun: &[u8], time: &mut i64, default_duration: u32) -> Option<()> {
    let flags = be32(trun, 0)?;
    let count = be32(trun, 4)?;
    let has = |bit: u32| flags & bit != 0;
    let mut at = 8 + if has(0x1) { 4 } else { 0 } + if has(0x4) { 4 } else { 0 };
    for _ in 0..count {
        let mut field = |present: bool| -> Option<Option<u32>> {
            if !present {
                return Some(None);
            }
            let value = be32(trun, at)?;
            at += 4;
            Some(Some(value))
        };
        let duration = field(has(0x100))?.unwrap_or(default_duration);
        let _size = field(has(0x200))?;
        let _flags = field(has(0x400))?;
        let offset = field(has(0x800))?.unwrap_or(0) as i32;
        if samples.len() >= MAX_SAMPLES {
            return None;
        }
        samples.push(Sample { presented: time.checked_add(offset.into())?, duration: duration.into() });
        *time = time.checked_add(duration.into())?;
    }
    Some(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    fn read_bytes(file: &mut File, bytes: &[u8]) -> Container {
        file.set_len(0).unwrap();
        file.seek(SeekFrom::Start(0)).unwrap();
        file.write_all(bytes).unwrap();
        read(file, None).unwrap()
    }

    /// A file of a header and an index alone: 5 frames, reordered, trimmed by an edit.
    fn small_file() -> Vec<u8> {
        fn boxed(name: [u8; 4], words: &[u32], inner: &[Vec<u8>]) -> Vec<u8> {
            let body: Vec<u8> = words.iter().flat_map(|w| w.to_be_bytes()).chain(inner.concat()).collect();
            [&(body.len() as u32 + 8).to_be_bytes()[..], &name, &body].concat()
        }
        let text = |t: &[u8; 4]| u32::from_be_bytes(*t);
        let one: u32 = 1 << 16;
        let stbl = boxed(
            *b"stbl",
            &[],
            &[
                boxed(*b"stts", &[0, 1, 5, 10], &[]),
                boxed(*b"ctts", &[0, 3, 1, 10, 2, 20, 2, 0], &[]),
                boxed(*b"stsz", &[0, 9, 5], &[]),
            ],
        );
        let mdia = boxed(
            *b"mdia",
            &[],
            &[
                boxed(*b"mdhd", &[0, 0, 0, 1000, 50, 0], &[]),
                boxed(*b"hdlr", &[0, 0, text(b"vide"), 0, 0, 0], &[]),
                boxed(*b"minf", &[], &[stbl]),
            ],
        );
        let mut tkhd = vec![0, 0, 0, 7, 0, 50, 0, 0, 0, 0];
        tkhd.extend([0, one, 0, one.wrapping_neg(), 0, 0, 0, 0, 1 << 30]);
        let edts = boxed(*b"edts", &[], &[boxed(*b"elst", &[0, 1, 100, 20, one], &[])]);
        let trak = boxed(*b"trak", &[], &[boxed(*b"tkhd", &tkhd, &[]), edts, mdia]);
        let named = |name: &[u8]| [&(name.len() as u32 + 8).to_be_bytes()[..], b"mdta", name].concat();
        let keys = boxed(*b"keys", &[0, 2], &[named(b"com.android.version"), named(CAPTURE_FPS)]);
        let data = boxed(*b"data", &[23, 0, 240f32.to_bits()], &[]);
        let ilst = boxed(*b"ilst", &[], &[boxed([0, 0, 0, 2], &[], &[data])]);
        let meta = boxed(*b"meta", &[0], &[keys, ilst]);
        let moov = boxed(*b"moov", &[], &[boxed(*b"mvhd", &[0, 0, 0, 600, 50], &[]), trak, meta]);
        [boxed(*b"ftyp", &[text(b"isom"), 0], &[]), moov].concat()
    }

    #[test]
    fn an_index_is_read_by_its_letter() {
        let Container::Indexed(timeline, capture_fps) = read_bytes(&mut tempfile::tempfile().unwrap(), &small_file())
        else {
            panic!("not read");
        };
        // Decoded at 0, 10, … and shown at 10, 30, 40, 30, 40; shown from 20 on.
        assert_eq!(timeline.nanos(), [0, 0, 10_000_000, 10_000_000]);
        assert_eq!(capture_fps, Some(240.0));
    }

    #[test]
    fn damage_never_panics() {
        let whole = small_file();
        let mut file = tempfile::tempfile().unwrap();
        for length in 0..whole.len() {
            read_bytes(&mut file, &whole[..length]);
        }
        for at in 0..whole.len() {
            for value in [0, 1, 0x7f, 0x80, 0xff] {
                let mut bytes = whole.clone();
                bytes[at] = value;
                read_bytes(&mut file, &bytes);
            }
        }
    }
}
