//! The thread that takes frames from the driver, and waits for nobody.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use super::pipeline::{Ended, Missing, OVERHEAD, Packet, Plan, SILENCE, Shared};
use super::queue::{Closing, Queue};
use crate::CaptureError;
use crate::clock::{FrameClock, SequenceCounter};
use crate::source::{FrameSource, Grab, Grabbed, PixelFormat};

/// How long a grab waits before it looks whether to stop.
const PATIENCE: Duration = Duration::from_millis(100);

/// Grabs until the end; also gives how often the driver's clock was wrong.
pub(super) fn grab(
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
        // What it holds, which may be more than it fills.
        let charged = frame.data.capacity() + OVERHEAD;
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
