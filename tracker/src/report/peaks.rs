//! Which frames of a take are shown as pictures: peaks of an AU, and the face at rest.

/// Up to `count` peaks of a curve, the highest first: local maxima of at least `at_least`, `apart_secs` away from each other.
///
/// `values` and `seconds` have one entry per frame.
pub fn peaks(values: &[Option<f32>], seconds: &[f64], count: usize, apart_secs: f64, at_least: f32) -> Vec<usize> {
    let is_peak = |i: usize| {
        let value = values[i].filter(|v| v.is_finite() && *v >= at_least)?;
        let neighbours = [i.checked_sub(1), Some(i + 1)];
        let rises_above = |n: &usize| values.get(*n).copied().flatten().is_none_or(|v| v <= value);
        neighbours.iter().flatten().all(rises_above).then_some((i, value))
    };
    let mut candidates: Vec<(usize, f32)> = (0..values.len().min(seconds.len())).filter_map(is_peak).collect();
    candidates.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    let mut chosen: Vec<usize> = Vec::new();
    for (frame, _) in candidates {
        if chosen.len() == count {
            break;
        }
        if chosen.iter().all(|c| (seconds[*c] - seconds[frame]).abs() >= apart_secs) {
            chosen.push(frame);
        }
    }
    chosen
}

/// The frame in which the sum of all AUs is smallest; `curves` holds one curve per AU.
pub fn rest(curves: &[Vec<Option<f32>>]) -> Option<usize> {
    let frames = curves.iter().map(Vec::len).min()?;
    let sum = |i: usize| {
        let mut known = curves.iter().filter_map(|c| c[i]).peekable();
        known.peek()?;
        Some((i, known.sum::<f32>()))
    };
    (0..frames).filter_map(sum).min_by(|a, b| a.1.total_cmp(&b.1)).map(|(i, _)| i)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn peaks_are_local_maxima_apart_from_each_other() {
        let seconds: Vec<f64> = (0..200).map(|i| f64::from(i) * 0.1).collect();
        // Hills of 4, 3 and 0.1 at 3 s, 10 s and 15 s, and a shoulder of the first at 4.2 s.
        let hill = |t: f64, at: f64, high: f64| high * (-(t - at).powi(2) / 0.5).exp();
        let value = |t: f64| hill(t, 3.0, 4.0) + hill(t, 4.2, 0.2) + hill(t, 10.0, 3.0) + hill(t, 15.0, 0.1);
        let mut values: Vec<Option<f32>> = seconds.iter().map(|t| Some(value(*t) as f32)).collect();
        values[50] = None;
        assert_eq!(peaks(&values, &seconds, 3, 1.0, 0.3), [30, 100]);
        assert_eq!(peaks(&values, &seconds, 1, 1.0, 0.3), [30]);
        assert!(peaks(&values, &seconds, 3, 1.0, 4.5).is_empty());
    }

    #[test]
    fn rest_is_where_all_aus_are_low() {
        let curves = [vec![Some(0.0), Some(0.2), None], vec![Some(2.0), Some(0.1), None]];
        assert_eq!(rest(&curves), Some(1));
        assert_eq!(rest(&[]), None);
        assert_eq!(rest(&[vec![None]]), None);
    }
}
