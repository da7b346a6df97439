//! Savitzky–Golay smoothing of AU intensities, segment by segment (paper §III-A; fact sheet §7.1, §8.17).
//!
//! A window of `w` samples is fitted with a polynomial; the fitted value replaces the sample in the middle. At both
//! ends the polynomial of the first (last) full window is evaluated, as SciPy's mode `interp` does: nothing is padded.

use nalgebra::DMatrix;

/// The duration of the window, seconds: a blink lasts 0.1–0.4 s, and a longer window flattens AU45.
pub const WINDOW_SECS: f64 = 0.125;
/// The order of the fitted polynomial.
pub const ORDER: usize = 3;

/// The odd window for a frame rate: `WINDOW_SECS` long, but never too short for the polynomial to smooth.
pub fn window_for(fps: f64) -> usize {
    let wanted = if fps.is_finite() { (WINDOW_SECS * fps).round().clamp(0.0, 1e6) as usize } else { 0 };
    let odd = if wanted % 2 == 1 { wanted } else { wanted + 1 };
    odd.max(ORDER + 2)
}

/// The matrix that takes a window's samples to its fitted values: row `i` gives the value at sample `i`.
fn hat_matrix(window: usize, order: usize) -> DMatrix<f64> {
    let half = (window / 2) as f64;
    // Positions scaled to −1..1 keep the powers comparable; the projection does not depend on the scale.
    let x = |i: usize| (i as f64 - half) / half.max(1.0);
    let powers = DMatrix::from_fn(window, order + 1, |i, p| x(i).powi(p as i32));
    let q = powers.qr().q();
    &q * q.transpose()
}

/// Smooths evenly spaced samples; as many come back. Runs too short for a polynomial of the order come back as they are.
///
/// An even window is taken one longer; a window longer than the samples shrinks to the largest odd one that fits.
pub fn savgol(samples: &[f64], window: usize, order: usize) -> Vec<f64> {
    let n = samples.len();
    let largest = if n % 2 == 1 { n } else { n.saturating_sub(1) };
    let window = (window | 1).min(largest);
    if window <= order || window < 3 {
        return samples.to_vec();
    }
    let hat = hat_matrix(window, order);
    let half = window / 2;
    let fitted = |start: usize, row: usize| -> f64 {
        samples[start..start + window].iter().enumerate().map(|(j, v)| hat[(row, j)] * v).sum()
    };
    (0..n)
        .map(|i| {
            let start = i.saturating_sub(half).min(n - window);
            fitted(start, i - start)
        })
        .collect()
}

/// Smooths every run of `segments` (index ranges into `values`) for itself and clips to the 0–5 scale, because a
/// fitted polynomial may leave it. Samples outside the segments come back untouched.
pub fn smooth_segments(values: &[f64], segments: &[std::ops::Range<usize>], window: usize) -> Vec<f64> {
    let max = f64::from(risorius_formats::au::MAX_INTENSITY);
    let mut result = values.to_vec();
    for segment in segments {
        for (out, v) in result[segment.clone()].iter_mut().zip(savgol(&values[segment.clone()], window, ORDER)) {
            *out = v.clamp(0.0, max);
        }
    }
    result
}

#[cfg(test)]
#[path = "smooth_tests.rs"]
mod tests;
