//! Which frames are worth placing by themselves: spread over time, parallax and expressions, and sharp.

use risorius_formats::{FrameRecord, Track};

use super::variety::Variety;

/// Key frames stand no farther apart than this on average, seconds, so that what lies between can be interpolated.
const SPACING_SECS: f64 = 0.5;
/// Key frames of a short take.
const FEWEST: usize = 40;
/// Key frames of a long take.
const MOST: usize = 80;
/// A frame of at least this share of the sharpest's sharpness is as good.
const AS_SHARP: f32 = 0.9;

/// How many key frames a take of this length gets by default.
pub fn default_count(frames: &[FrameRecord]) -> usize {
    let secs = duration_secs(frames);
    ((secs / SPACING_SECS).ceil() as usize + 1).clamp(FEWEST, MOST)
}

fn duration_secs(frames: &[FrameRecord]) -> f64 {
    let ends = frames.first().zip(frames.last());
    ends.map_or(0.0, |(a, b)| (b.timestamp_nanos - a.timestamp_nanos) as f64 * 1e-9)
}

/// `count` key frames in ascending order, fewer where the take is short.
///
/// They are spread evenly, half by time, half by the parallax of the camera about the head. The
/// first and the last frame are among them, since nothing is extrapolated. Of the frames in the middle half of their slot
/// the sharpest are looked at: the one whose expression is farthest from those of the key frames so far is taken, and
/// where expressions say nothing the sharpest, or of equally sharp ones the nearest to the middle of the slot. Repeated
/// frames are passed over.
pub fn choose(frames: &[FrameRecord], track: &Track, count: usize) -> Vec<u32> {
    choose_by(frames, &Variety::of(frames, track), count)
}

fn choose_by(frames: &[FrameRecord], variety: &Variety, count: usize) -> Vec<u32> {
    let Some(last) = frames.len().checked_sub(1) else { return Vec::new() };
    if count >= frames.len() {
        return (0..frames.len() as u32).collect();
    }
    if count < 3 {
        return if last == 0 { vec![0] } else { vec![0, last as u32] };
    }
    let way = &variety.way;
    let slot = 1.0 / (count - 1) as f64;
    let mut chosen = vec![0u32];
    for k in 1..count - 1 {
        let middle = slot * k as f64;
        let from = way.partition_point(|&w| w < middle - slot / 4.0);
        let to = way.partition_point(|&w| w <= middle + slot / 4.0);
        let sharpness = |i: usize| frames[i].sharpness.unwrap_or(0.0);
        let sharpest = (from..to).filter(|&i| !frames[i].repeated).map(sharpness).fold(0.0, f32::max);
        let score = |i: usize| {
            let new = variety.news(i as u32, &chosen).filter(|_| sharpness(i) >= AS_SHARP * sharpest);
            (!frames[i].repeated, new.unwrap_or(-1.0), sharpness(i), -(way[i] - middle).abs())
        };
        let better = |&a: &usize, &b: &usize| score(a).partial_cmp(&score(b)).unwrap_or(std::cmp::Ordering::Equal);
        // A slot without frames (frames were dropped) gets none.
        let best = (from..to).max_by(better);
        if let Some(best) = best.filter(|&b| chosen.last().is_some_and(|c| *c < b as u32)) {
            chosen.push(best as u32);
        }
    }
    if chosen.last() != Some(&(last as u32)) {
        chosen.push(last as u32);
    }
    chosen
}

/// Pairs of key frames (by place in the list) whose pictures are worth comparing.
///
/// Every frame with its next four and with those 8, 16, 32 … later, and every fourth with every other such
/// frame: the camera of a selfie comes back to where it was. Few key frames are compared all with all.
pub fn pairs(count: usize) -> Vec<(usize, usize)> {
    let wanted = |i: usize, j: usize| {
        let gap = j - i;
        count <= ALL
            || gap <= OVERLAP
            || (gap >= 8 && gap.is_power_of_two())
            || (i.is_multiple_of(LOOPS) && j.is_multiple_of(LOOPS))
    };
    (0..count).flat_map(|i| (i + 1..count).filter(move |&j| wanted(i, j)).map(move |j| (i, j))).collect()
}

/// Neighbours that each key frame is compared with.
const OVERLAP: usize = 4;
/// Every so many key frames one is compared with all others of its kind.
const LOOPS: usize = 4;
/// Up to this many key frames are compared all with all.
const ALL: usize = 16;

