//! Grabbing, packing and writing on threads of their own.
//!
//! ```text
//! driver's buffers → grab → queue → pack → queue → write → fragments on the disk
//!                      └ lets frames go, counted, when the queues are full
//! ```
//!
//! The grabbing thread copies a frame and gives the driver its buffer back; it waits for nobody. Everything that waits in
//! the two queues is charged to one budget; a frame that does not fit is let go and counted.

use std::io::{self, Write};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use risorius_video::avc::access_unit;
use risorius_video::fragmented::{Codec, FragmentWriter};
use risorius_video::{RawLayout, UtEncoder};

use super::journal::JournalRow;
use super::queue::{Budget, Closing, Pool, Queue};
use crate::clock::{FrameClock, SequenceCounter};
use crate::source::{FrameSource, Grab, Grabbed, PixelFormat, Started};
use crate::{CaptureError, Result};

/// How long a grab waits before it looks whether to stop.
const PATIENCE: Duration = Duration::from_millis(100);
/// A camera that gives nothing for so long has failed.
pub(super) const SILENCE: Duration = Duration::from_secs(5);
/// What a waiting frame costs beside its bytes.
const OVERHEAD: usize = 256;
/// How often the calling thread looks.
const TICK: Duration = Duration::from_millis(50);

/// How a recording came to its end.
#[derive(Debug)]
pub enum Ended {
    /// After the time that was asked for.
    Complete,
    /// The user stopped it.
    Stopped,
    /// The camera failed.
    Camera(CaptureError),
    /// The disk did.
    Disk(io::Error),
}

/// What is to be recorded.
#[derive(Clone, Copy, Debug)]
pub struct Plan {
    /// Stop after this time.
    pub duration: Option<Duration>,
    /// Bytes that may wait for the disk.
    pub memory_bytes: usize,
}

/// Frames counted while a recording runs.
#[derive(Debug, Default)]
struct Counters {
    grabbed: AtomicU64,
    lost: AtomicU64,
    discarded: AtomicU64,
    corrupt: AtomicU64,
    written: AtomicU64,
    bytes: AtomicU64,
    time_nanos: AtomicI64,
}

/// The counts at a moment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Totals {
    /// Frames that came from the driver, whole or not.
    pub grabbed: u64,
    /// Frames that the driver lost, by its sequence numbers.
    pub lost: u64,
    /// Frames that were let go because the disk was too slow or full.
    pub discarded: u64,
    /// Broken frames.
    pub corrupt: u64,
    /// Frames in the video.
    pub written: u64,
    /// Bytes in the video.
    pub bytes: u64,
    /// Time of the newest frame since the first.
    pub time_nanos: i64,
    /// Bytes that wait.
    pub waiting_bytes: usize,
    /// The most bytes that ever waited.
    pub waiting_peak_bytes: usize,
}

/// What the calling thread sees while the others work.
pub struct View<'a> {
    shared: &'a Shared,
}

struct Shared {
    counters: Counters,
    budget: Budget,
    pool: Pool,
    stop: AtomicBool,
    wants_sample: AtomicBool,
    sample: Mutex<Option<Vec<u8>>>,
}

impl View<'_> {
    /// The counts now.
    pub fn totals(&self) -> Totals {
        self.shared.totals()
    }

    /// Asks for a copy of a coming frame.
    pub fn want_sample(&self) {
        self.shared.wants_sample.store(true, Ordering::Relaxed);
    }

    /// The copy, once it is there.
    pub fn sample(&self) -> Option<Vec<u8>> {
        self.shared.sample.lock().ok()?.take()
    }
}

impl Shared {
    fn totals(&self) -> Totals {
        let c = &self.counters;
        let get = |n: &AtomicU64| n.load(Ordering::Relaxed);
        Totals {
            grabbed: get(&c.grabbed),
            lost: get(&c.lost),
            discarded: get(&c.discarded),
            corrupt: get(&c.corrupt),
            written: get(&c.written),
            bytes: get(&c.bytes),
            time_nanos: c.time_nanos.load(Ordering::Relaxed),
            waiting_bytes: self.budget.used(),
            waiting_peak_bytes: self.budget.peak(),
        }
    }
}

/// Frames that are missing before the next one.
#[derive(Clone, Copy, Debug, Default)]
struct Missing {
    lost: u32,
    discarded: u32,
    corrupt: u32,
}

impl Missing {
    fn add(&mut self, other: Self) {
        self.lost += other.lost;
        self.discarded += other.discarded;
        self.corrupt += other.corrupt;
    }
}

