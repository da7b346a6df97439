//! Savitzky–Golay smoothing of AU intensities, segment by segment (paper §III-A; fact sheet §7.1, §8.17).

use risorius_formats::smooth::{ORDER, smooth_run};

/// Smooths every run of `segments` (index ranges into `values`) for itself and clips to the 0–5 scale, because a
/// fitted polynomial may leave it. Samples outside the segments come back untouched.
pub fn smooth_segments(values: &[f64], segments: &[std::ops::Range<usize>], window: usize) -> Vec<f64> {
    let max = f64::from(risorius_formats::au::MAX_INTENSITY);
    let mut result = values.to_vec();
    for segment in segments {
        for (out, v) in result[segment.clone()].iter_mut().zip(smooth_run(&values[segment.clone()], window, ORDER)) {
            *out = v.clamp(0.0, max);
        }
    }
    result
}

#[cfg(test)]
#[path = "smooth_tests.rs"]
mod tests;
