//! Savitzky–Golay smoothing of AU curves, within runs of frames that have a value (paper §III-A; fact sheet §7.1, §8.17).
//!
//! One definition for building datasets and for transferring expressions: an AU curve means the same in both.

/// The duration of the window, seconds: a blink lasts 0.1–0.4 s, and a longer window flattens AU45.
pub const WINDOW_SECS: f64 = 0.125;
/// The order of the fitted polynomial.
pub const ORDER: usize = 3;

/// The odd window for a frame rate: [`WINDOW_SECS`] long, but never too short for the polynomial to smooth.
pub fn window_for_fps(fps: f64) -> usize {
    let frames = if fps.is_finite() { (WINDOW_SECS * fps).round().clamp(0.0, 1e6) as usize } else { 0 };
    (frames | 1).max(ORDER + 2)
}

/// Smooths every run of values by itself; gaps stay gaps and nothing is filtered across them. A value that is no finite
/// number is a gap as well, or it would spoil its whole window.
///
/// A run shorter than `window` takes the largest odd window that fits; runs too short for `order` are kept as they are.
pub fn smooth_segments(values: &[Option<f32>], window: usize, order: usize) -> Vec<Option<f32>> {
    let mut out = values.to_vec();
    let mut start = 0;
    while start < values.len() {
        let len = values[start..].iter().take_while(|v| v.is_some_and(f32::is_finite)).count();
        if len > 0 {
            let run: Vec<f64> = values[start..start + len].iter().flatten().map(|&v| f64::from(v)).collect();
            for (slot, value) in out[start..start + len].iter_mut().zip(smooth_run(&run, window, order)) {
                *slot = Some(value as f32);
            }
        }
        start += len.max(1);
    }
    out
}

/// Smooths one run: least-squares polynomials over a sliding window, at the ends the polynomial of the first and last
/// whole window ("interp" in SciPy). Values that are polynomials of `order` come out unchanged.
///
/// An even window is taken one longer; a window longer than the run shrinks to the largest odd one that fits.
pub fn smooth_run(values: &[f64], window: usize, order: usize) -> Vec<f64> {
    let n = values.len();
    let fitting = (window | 1).min(if n % 2 == 1 { n } else { n.saturating_sub(1) });
    if fitting < 3 || fitting <= order {
        return values.to_vec();
    }
    let half = fitting / 2;
    // One row of coefficients per place of the asked point inside the window.
    let rows: Vec<Vec<f64>> = (0..fitting).map(|at| coefficients(fitting, order, at)).collect();
    let dot = |start: usize, at: usize| rows[at].iter().zip(&values[start..]).map(|(c, v)| c * v).sum();
    (0..n)
        .map(|i| {
            let start = i.saturating_sub(half).min(n - fitting);
            dot(start, i - start)
        })
        .collect()
}

/// Weights whose dot product with a window's values is the fitted polynomial at index `at`.
///
/// Built from discrete orthogonal polynomials (Gram–Schmidt on 1, t, t², …, twice for full precision), which avoids the
/// ill-conditioned normal equations.
fn coefficients(window: usize, order: usize, at: usize) -> Vec<f64> {
    let half = (window as f64 - 1.0) / 2.0;
    let t: Vec<f64> = (0..window).map(|i| (i as f64 - half) / half.max(1.0)).collect();
    let mut basis: Vec<Vec<f64>> = Vec::with_capacity(order + 1);
    for power in 0..=order {
        let mut p: Vec<f64> = t.iter().map(|t| t.powi(power as i32)).collect();
        for _ in 0..2 {
            for q in &basis {
                let projection: f64 = p.iter().zip(q).map(|(a, b)| a * b).sum();
                for (a, b) in p.iter_mut().zip(q) {
                    *a -= projection * b;
                }
            }
        }
        let norm = p.iter().map(|a| a * a).sum::<f64>().sqrt();
        for a in &mut p {
            *a /= norm;
        }
        basis.push(p);
    }
    (0..window).map(|i| basis.iter().map(|q| q[at] * q[i]).sum()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_classic_5_point_quadratic_weights() {
        let expected = [-3.0, 12.0, 17.0, 12.0, -3.0].map(|v| v / 35.0);
        for (got, want) in coefficients(5, 2, 2).iter().zip(expected) {
            assert!((got - want).abs() < 1e-14);
        }
    }

    #[test]
    fn windows_are_odd_and_an_eighth_of_a_second_or_just_enough_to_smooth() {
        for (fps, window) in [(120.0, 15), (60.0, 9), (30.0, 5), (24.0, 5), (240.0, 31), (0.0, 5), (f64::NAN, 5)] {
            assert_eq!(window_for_fps(fps), window, "{fps}");
        }
    }

    #[test]
    fn gaps_are_not_filtered_across() {
        let mut values: Vec<Option<f32>> = (0..40).map(|i| Some(if i < 20 { 0.0 } else { 5.0 })).collect();
        values[20] = None;
        let smooth = smooth_segments(&values, 15, ORDER);
        assert_eq!(smooth[20], None);
        assert!(smooth[..20].iter().all(|v| v.unwrap().abs() < 1e-6));
        assert!(smooth[21..].iter().all(|v| (v.unwrap() - 5.0).abs() < 1e-5));
        assert_eq!(smooth_segments(&[Some(1.0), Some(4.0), None], 15, 3), [Some(1.0), Some(4.0), None]);
    }

    proptest! {
        #[test]
        fn cubics_pass_unchanged_ends_included(c in prop::array::uniform4(-1f64..1.0), n in 5usize..60, window in 2usize..15) {
            let values: Vec<f64> = (0..n).map(|i| { let t = i as f64 / 10.0; c[0] + t * (c[1] + t * (c[2] + t * c[3])) }).collect();
            for (got, want) in smooth_run(&values, window * 2 + 1, ORDER).iter().zip(&values) {
                prop_assert!((got - want).abs() < 1e-9, "{got} {want}");
            }
        }
    }
}
