//! The frames to be tracked, decoded on a thread of their own while the networks run.

use std::sync::mpsc::{Receiver, sync_channel};
use std::thread::{Builder, Scope, ScopedJoinHandle};

use image::RgbImage;
use risorius_formats::Take;
use risorius_video::{Reader, VideoError};

use super::follow::BLOCK;
use crate::error::{Result, TrackerError};

/// Decoded blocks that wait at most: with the ones being decoded and tracked, three are in memory.
const WAITING: usize = 1;

/// Up to [`BLOCK`] pictures that follow each other.
#[derive(Debug)]
pub struct Block {
    /// Frame numbers, from 0.
    pub frames: Vec<u32>,
    /// Their pictures.
    pub pictures: Vec<RgbImage>,
}

/// Where the blocks come out, and the thread that makes them.
pub type Decoder<'scope> = (Receiver<Block>, ScopedJoinHandle<'scope, Result<(), VideoError>>);

/// Decodes every `every`-th frame of a video, and the last one, on a thread of `scope`.
///
/// `last` is the number of the video's last frame; the thread ends early when the receiver is gone.
pub fn decode<'scope>(
    scope: &'scope Scope<'scope, '_>,
    take: &'scope Take,
    every: u32,
    last: u32,
) -> Result<Decoder<'scope>> {
    let (sender, receiver) = sync_channel(WAITING);
    let work = move || {
        let mut reader = Reader::open_take(take)?;
        let mut block = Block { frames: Vec::new(), pictures: Vec::new() };
        for index in 0..=last {
            let wanted = index % every == 0 || index == last;
            if !wanted {
                if !reader.skip_frame()? {
                    break;
                }
                continue;
            }
            let Some(frame) = reader.next_frame()? else { break };
            block.frames.push(frame.index);
            block.pictures.push(frame.image);
            if block.frames.len() == BLOCK {
                let full = std::mem::replace(&mut block, Block { frames: Vec::new(), pictures: Vec::new() });
                if sender.send(full).is_err() {
                    return Ok(());
                }
            }
        }
        if !block.frames.is_empty() {
            // Nobody listens any more after a failure over there, which is reported there.
            let _ = sender.send(block);
        }
        Ok(())
    };
    let handle = Builder::new()
        .name("decode".to_owned())
        .spawn_scoped(scope, work)
        .map_err(|e| TrackerError::Threads { message: e.to_string() })?;
    Ok((receiver, handle))
}
