//! The thread that makes samples of an MP4 file from native frames: raw ones are coded without loss, H.264 is put into
//! another framing, MJPEG stays as it is.

use std::sync::atomic::Ordering;

use risorius_video::avc::access_unit;
use risorius_video::fragmented::Codec;
use risorius_video::{RawLayout, UtEncoder};

use super::pipeline::{Missing, OVERHEAD, Packet, Shared};
use super::queue::{Closing, Queue};
use crate::source::{PixelFormat, Started};

/// Packs until nothing more comes.
pub(super) fn pack(
    started: &Started,
    mut encoder: Option<UtEncoder>,
    shared: &Shared,
    from: &Queue<Packet>,
    to: &Queue<Packet>,
) {
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
                let charged = packet.data.capacity() + OVERHEAD;
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
    let mut coded = shared.coded_pool.take();
    if !encoder.encode(&packet.data, &mut coded) {
        shared.coded_pool.give(coded);
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
