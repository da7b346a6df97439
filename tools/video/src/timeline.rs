//! When each frame is shown, from a container's tables.

/// One sample of a video track, in ticks of the track.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Sample {
    /// Composition time.
    pub(crate) presented: i64,
    pub(crate) duration: i64,
}

/// One row of an edit list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Edit {
    /// Length in ticks of the movie.
    pub(crate) duration: u64,
    /// First tick of the track that is shown; −1 shows nothing for `duration`.
    pub(crate) media_time: i64,
}

/// The presentation times of a video's frames, in the order they are shown, with the first frame at 0.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Timeline {
    nanos: Vec<i64>,
}

impl Timeline {
    pub(crate) fn new(samples: &[Sample], edits: &[Edit], time_scale: u32, movie_scale: u32) -> Self {
        let mut shown: Vec<i64> = samples.iter().map(|s| s.presented).collect();
        shown.sort_unstable();
        let ticks = apply_edits(&shown, edits, time_scale, movie_scale);
        let first = ticks.first().copied().unwrap_or(0);
        let nanos = ticks.iter().map(|t| nanos(t.saturating_sub(first), time_scale)).collect();
        Self { nanos }
    }

    /// Nanoseconds since the first frame, ascending.
    pub fn nanos(&self) -> &[i64] {
        &self.nanos
    }
}

/// The times that the edits show, on the movie's timeline but in ticks of the track.
fn apply_edits(shown: &[i64], edits: &[Edit], time_scale: u32, movie_scale: u32) -> Vec<i64> {
    if edits.iter().all(|e| e.media_time < 0) {
        return shown.to_vec();
    }
    let mut out = Vec::with_capacity(shown.len());
    let mut start = 0i64;
    for edit in edits {
        // A duration of 0 means: to the end (fragmented files).
        let length = match (edit.duration, movie_scale) {
            (0, _) | (_, 0) => i64::MAX,
            (d, scale) => i64::try_from(u128::from(d) * u128::from(time_scale) / u128::from(scale)).unwrap_or(i64::MAX),
        };
        if edit.media_time >= 0 {
            let end = edit.media_time.saturating_add(length);
            let from = shown.partition_point(|&t| t < edit.media_time);
            let to = shown.partition_point(|&t| t < end);
            out.extend(shown[from..to].iter().map(|t| start.saturating_add(t.saturating_sub(edit.media_time))));
        }
        start = start.saturating_add(length);
    }
    out
}

fn nanos(ticks: i64, time_scale: u32) -> i64 {
    let scale = i128::from(time_scale);
    let rounded = (i128::from(ticks) * 1_000_000_000 + scale / 2).div_euclid(scale);
    i64::try_from(rounded).unwrap_or(i64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn samples(times: &[i64]) -> Vec<Sample> {
        times.iter().map(|&presented| Sample { presented, duration: 10 }).collect()
    }

    #[test]
    fn reordered_samples_are_shown_in_order_from_zero() {
        let t = Timeline::new(&samples(&[20, 50, 30, 40]), &[], 1000, 1000);
        assert_eq!(t.nanos(), [0, 10_000_000, 20_000_000, 30_000_000]);
    }

    #[test]
    fn an_edit_trims_both_ends_and_an_empty_one_only_shifts() {
        let edits = [Edit { duration: 500, media_time: -1 }, Edit { duration: 2, media_time: 30 }];
        let t = Timeline::new(&samples(&[20, 30, 40, 50, 60]), &edits, 1000, 100);
        assert_eq!(t.nanos(), [0, 10_000_000]);
    }

    #[test]
    fn two_edits_are_shown_one_after_the_other() {
        let edits = [Edit { duration: 20, media_time: 40 }, Edit { duration: 20, media_time: 0 }];
        let t = Timeline::new(&samples(&[0, 10, 20, 30, 40, 50]), &edits, 1000, 1000);
        assert_eq!(t.nanos(), [0, 10_000_000, 20_000_000, 30_000_000]);
    }

    #[test]
    fn thirds_of_a_second_are_rounded_not_summed() {
        let t = Timeline::new(&samples(&[0, 1, 2, 3]), &[], 3, 1);
        assert_eq!(t.nanos(), [0, 333_333_333, 666_666_667, 1_000_000_000]);
    }
}