#[cfg(test)]
mod tests {
    use super::*;
    use risorius_formats::FrameIndex;

    use super::super::variety::tests::seen;

    fn choose_by_time(frames: &[FrameRecord], count: usize) -> Vec<u32> {
        choose(frames, &Track::default(), count)
    }

    fn frames(n: u32, sharpness: impl Fn(u32) -> f32) -> Vec<FrameRecord> {
        (0..n)
            .map(|i| FrameRecord {
                index: FrameIndex(i),
                timestamp_nanos: i64::from(i) * 10_000_000,
                sharpness: Some(sharpness(i)),
                ..FrameRecord::default()
            })
            .collect()
    }

    #[test]
    fn sharp_frames_are_preferred_within_their_slot_and_the_ends_are_kept() {
        // 11 places, 100 frames apart; the middle half of a slot is ±25 frames.
        let chosen = choose_by_time(&frames(1001, |i| if i % 100 == 10 { 9.0 } else { 1.0 }), 11);
        assert_eq!(chosen, [0, 110, 210, 310, 410, 510, 610, 710, 810, 910, 1000]);
        // A sharper frame outside the middle half of the slot would leave a gap.
        let chosen = choose_by_time(&frames(1001, |i| if i % 100 == 40 { 9.0 } else { 1.0 }), 11);
        assert_eq!(chosen, (0..=10).map(|k| k * 100).collect::<Vec<_>>());
    }

    #[test]
    fn repeated_frames_and_holes_are_passed_over() {
        let mut list = frames(1001, |_| 1.0);
        list[200].repeated = true;
        list[200].sharpness = Some(99.0);
        let chosen = choose_by_time(&list, 11);
        assert_ne!(chosen[2], 200);
        for f in &mut list[501..] {
            f.timestamp_nanos += 5_000_000_000;
        }
        let chosen = choose_by_time(&list, 16);
        assert!(chosen.windows(2).all(|w| w[0] < w[1]));
        assert!(chosen.len() < 16 && chosen.first() == Some(&0) && chosen.last() == Some(&1000));
    }

    #[test]
    fn key_frames_stand_denser_where_the_camera_moves() {
        let (frames, track) = seen(1001, |i| if i < 500 { 0.0 } else { f64::from(i - 500) / 500.0 }, |_| 0.0);
        let chosen = choose(&frames, &track, 41);
        let resting = chosen.iter().filter(|&&f| f < 500).count();
        assert!((9..=12).contains(&resting) && chosen.len() == 41, "{resting} of {}", chosen.len());
    }

    #[test]
    fn new_expressions_are_taken_among_frames_as_sharp() {
        let smile = |i: u32| if (205..215).contains(&i) || (405..415).contains(&i) { 4.0 } else { 0.0 };
        let (mut frames, track) = seen(1001, |_| 0.0, smile);
        let variety = Variety::of(&frames, &track);
        let chosen = choose_by(&frames, &variety, 11);
        // The first smile is news; the second one no more.
        assert!(chosen.iter().any(|f| (205..215).contains(f)) && chosen.contains(&400), "{chosen:?}");
        // A blurred smile is not worth it.
        for frame in &mut frames[205..215] {
            frame.sharpness = Some(0.5);
        }
        assert!(choose_by(&frames, &variety, 11).contains(&200));
    }

    #[test]
    fn short_takes_give_all_they_have() {
        assert_eq!(choose_by_time(&frames(5, |_| 1.0), 80), [0, 1, 2, 3, 4]);
        assert!(choose_by_time(&[], 80).is_empty());
        assert_eq!(default_count(&frames(5, |_| 1.0)), 40);
        assert_eq!(default_count(&frames(2999, |_| 1.0)), 61);
        assert_eq!(default_count(&frames(12_001, |_| 1.0)), 80);
    }

    #[test]
    fn pairs_hold_neighbours_and_loops_once() {
        let p = pairs(80);
        assert!(p.contains(&(0, 1)) && p.contains(&(70, 74)) && p.contains(&(3, 67)) && p.contains(&(0, 76)));
        assert!(!p.contains(&(1, 12)));
        let mut sorted = p.clone();
        sorted.dedup();
        assert_eq!(sorted.len(), p.len());
        assert!(p.len() < 800, "{}", p.len());
        assert_eq!(pairs(16).len(), 120);
    }
}