/// A frame on its way.
struct Packet {
    data: Vec<u8>,
    charged: usize,
    bytes: u32,
    sequence: Option<u32>,
    driver_nanos: Option<i64>,
    arrival_nanos: i64,
    time_nanos: i64,
    missing: Missing,
    keyframe: bool,
    /// With the first one.
    codec: Option<Codec>,
}

/// What a recording left.
#[derive(Debug)]
pub struct Outcome {
    /// How it came to its end.
    pub ended: Ended,
    /// The counts.
    pub totals: Totals,
    /// How often the driver's clock was wrong.
    pub clock_corrections: u64,
    /// Bytes of the video up to its last whole fragment.
    pub whole_bytes: u64,
}

/// Records from a started source into `sink` until the end of the plan, of the camera, of the disk, or until `watch`,
/// which is called all the while, says no.
///
/// `keep` gets a row for each frame that has gone out, fragment by fragment.
pub fn run<W: Write + Send>(
    source: &mut dyn FrameSource,
    started: &Started,
    plan: &Plan,
    sink: W,
    keep: &mut (dyn FnMut(JournalRow, bool) -> io::Result<()> + Send),
    watch: &mut dyn FnMut(&View<'_>) -> bool,
) -> Result<Outcome> {
    let encoder = match started.format.raw() {
        Some(raw) => {
            Some(UtEncoder::new(raw, started.width, started.height).ok_or(CaptureError::Thread { part: "packing" })?)
        }
        None => None,
    };
    let shared = Shared {
        counters: Counters::default(),
        budget: Budget::new(plan.memory_bytes),
        pool: Pool::default(),
        stop: AtomicBool::new(false),
        wants_sample: AtomicBool::new(false),
        sample: Mutex::new(None),
    };
    let (native, packed) = (Queue::default(), Queue::default());
    let shared = &shared;
    std::thread::scope(|scope| {
        let grabbing = scope.spawn(|| grab(source, started.format, plan, shared, &native));
        let packing = scope.spawn(|| pack(started, encoder, shared, &native, &packed));
        let writing = scope.spawn(|| write(started, sink, keep, shared, &packed));
        while !grabbing.is_finished() {
            if !watch(&View { shared }) {
                shared.stop.store(true, Ordering::Relaxed);
            }
            std::thread::sleep(TICK);
        }
        let broke = |part| CaptureError::Thread { part };
        let grabbed = grabbing.join().map_err(|_| broke("grabbing"));
        packing.join().map_err(|_| broke("packing"))?;
        let (whole_bytes, failure) = writing.join().map_err(|_| broke("writing"))?;
        let (ended, clock_corrections) = grabbed?;
        let ended = failure.map_or(ended, Ended::Disk);
        Ok(Outcome { ended, totals: shared.totals(), clock_corrections, whole_bytes })
    })
}

fn grab(
    source: &mut dyn FrameSource,
    format: PixelFormat,
    plan: &Plan,
    shared: &Shared,
    queue: &Queue<Packet>,
) -> (Ended, u64) {
    let _closing = Closing(queue);
    let begun = Instant::now();
    let mut last_came = begun;
    let (mut clock, mut counter, mut jpeg) = (FrameClock::default(), SequenceCounter::default(), JpegEnds::default());
    let mut missing = Missing::default();
    let mut frame = Grabbed::default();
    let count = |n: &AtomicU64, more: u32| n.fetch_add(more.into(), Ordering::Relaxed);
    let ended = loop {
        if shared.stop.load(Ordering::Relaxed) {
            break Ended::Stopped;
        }
        match source.grab(PATIENCE, &mut frame) {
            Ok(Grab::Frame) => {}
            Ok(Grab::Timeout) if last_came.elapsed() > SILENCE => {
                break Ended::Camera(CaptureError::Silent { device: source.name(), secs: SILENCE.as_secs() });
            }
            Ok(Grab::Timeout) => continue,
            Err(e) => break Ended::Camera(e),
        }
        last_came = Instant::now();
        let arrival_nanos = begun.elapsed().as_nanos() as i64;
        let lost = counter.lost_before(frame.sequence);
        missing.lost += lost;
        count(&shared.counters.lost, lost);
        count(&shared.counters.grabbed, 1);
        if frame.is_corrupt || (format == PixelFormat::Mjpeg && !jpeg.is_whole(&frame.data)) {
            missing.corrupt += 1;
            count(&shared.counters.corrupt, 1);
            continue;
        }
        let time_nanos = clock.next(frame.driver_nanos, arrival_nanos);
        if plan.duration.is_some_and(|d| time_nanos as u128 >= d.as_nanos()) {
            break Ended::Complete;
        }
        shared.counters.time_nanos.store(time_nanos, Ordering::Relaxed);
        offer_sample(shared, &frame.data);
        let charged = frame.data.len() + OVERHEAD;
        if !shared.budget.take(charged) {
            missing.discarded += 1;
            count(&shared.counters.discarded, 1);
            continue;
        }
        let bytes = frame.data.len() as u32;
        queue.push(Packet {
            data: std::mem::replace(&mut frame.data, shared.pool.take()),
            charged,
            bytes,
            sequence: frame.sequence,
            driver_nanos: frame.driver_nanos,
            arrival_nanos,
            time_nanos,
            missing: std::mem::take(&mut missing),
            keyframe: true,
            codec: None,
        });
    };
    (ended, clock.corrections())
}

/// Leaves a copy where the calling thread asked for one; if it looks just now, the next frame does.
fn offer_sample(shared: &Shared, data: &[u8]) {
    if shared.wants_sample.load(Ordering::Relaxed)
        && let Ok(mut slot) = shared.sample.try_lock()
    {
        *slot = Some(data.to_vec());
        shared.wants_sample.store(false, Ordering::Relaxed);
    }
}

/// Whether JPEG pictures are whole. Some cameras never write the end mark; of the others, a picture without it was cut.
#[derive(Debug, Default)]
struct JpegEnds {
    seen: bool,
}

impl JpegEnds {
    fn is_whole(&mut self, data: &[u8]) -> bool {
        // Drivers fill up with zeros.
        let end = data.iter().rposition(|&b| b != 0).map_or(0, |last| last + 1);
        let ends = data[..end].ends_with(&[0xff, 0xd9]);
        self.seen |= ends;
        data.starts_with(&[0xff, 0xd8]) && (ends || !self.seen)
    }
}

fn pack(started: &Started, mut encoder: Option<UtEncoder>, shared: &Shared, from: &Queue<Packet>, to: &Queue<Packet>) {
    let _closing = Closing(to);
    let mut missing = Missing::default();
    let mut avc = AvcState::default();
    let mut is_first = true;
    while let Some(mut packet) = from.pop() {
        packet.missing.add(std::mem::take(&mut missing));
        let packed = match (started.format.raw(), &mut encoder) {
            (Some(raw), Some(encoder)) => pack_raw(raw, started, encoder, &mut packet, shared),
            _ if started.format == PixelFormat::H264 => avc.pack(&mut packet),
            _ => {
                packet.codec = Some(Codec::Mjpeg);
                Packed::Kept
            }
        };
        match packed {
            Packed::Kept => {
                if !std::mem::take(&mut is_first) {
                    packet.codec = None;
                }
                let charged = packet.data.len() + OVERHEAD;
                shared.budget.exchange(packet.charged, charged);
                packet.charged = charged;
                to.push(packet);
            }
            other => {
                shared.budget.give(packet.charged);
                missing = packet.missing;
                match other {
                    Packed::Corrupt => {
                        missing.corrupt += 1;
                        shared.counters.corrupt.fetch_add(1, Ordering::Relaxed);
                    }
                    Packed::Undecodable => {
                        missing.discarded += 1;
                        shared.counters.discarded.fetch_add(1, Ordering::Relaxed);
                    }
                    // Before the first picture that can be decoded there is no recording yet.
                    Packed::TooEarly | Packed::Kept => missing = Missing::default(),
                }
                shared.pool.give(packet.data);
            }
        }
    }
}

enum Packed {
    Kept,
    Corrupt,
    /// It builds on a frame that was let go.
    Undecodable,
    /// The stream has not begun.
    TooEarly,
}

fn pack_raw(
    raw: RawLayout,
    started: &Started,
    encoder: &mut UtEncoder,
    packet: &mut Packet,
    shared: &Shared,
) -> Packed {
    let row = raw.row_bytes(started.width);
    if started.stride > row {
        let mut tight = shared.pool.take();
        packet.data.chunks(started.stride).for_each(|padded| tight.extend_from_slice(&padded[..row.min(padded.len())]));
        shared.pool.give(std::mem::replace(&mut packet.data, tight));
    }
    let mut coded = shared.pool.take();
    if !encoder.encode(&packet.data, &mut coded) {
        shared.pool.give(coded);
        return Packed::Corrupt;
    }
    shared.pool.give(std::mem::replace(&mut packet.data, coded));
    packet.codec = Some(Codec::UtVideo(raw.stored_as()));
    Packed::Kept
}

/// H.264 can be decoded from a keyframe on, and as long as no frame is missing.
#[derive(Debug, Default)]
struct AvcState {
    has_begun: bool,
    is_broken: bool,
}

impl AvcState {
    fn pack(&mut self, packet: &mut Packet) -> Packed {
        let unit = access_unit(&packet.data);
        if unit.payload.is_empty() {
            self.is_broken = true;
            return Packed::Corrupt;
        }
        let missing = packet.missing.lost + packet.missing.discarded + packet.missing.corrupt;
        if !self.has_begun {
            let Some(config) = unit.config.filter(|_| unit.is_keyframe) else { return Packed::TooEarly };
            packet.codec = Some(Codec::Avc(config));
            self.has_begun = true;
        } else if unit.is_keyframe {
            self.is_broken = false;
        } else if self.is_broken || missing > 0 {
            self.is_broken = true;
            return Packed::Undecodable;
        }
        packet.keyframe = unit.is_keyframe;
        packet.data = unit.payload;
        Packed::Kept
    }
}

fn write<W: Write>(
    started: &Started,
    sink: W,
    keep: &mut (dyn FnMut(JournalRow, bool) -> io::Result<()> + Send),
    shared: &Shared,
    queue: &Queue<Packet>,
) -> (u64, Option<io::Error>) {
    let nominal_micros = started.rate.map_or(33_333, |r| (1e6 / r.fps()) as u32);
    let mut sink = Some(sink);
    let mut writer: Option<FragmentWriter<W>> = None;
    let mut failure: Option<io::Error> = None;
    let mut waiting: std::collections::VecDeque<JournalRow> = std::collections::VecDeque::new();
    let (mut index, mut base_nanos) = (0u32, 0i64);
    let mut send = |rows: &mut std::collections::VecDeque<JournalRow>, count: usize| -> io::Result<()> {
        for (i, row) in rows.drain(..count).enumerate() {
            shared.counters.written.fetch_add(1, Ordering::Relaxed);
            keep(row, i + 1 == count)?;
        }
        Ok(())
    };
    while let Some(packet) = queue.pop() {
        if failure.is_some() {
            shared.counters.discarded.fetch_add(1, Ordering::Relaxed);
        } else {
            if writer.is_none()
                && let (Some(codec), Some(sink)) = (&packet.codec, sink.take())
            {
                base_nanos = packet.time_nanos;
                match FragmentWriter::new(sink, codec, started.width, started.height, nominal_micros) {
                    Ok(new) => writer = Some(new),
                    Err(e) => failure = Some(e),
                }
            }
            if let Some(writer) = &mut writer {
                waiting.push_back(row(&packet, index, base_nanos));
                index += 1;
                let micros = ((packet.time_nanos - base_nanos) / 1000) as u64;
                let sent = writer.push(micros, packet.keyframe, &packet.data);
                let bytes = writer.whole_bytes();
                shared.counters.bytes.store(bytes, Ordering::Relaxed);
                failure = sent.and_then(|n| send(&mut waiting, n)).err();
            }
            if failure.is_some() {
                shared.stop.store(true, Ordering::Relaxed);
            }
        }
        shared.budget.give(packet.charged);
        shared.pool.give(packet.data);
    }
    if failure.is_none()
        && let Some(writer) = &mut writer
    {
        failure = writer.finish().and_then(|n| send(&mut waiting, n)).err();
    }
    // What did not go out is not in the video.
    shared.counters.discarded.fetch_add(waiting.len() as u64, Ordering::Relaxed);
    let whole = writer.map_or(0, |w| w.whole_bytes());
    shared.counters.bytes.store(whole, Ordering::Relaxed);
    (whole, failure)
}

fn row(packet: &Packet, index: u32, base_nanos: i64) -> JournalRow {
    // Nothing is missing before the first frame.
    let missing = if index == 0 { Missing::default() } else { packet.missing };
    JournalRow {
        index,
        timestamp_nanos: packet.time_nanos - base_nanos,
        sequence: packet.sequence,
        driver_nanos: packet.driver_nanos,
        arrival_nanos: packet.arrival_nanos,
        bytes: packet.bytes,
        lost_before: missing.lost,
        discarded_before: missing.discarded,
        corrupt_before: missing.corrupt,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cut_jpeg_is_told_from_a_camera_that_writes_no_ends() {
        let mut ends = JpegEnds::default();
        assert!(ends.is_whole(&[0xff, 0xd8, 1, 2]) && !ends.is_whole(&[1, 2]) && !ends.is_whole(&[]));
        assert!(ends.is_whole(&[0xff, 0xd8, 1, 0xff, 0xd9, 0, 0]));
        assert!(!ends.is_whole(&[0xff, 0xd8, 1, 2]));
    }
}
