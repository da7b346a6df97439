//! Queues that never make the giver wait, within a limit of memory that they share.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

/// Bytes that may wait, over several queues.
#[derive(Debug)]
pub struct Budget {
    limit: usize,
    used: AtomicUsize,
    peak: AtomicUsize,
}

impl Budget {
    /// At most `limit` bytes.
    pub fn new(limit: usize) -> Self {
        Self { limit, used: AtomicUsize::new(0), peak: AtomicUsize::new(0) }
    }

    /// Takes `bytes` if they are free. One alone is always let in, so that a frame above the limit is not lost for ever.
    pub fn take(&self, bytes: usize) -> bool {
        let taken = self.used.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |used| {
            (used == 0 || used.saturating_add(bytes) <= self.limit).then_some(used + bytes)
        });
        if let Ok(before) = taken {
            self.peak.fetch_max(before + bytes, Ordering::Relaxed);
        }
        taken.is_ok()
    }

    /// Puts a charge in the place of another, whatever the limit: a packed frame for a raw one.
    pub fn exchange(&self, before: usize, after: usize) {
        self.used.fetch_add(after, Ordering::Relaxed);
        self.used.fetch_sub(before, Ordering::Relaxed);
    }

    /// Gives bytes back.
    pub fn give(&self, bytes: usize) {
        self.used.fetch_sub(bytes, Ordering::Relaxed);
    }

    /// Bytes that wait now.
    pub fn used(&self) -> usize {
        self.used.load(Ordering::Relaxed)
    }

    /// The most that ever waited.
    pub fn peak(&self) -> usize {
        self.peak.load(Ordering::Relaxed)
    }
}

/// A queue between two threads.
#[derive(Debug)]
pub struct Queue<T> {
    state: Mutex<State<T>>,
    changed: Condvar,
}

#[derive(Debug)]
struct State<T> {
    items: VecDeque<T>,
    closed: bool,
}

impl<T> Default for Queue<T> {
    fn default() -> Self {
        Self { state: Mutex::new(State { items: VecDeque::new(), closed: false }), changed: Condvar::new() }
    }
}

impl<T> Queue<T> {
    /// Appends an item; the lock is held for that alone.
    pub fn push(&self, item: T) {
        self.lock().items.push_back(item);
        self.changed.notify_one();
    }

    /// Waits for the next item; `None` once the queue is closed and empty.
    pub fn pop(&self) -> Option<T> {
        let mut state = self.lock();
        loop {
            if let Some(item) = state.items.pop_front() {
                return Some(item);
            }
            if state.closed {
                return None;
            }
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Nothing more comes.
    pub fn close(&self) {
        self.lock().closed = true;
        self.changed.notify_all();
    }

    fn lock(&self) -> MutexGuard<'_, State<T>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Closes a queue when its giver ends, however it ends.
pub(super) struct Closing<'a, T>(pub(super) &'a Queue<T>);

impl<T> Drop for Closing<'_, T> {
    fn drop(&mut self) {
        self.0.close();
    }
}

/// Buffers to use again: at 120 frames a second, fresh ones cost more than the copying.
#[derive(Debug, Default)]
pub(super) struct Pool(Mutex<Vec<Vec<u8>>>);

/// More are let go.
const POOLED: usize = 4;

impl Pool {
    pub(super) fn take(&self) -> Vec<u8> {
        let mut buffer = self.0.lock().unwrap_or_else(PoisonError::into_inner).pop().unwrap_or_default();
        buffer.clear();
        buffer
    }

    pub(super) fn give(&self, buffer: Vec<u8>) {
        let mut pool = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if pool.len() < POOLED {
            pool.push(buffer);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// However givers and takers take turns: what was let in comes out once, in order; never more than the limit
        /// waits, but for a lone giant; and every item is either let in or refused.
        #[test]
        fn the_limit_holds_and_nothing_is_lost_unseen(
            limit in 0usize..1000,
            turns in prop::collection::vec((any::<bool>(), 1usize..400), 0..300),
        ) {
            let (budget, queue) = (Budget::new(limit), Queue::default());
            let (mut refused, mut let_in, mut out, mut largest) = (0, Vec::new(), Vec::new(), 0);
            for (number, (gives, bytes)) in turns.iter().enumerate() {
                if *gives {
                    if budget.take(*bytes) {
                        queue.push((number, *bytes));
                        let_in.push(number);
                        largest = largest.max(*bytes);
                    } else {
                        refused += 1;
                    }
                } else if budget.used() > 0 {
                    let (number, bytes) = queue.pop().unwrap();
                    budget.give(bytes);
                    out.push(number);
                }
                prop_assert!(budget.used() <= limit.max(largest));
            }
            queue.close();
            while let Some((number, bytes)) = queue.pop() {
                budget.give(bytes);
                out.push(number);
            }
            prop_assert_eq!(&out, &let_in);
            prop_assert_eq!(let_in.len() + refused, turns.iter().filter(|t| t.0).count());
            prop_assert_eq!(budget.used(), 0);
            prop_assert!(budget.peak() <= limit.max(largest));
        }
    }

    #[test]
    fn threads_hand_over_everything_in_order() {
        let queue = Queue::default();
        let taken = std::thread::scope(|scope| {
            let taker = scope.spawn(|| std::iter::from_fn(|| queue.pop()).collect::<Vec<u32>>());
            {
                let _closing = Closing(&queue);
                (0..10_000).for_each(|i| queue.push(i));
            }
            taker.join().unwrap()
        });
        assert!(taken.into_iter().eq(0..10_000));
    }
}
