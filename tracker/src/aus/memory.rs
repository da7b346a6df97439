//! What an online calibration has seen: some frames, spread evenly over all.

/// Frames that are kept: half of them are dropped when it is full.
const REMEMBERED: usize = 1200;
/// Frames between two fits; the first fits come after fewer.
const REFIT: usize = 30;

/// Frames of which `T` is kept.
#[derive(Clone, Debug)]
pub struct Memory<T> {
    frames: Vec<T>,
    seen: usize,
    step: usize,
}

impl<T> Default for Memory<T> {
    fn default() -> Self {
        Self { frames: Vec::new(), seen: 0, step: 1 }
    }
}

impl<T> Memory<T> {
    /// Takes the next frame.
    pub fn push(&mut self, frame: T) {
        if self.seen.is_multiple_of(self.step) {
            self.frames.push(frame);
        }
        self.seen += 1;
        if self.frames.len() == REMEMBERED {
            // Every second one, so that what is kept stays spread over all that was seen.
            let mut keep = false;
            self.frames.retain(|_| {
                keep = !keep;
                keep
            });
            self.step *= 2;
        }
    }

    /// Whether it is time to fit again: after 1, 2, 4, 8 and 16 frames, then every 30.
    pub fn is_due(&self) -> bool {
        (self.seen < REFIT && self.seen.is_power_of_two()) || self.seen.is_multiple_of(REFIT)
    }

    /// What is kept.
    pub fn frames(&self) -> &[T] {
        &self.frames
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_remembered_stays_spread_over_all_that_was_seen() {
        let mut memory = Memory::default();
        for i in 0..5000 {
            memory.push(i);
        }
        let frames = memory.frames();
        assert!(frames.len() < REMEMBERED && frames.len() > REMEMBERED / 3);
        assert!(frames.windows(2).all(|w| w[1] - w[0] == frames[1] - frames[0]), "{frames:?}");
    }
}
