//! The thread that writes fragments, and the journal's rows once their fragment is out.

use std::collections::VecDeque;
use std::io::{self, Write};
use std::sync::atomic::Ordering;

use risorius_video::fragmented::FragmentWriter;

use super::journal::JournalRow;
use super::pipeline::{Missing, Packet, Shared};
use super::queue::Queue;
use crate::source::Started;

/// Writes until nothing more comes; gives the bytes up to the last whole fragment, and what went wrong.
pub(super) fn write<W: Write>(
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
    let mut waiting: VecDeque<JournalRow> = VecDeque::new();
    let (mut index, mut base_nanos) = (0u32, 0i64);
    let mut send = |rows: &mut VecDeque<JournalRow>, count: usize| -> io::Result<()> {
        for (i, row) in rows.drain(..count).enumerate() {
            shared.counters.written.fetch_add(1, Ordering::Relaxed);
            keep(row, i + 1 == count)?;
        }
        Ok(())
    };
    let pool = if started.format.raw().is_some() { &shared.coded_pool } else { &shared.pool };
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
        pool.give(packet.data);
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
