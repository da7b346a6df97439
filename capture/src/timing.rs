//! Dropped frames, repeated frames and jitter, from times and picture differences.
//!
//! * **Usual interval** of a frame: the median of up to 121 intervals around it. A file whose rate changes for good (as
//!   phones do in dim light) thus has no dropped frames but where the rate changes.
//! * **Dropped**: an interval above 1.5 times the usual one hides round(interval / usual) − 1 frames.
//! * **Repeated**: the picture is that of the frame before (mean difference ≤ 0.01 levels), or it differs by at most
//!   0.5 levels and an eighth of what is usual around it, which is what a repeated frame looks like after an encoder.

/// Intervals on each side that say what is usual.
const AROUND_INTERVALS: usize = 60;
/// An interval this much longer than usual hides a dropped frame.
const DROP_RATIO: f64 = 1.5;
/// Pictures on each side that say how much is usual to change.
const AROUND_PICTURES: usize = 15;
/// Mean luma difference of identical pictures, levels: room for rounding.
const IDENTICAL: f32 = 0.01;
/// Mean luma difference of a repeated and encoded picture, levels, at most.
const NEARLY_IDENTICAL: f32 = 0.5;
/// … and as a share of the usual difference.
const SHARE_OF_USUAL: f32 = 0.125;

/// The median; the lower one of two. `None` for an empty slice.
pub fn median<T: Copy + PartialOrd>(values: &[T]) -> Option<T> {
    quantile(values, 0.5)
}

/// The value below which a share `q` (0–1) of the others lies. `None` for an empty slice.
pub fn quantile<T: Copy + PartialOrd>(values: &[T], q: f64) -> Option<T> {
    if values.is_empty() {
        return None;
    }
    let mut sorted = values.to_vec();
    let at = ((sorted.len() - 1) as f64 * q.clamp(0.0, 1.0)).floor() as usize;
    let order = |a: &T, b: &T| a.partial_cmp(b).unwrap_or(std::cmp::Ordering::Equal);
    Some(*sorted.select_nth_unstable_by(at, order).1)
}

/// The intervals between frames, nanoseconds: one fewer than frames.
pub fn intervals(timestamps_nanos: &[i64]) -> Vec<i64> {
    timestamps_nanos.windows(2).map(|w| w[1].saturating_sub(w[0])).collect()
}

/// What is usual around each interval.
pub fn usual_intervals(intervals: &[i64]) -> Vec<i64> {
    (0..intervals.len()).map(|i| median(around(intervals, i, AROUND_INTERVALS)).unwrap_or(0)).collect()
}

fn around<T>(values: &[T], i: usize, reach: usize) -> &[T] {
    &values[i.saturating_sub(reach)..(i + reach + 1).min(values.len())]
}

/// How many frames are missing before each frame.
pub fn dropped_before(timestamps_nanos: &[i64]) -> Vec<u32> {
    let intervals = intervals(timestamps_nanos);
    let usual = usual_intervals(&intervals);
    let missing = intervals.iter().zip(&usual).map(|(&interval, &usual)| {
        let ratio = interval as f64 / usual.max(1) as f64;
        if ratio > DROP_RATIO { ((ratio.round() as u32).saturating_sub(1)).max(1) } else { 0 }
    });
    std::iter::once(0).chain(missing).take(timestamps_nanos.len()).collect()
}

/// Which frames repeat the one before; `differences[i]` is the mean difference of frames i and i + 1, luma levels.
pub fn repeated(differences: &[f32]) -> Vec<bool> {
    let later = (0..differences.len()).map(|i| {
        let difference = differences[i];
        let usual = median(around(differences, i, AROUND_PICTURES)).unwrap_or(0.0);
        difference <= IDENTICAL || (difference <= NEARLY_IDENTICAL && difference <= SHARE_OF_USUAL * usual)
    });
    std::iter::once(false).chain(later).collect()
}

/// Root mean square deviation of the intervals from what is usual around them, dropped frames left out; nanoseconds.
///
/// `None` when no two frames follow each other.
pub fn jitter_nanos(timestamps_nanos: &[i64]) -> Option<f64> {
    let intervals = intervals(timestamps_nanos);
    let usual = usual_intervals(&intervals);
    let squares: Vec<f64> = intervals
        .iter()
        .zip(&usual)
        .filter(|&(&interval, &usual)| interval as f64 <= DROP_RATIO * usual as f64)
        .map(|(&interval, &usual)| (interval as f64 - usual as f64).powi(2))
        .collect();
    (!squares.is_empty()).then(|| (squares.iter().sum::<f64>() / squares.len() as f64).sqrt())
}

/// (frames − 1) / duration; 0 when there is no duration.
pub fn measured_fps(timestamps_nanos: &[i64]) -> f64 {
    match (timestamps_nanos.first(), timestamps_nanos.last()) {
        (Some(first), Some(last)) if last > first => {
            (timestamps_nanos.len() - 1) as f64 * 1e9 / last.saturating_sub(*first) as f64
        }
        _ => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP: i64 = 8_333_333;

    #[test]
    fn missing_frames_are_counted_where_they_are_missing() {
        let times: Vec<i64> = (0..300).filter(|i| ![50, 51, 52, 200].contains(i)).map(|i| i * STEP).collect();
        let dropped = dropped_before(&times);
        assert_eq!((dropped[50], dropped[197], dropped.iter().sum::<u32>()), (3, 1, 4));
    }

    #[test]
    fn a_lasting_change_of_rate_drops_nothing() {
        let mut times: Vec<i64> = (0..300).map(|i| i * STEP).collect();
        let last = times[299];
        times.extend((1..300).map(|i| last + i * 4 * STEP));
        // Around the change itself the usual interval is in doubt, for half the window at most.
        let dropped = dropped_before(&times);
        assert_eq!(dropped[..300].iter().chain(&dropped[361..]).sum::<u32>(), 0);
    }

    #[test]
    fn rounding_to_milliseconds_is_neither_a_drop_nor_much_jitter() {
        let times: Vec<i64> = (0..500).map(|i| (i as f64 * 1000.0 / 120.0).round() as i64 * 1_000_000).collect();
        assert_eq!(dropped_before(&times).iter().sum::<u32>(), 0);
        assert!(jitter_nanos(&times).unwrap() < 1e6);
        assert!((measured_fps(&times) - 120.0).abs() < 0.1);
    }

    #[test]
    fn jitter_of_alternating_intervals_is_their_deviation() {
        let mut t = 0;
        let times: Vec<i64> = (0..101)
            .map(|i| {
                t += if i % 4 == 0 { 12 } else { 10 };
                t
            })
            .collect();
        // A quarter of the intervals deviates by 2: the mean square is 1.
        assert!((jitter_nanos(&times).unwrap() - 1.0).abs() < 1e-9);
    }

    #[test]
    fn a_repeated_picture_stands_out_from_motion_but_stillness_does_not() {
        let mut moving = vec![2.0f32; 60];
        (moving[10], moving[30], moving[31]) = (0.2, 0.0, 0.4);
        let found: Vec<usize> = repeated(&moving).iter().enumerate().filter(|(_, r)| **r).map(|(i, _)| i).collect();
        assert_eq!(found, [11, 31]);
        assert!(!repeated(&[0.3; 60]).contains(&true));
        assert_eq!(repeated(&[0.0; 3]), [false, true, true, true]);
    }

    #[test]
    fn one_frame_or_none_is_no_trouble() {
        for times in [&[][..], &[0]] {
            assert_eq!(dropped_before(times).len(), times.len());
            assert_eq!((jitter_nanos(times), measured_fps(times)), (None, 0.0));
        }
    }
}
