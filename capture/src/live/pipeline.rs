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
use std::time::Duration;

use risorius_video::UtEncoder;
use risorius_video::fragmented::Codec;

use super::grab::grab;
use super::journal::JournalRow;
use super::pack::pack;
use super::queue::{Budget, Pool, Queue};
use super::write::write;
use crate::source::{FrameSource, Started};
use crate::{CaptureError, Result};

/// A camera that gives nothing for so long has failed.
pub(super) const SILENCE: Duration = Duration::from_secs(5);
/// What a waiting frame costs beside its bytes.
pub(super) const OVERHEAD: usize = 256;
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
pub(super) struct Counters {
    pub(super) grabbed: AtomicU64,
    pub(super) lost: AtomicU64,
    pub(super) discarded: AtomicU64,
    pub(super) corrupt: AtomicU64,
    pub(super) written: AtomicU64,
    pub(super) bytes: AtomicU64,
    pub(super) time_nanos: AtomicI64,
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

pub(super) struct Shared {
    pub(super) counters: Counters,
    pub(super) budget: Budget,
    pub(super) pool: Pool,
    /// Coded frames are half as large as raw ones: in buffers of their own they leave none half empty.
    pub(super) coded_pool: Pool,
    pub(super) stop: AtomicBool,
    pub(super) wants_sample: AtomicBool,
    pub(super) sample: Mutex<Option<Vec<u8>>>,
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
pub(super) struct Missing {
    pub(super) lost: u32,
    pub(super) discarded: u32,
    pub(super) corrupt: u32,
}

impl Missing {
    pub(super) fn add(&mut self, other: Self) {
        self.lost += other.lost;
        self.discarded += other.discarded;
        self.corrupt += other.corrupt;
    }
}

/// A frame on its way.
pub(super) struct Packet {
    pub(super) data: Vec<u8>,
    pub(super) charged: usize,
    pub(super) bytes: u32,
    pub(super) sequence: Option<u32>,
    pub(super) driver_nanos: Option<i64>,
    pub(super) arrival_nanos: i64,
    pub(super) time_nanos: i64,
    pub(super) missing: Missing,
    pub(super) keyframe: bool,
    /// With the first one.
    pub(super) codec: Option<Codec>,
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
        coded_pool: Pool::default(),
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
