//! Frame rates from the times of a stream's packets or frames.

use ffmpeg::format::context::Input;
use ffmpeg::{Packet, Rational};

/// Packets that are looked at for the rates of a container without an index.
const SAMPLED: usize = 600;

/// What the times of a stream say of its rate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Rates {
    /// (frames − 1) / duration.
    pub(crate) mean: f64,
    /// Of the shortest usual interval: 5 % of all intervals are shorter. Rates halve in dim light; this one does not.
    pub(crate) peak: f64,
}

impl Rates {
    /// `nanos` ascend; `None` where nothing passes between the first and the last.
    pub(crate) fn of(nanos: &[i64]) -> Option<Self> {
        let span = nanos.last()?.checked_sub(*nanos.first()?).filter(|&s| s > 0)?;
        let mean = (nanos.len() - 1) as f64 * 1e9 / span as f64;
        let mut intervals: Vec<i64> = nanos.windows(2).map(|w| w[1] - w[0]).filter(|&i| i > 0).collect();
        intervals.sort_unstable();
        let usual = *intervals.get(intervals.len() / 20)?;
        // Times in whole milliseconds make single intervals shorter than they are: the mean of those that are alike.
        let alike = intervals.iter().take_while(|&&i| i as f64 <= 1.25 * usual as f64).copied().collect::<Vec<_>>();
        let from = intervals.partition_point(|&i| (i as f64) < 0.8 * usual as f64);
        let alike = alike.get(from..).filter(|a| !a.is_empty()).unwrap_or(&[usual]).to_vec();
        let interval = alike.iter().sum::<i64>() as f64 / alike.len() as f64;
        Some(Self { mean, peak: 1e9 / interval })
    }
}

/// Ticks of a stream as nanoseconds.
pub(crate) fn nanos(ticks: i64, base: Rational) -> i64 {
    let (numerator, denominator) = (i128::from(base.numerator()), i128::from(base.denominator()).max(1));
    let scaled = i128::from(ticks) * numerator * 1_000_000_000;
    i64::try_from((scaled + denominator / 2).div_euclid(denominator)).unwrap_or(i64::MAX)
}

/// A rate that can be one; containers state their time base or nothing where they do not know.
pub(crate) fn sane(rate: Rational, base: Rational) -> Option<f64> {
    let fps = f64::from(rate.numerator()) / f64::from(rate.denominator());
    let ticks = f64::from(base.denominator()) / f64::from(base.numerator());
    // 1,000 frames/s in a container that counts milliseconds is no rate.
    (fps.is_finite() && (0.1..=2000.0).contains(&fps) && !(fps >= 500.0 && (fps / ticks - 1.0).abs() < 1e-6))
        .then_some(fps)
}

/// The rates of the first packets of a stream; `input` is read up to there.
pub(crate) fn sample(input: &mut Input, stream: usize, base: Rational) -> Option<Rates> {
    let mut times = Vec::new();
    let mut packet = Packet::empty();
    while times.len() < SAMPLED && packet.read(input).is_ok() {
        if packet.stream() == stream
            && let Some(ticks) = packet.pts().or_else(|| packet.dts())
        {
            times.push(nanos(ticks, base));
        }
    }
    // The last pictures may be waiting for ones that are shown before them.
    times.sort_unstable();
    if times.len() == SAMPLED {
        times.truncate(SAMPLED - 16);
    }
    Rates::of(&times)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dim_light_lowers_the_mean_but_not_the_peak() {
        let bright = (0..60).map(|i| i * 33_333_333);
        let dim = (1..=80).map(|i| 59 * 33_333_333 + i * 50_000_000);
        let rates = Rates::of(&bright.chain(dim).collect::<Vec<_>>()).unwrap();
        assert!((rates.peak - 30.0).abs() < 0.01 && rates.mean < 25.0, "{rates:?}");
        assert_eq!(Rates::of(&[5]), None);
        assert_eq!(Rates::of(&[5, 5]), None);
    }

    #[test]
    fn whole_milliseconds_have_the_rate_that_they_round() {
        let times: Vec<i64> = (0..300).map(|i| (f64::from(i) * 1000.0 / 120.0).round() as i64 * 1_000_000).collect();
        let rates = Rates::of(&times).unwrap();
        assert!((rates.peak - 120.0).abs() < 1.0 && (rates.mean - 120.0).abs() < 0.1, "{rates:?}");
    }

    #[test]
    fn a_time_base_is_no_rate() {
        let base = Rational::new(1, 1000);
        assert_eq!(sane(Rational::new(1000, 1), base), None);
        assert_eq!(sane(Rational::new(0, 0), base), None);
        assert_eq!(sane(Rational::new(25, 1), base), Some(25.0));
    }
}
