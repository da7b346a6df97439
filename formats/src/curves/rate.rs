//! Frames per second of a table whose rows count frames: from timecodes, or from clocks of whole seconds beside them.

/// Rates that cameras and phones count at.
const USUAL: [f64; 12] = [10.0, 12.0, 15.0, 20.0, 24.0, 25.0, 30.0, 48.0, 50.0, 60.0, 100.0, 120.0];
/// Timecodes count at these.
const TIMECODES: [f64; 8] = [24.0, 25.0, 30.0, 48.0, 50.0, 60.0, 100.0, 120.0];
/// What a timecode counts at where nothing tells: the rate of Live Link Face.
const UNKNOWN_TIMECODE: f64 = 60.0;
/// A step between frames that is longer or shorter by this share of a frame has shares that mean nothing.
const FALSE_SHARE: f64 = 0.75;
/// A clock that goes back by more than this has passed midnight.
const HALF_A_DAY_SECS: f64 = 43_200.0;
const DAY_SECS: f64 = 86_400.0;

/// A timecode: whole seconds since midnight, and frames.
pub(super) type Code = [f64; 2];

/// Lets seconds go on after midnight.
pub(super) fn unroll(codes: &mut [Code]) {
    let (mut days, mut before) = (0.0, None);
    for [secs, _] in codes {
        if before.is_some_and(|b: f64| b - *secs > HALF_A_DAY_SECS) {
            days += DAY_SECS;
        }
        before = Some(*secs);
        *secs += days;
    }
}

/// Drops the shares of frames where they are none: shares that go round by themselves would let a frame last almost two.
pub(super) fn without_false_shares(codes: &mut [Code]) {
    let within = codes.windows(2).filter(|w| w[0][0] == w[1][0] && w[1][1].floor() > w[0][1].floor());
    let mut off = within.map(|w| (w[1][1] - w[0][1] - (w[1][1].floor() - w[0][1].floor())).abs());
    if off.any(|off| off > FALSE_SHARE) {
        for code in codes {
            code[1] = code[1].floor();
        }
    }
}

/// Frames per second of unrolled timecodes, and whether they tell it.
///
/// The highest frame number of all seconds is one less than the rate; where a second ends, the step over its end says the
/// same, also where rows are missing or a recording is shorter than a second.
pub(super) fn of_timecodes(codes: &[Code]) -> (f64, bool) {
    let most = codes.iter().map(|c| c[1].floor()).fold(0.0, f64::max) + 1.0;
    let mut steps: Vec<f64> =
        codes.windows(2).filter(|w| w[0][0] == w[1][0]).map(|w| w[1][1] - w[0][1]).filter(|d| *d > 0.0).collect();
    steps.sort_unstable_by(f64::total_cmp);
    let step = steps.get(steps.len() / 2).copied();
    let over = |w: &[Code]| (w[1][0] == w[0][0] + 1.0).then(|| w[0][1] - w[1][1] + step.unwrap_or(1.0));
    let at_ends = codes.windows(2).filter_map(over).fold(0.0, f64::max);
    if at_ends <= 0.0 {
        let least = UNKNOWN_TIMECODE.max(most);
        return (TIMECODES.into_iter().find(|r| *r >= least).unwrap_or(least), false);
    }
    let least = most.max(at_ends - 0.5);
    (TIMECODES.into_iter().find(|r| *r >= least).unwrap_or(least), true)
}

/// Frames per second of frame numbers with a clock that shows whole seconds; `None` where it shows one second only.
pub(super) fn of_clock(rows: impl Iterator<Item = (f64, f64)>) -> Option<f64> {
    // Frame f is shown at second s: s ≤ f / rate < s + 1.
    let (mut above, mut up_to) = (0.0f64, f64::INFINITY);
    for (frame, secs) in rows {
        let secs = secs.floor();
        above = above.max(frame / (secs + 1.0));
        if secs >= 1.0 {
            up_to = up_to.min(frame / secs);
        }
    }
    if !up_to.is_finite() || up_to <= 0.0 {
        return None;
    }
    // Rounded clocks may contradict each other by a frame.
    let fits = |r: &f64| *r > above - 1e-6 && *r <= up_to + 1e-6;
    let middle = 0.5 * (above + up_to);
    let near = |a: &f64, b: &f64| (a - middle).abs().total_cmp(&(b - middle).abs());
    USUAL.into_iter().filter(fits).min_by(near).or(Some(middle))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The timecodes of `frames` rows, the first at `start` frames after midnight.
    fn codes(rate: u32, start: u32, frames: u32, step: usize) -> Vec<Code> {
        let code = |n: u32| [f64::from(n / rate % 86_400), f64::from(n % rate) + 0.037];
        (start..start + frames).step_by(step).map(code).collect()
    }

    #[test]
    fn timecodes_tell_every_usual_rate() {
        for rate in [24, 25, 30, 48, 50, 60] {
            for (start, frames, step) in [(0, 3 * rate, 1), (rate / 2, rate, 1), (rate - 2, 12, 1), (5, 4 * rate, 2)] {
                let codes = codes(rate, start, frames, step);
                assert_eq!(of_timecodes(&codes), (f64::from(rate), true), "{rate} {start} {frames} {step}");
            }
        }
        // Within a second nothing tells.
        assert_eq!(of_timecodes(&codes(24, 3, 12, 1)), (60.0, false));
        // A row that is missing at the end of a second.
        let mut missing = codes(25, 0, 75, 1);
        missing.retain(|c| c[1] < 24.0);
        missing.extend(codes(25, 75, 25, 1));
        assert_eq!(of_timecodes(&missing).0, 25.0);
    }

    #[test]
    fn midnight_is_passed() {
        let mut rolled = codes(30, 30 * 86_400 - 3, 6, 1);
        assert_eq!(rolled[3][0], 0.0);
        unroll(&mut rolled);
        assert_eq!((rolled[2][0], rolled[3][0]), (86_399.0, 86_400.0));
        assert_eq!(of_timecodes(&rolled), (30.0, true));
    }

    #[test]
    fn a_clock_of_whole_seconds_tells_the_rate() {
        for rate in [10u32, 24, 25, 30, 50, 60] {
            let rows = (0..3 * rate).map(|f| (f64::from(f), f64::from(f / rate)));
            assert_eq!(of_clock(rows), Some(f64::from(rate)));
        }
        assert_eq!(of_clock((0..20).map(|f| (f64::from(f), 0.0))), None);
    }
}
