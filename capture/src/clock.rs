//! From the driver's times and counts to the take's: time since the first frame, and how many frames are missing.

/// Time must go on by at least this much from frame to frame; an MP4 file counts in microseconds.
const LEAST_STEP_NANOS: i64 = 1000;
/// A jump of the driver's clock above this is none of a camera.
const LARGEST_STEP_NANOS: i64 = 3_600_000_000_000;

/// Turns driver times into times since the first frame.
///
/// The driver's clock is believed as long as it ascends. Where it is missing, stands still, runs back or leaps by more than
/// an hour, the time of arrival says how much time went by, and the clock is set anew from there.
#[derive(Clone, Debug, Default)]
pub struct FrameClock {
    last: Option<Last>,
    corrections: u64,
}

#[derive(Clone, Copy, Debug)]
struct Last {
    driver: Option<i64>,
    arrival: i64,
    out: i64,
}

impl FrameClock {
    /// The time of the next frame since the first, nanoseconds; it ascends strictly.
    pub fn next(&mut self, driver_nanos: Option<i64>, arrival_nanos: i64) -> i64 {
        let Some(last) = self.last else {
            self.last = Some(Last { driver: driver_nanos, arrival: arrival_nanos, out: 0 });
            return 0;
        };
        let by_driver = driver_nanos.zip(last.driver).and_then(|(now, before)| now.checked_sub(before));
        let step = match by_driver {
            Some(step) if (LEAST_STEP_NANOS..=LARGEST_STEP_NANOS).contains(&step) => step,
            other => {
                self.corrections += u64::from(other.is_some());
                arrival_nanos.saturating_sub(last.arrival).clamp(LEAST_STEP_NANOS, LARGEST_STEP_NANOS)
            }
        };
        let out = last.out.saturating_add(step);
        self.last = Some(Last { driver: driver_nanos, arrival: arrival_nanos, out });
        out
    }

    /// How often the driver's clock was wrong.
    pub fn corrections(&self) -> u64 {
        self.corrections
    }
}

/// Counts the frames that a driver lost, by its sequence numbers, which wrap at 2³².
#[derive(Clone, Debug, Default)]
pub struct SequenceCounter {
    last: Option<u32>,
}

/// A larger step is no loss: the driver began to count anew.
const LARGEST_LOSS: u32 = 1 << 20;

impl SequenceCounter {
    /// How many frames are missing before this one; 0 where the driver does not count.
    pub fn lost_before(&mut self, sequence: Option<u32>) -> u32 {
        let Some(now) = sequence else { return 0 };
        let lost = self.last.map_or(0, |before| now.wrapping_sub(before).wrapping_sub(1));
        self.last = Some(now);
        if lost > LARGEST_LOSS { 0 } else { lost }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_clock_that_runs_back_is_replaced_by_the_time_of_arrival() {
        let mut clock = FrameClock::default();
        let times: Vec<i64> = [(1000, 0), (9000, 8100), (500, 16_300), (8500, 24_200)]
            .into_iter()
            .map(|(driver, arrival)| clock.next(Some(1000 * driver), 1000 * arrival))
            .collect();
        assert_eq!(times, [0, 8_000_000, 16_200_000, 24_200_000]);
        assert_eq!(clock.corrections(), 1);
        assert_eq!(clock.next(None, 32_200_000), 32_200_000);
    }

    #[test]
    fn a_repeated_or_restarted_count_is_no_loss() {
        let mut counter = SequenceCounter::default();
        let lost: Vec<u32> = [5, 6, 9, 9, 2, 3].into_iter().map(|s| counter.lost_before(Some(s))).collect();
        assert_eq!(lost, [0, 0, 2, 0, 0, 0]);
        assert_eq!(counter.lost_before(None), 0);
    }

    proptest! {
        #[test]
        fn sane_driver_times_are_kept_to_the_nanosecond(
            start in -1i64 << 50..1 << 50,
            steps in prop::collection::vec(LEAST_STEP_NANOS..1_000_000_000i64, 0..200),
        ) {
            let mut clock = FrameClock::default();
            let mut driver = start;
            prop_assert_eq!(clock.next(Some(driver), 7), 0);
            for step in steps {
                driver += step;
                // Arrivals do not matter, however late.
                prop_assert_eq!(clock.next(Some(driver), 0), driver - start);
            }
            prop_assert_eq!(clock.corrections(), 0);
        }

        #[test]
        fn time_always_ascends(frames in prop::collection::vec((any::<Option<i64>>(), any::<i64>()), 1..100)) {
            let mut clock = FrameClock::default();
            let mut before = -1;
            for (driver, arrival) in frames {
                let now = clock.next(driver, arrival);
                prop_assert!(now > before);
                before = now;
            }
        }

        #[test]
        fn lost_frames_are_counted_exactly_even_where_the_count_wraps(
            first in any::<u32>(),
            kept in prop::collection::vec(prop::bool::weighted(0.8), 2..400),
        ) {
            let mut counter = SequenceCounter::default();
            let mut total = 0;
            let numbers: Vec<u32> =
                kept.iter().enumerate().filter(|(_, k)| **k).map(|(i, _)| first.wrapping_add(i as u32)).collect();
            for n in &numbers {
                total += counter.lost_before(Some(*n));
            }
            if let (Some(a), Some(b)) = (numbers.first(), numbers.last()) {
                prop_assert_eq!(total as usize, b.wrapping_sub(*a) as usize + 1 - numbers.len());
            }
        }
    }
}
