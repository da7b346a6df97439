//! The capture's neutral face: what the AUs read when the face rests (trackers rarely read 0).

use risorius_formats::{AttributeSpec, Intensity};

/// The share of frames, the most neutral ones, that the neutral value is the median of.
pub const NEUTRAL_SHARE: f64 = 0.1;

/// The neutral intensity of every AU, 0–5: its median over the [`NEUTRAL_SHARE`] of frames with the smallest sum of
/// normalised intensities. `intensities[f][a]` are smoothed; `specs` give each AU's range. Zeros without frames.
pub fn neutral_intensities(intensities: &[Vec<f32>], specs: &[AttributeSpec]) -> Vec<f32> {
    let activity = |row: &Vec<f32>| -> f64 {
        let normalised =
            |(spec, v): (&AttributeSpec, &f32)| f64::from(spec.scale().attribute(Intensity(*v)).0) * 0.5 + 0.5;
        specs.iter().zip(row).filter(|(s, _)| s.active).map(normalised).sum()
    };
    let mut order: Vec<(f64, usize)> = intensities.iter().map(activity).zip(0..).collect();
    order.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let count = ((intensities.len() as f64 * NEUTRAL_SHARE).ceil() as usize).min(order.len());
    let of_unit = |unit: usize| {
        let mut values: Vec<f32> = order[..count].iter().map(|&(_, f)| intensities[f][unit]).collect();
        median(&mut values).unwrap_or(0.0)
    };
    (0..specs.len()).map(of_unit).collect()
}

/// The median; the mean of the two middle values where there are two. `None` without values.
pub fn median(values: &mut [f32]) -> Option<f32> {
    values.sort_unstable_by(f32::total_cmp);
    let middle = values.len() / 2;
    match values.len() {
        0 => None,
        n if n % 2 == 1 => Some(values[middle]),
        _ => Some(f32::midpoint(values[middle - 1], values[middle])),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use risorius_formats::ActionUnit;

    #[test]
    fn a_resting_level_is_found_below_the_moving_frames() {
        let specs = [
            AttributeSpec::from_range(ActionUnit(1), 0, 0.2, 4.0, 0.0),
            AttributeSpec::from_range(ActionUnit(12), 2, 0.5, 5.0, 0.0),
        ];
        // 20 resting frames around (0.4, 0.9), 80 with an expression.
        let mut rows: Vec<Vec<f32>> = (0..80).map(|i| vec![0.2 + i as f32 * 0.04, 5.0]).collect();
        rows.extend((0..20).map(|i| vec![0.35 + 0.005 * i as f32, 0.9]));
        let got = neutral_intensities(&rows, &specs);
        // The 10 most neutral are the first resting ones: 0.35 … 0.395.
        assert!((got[0] - 0.3725).abs() < 1e-5 && (got[1] - 0.9).abs() < 1e-6, "{got:?}");
    }

    #[test]
    fn inactive_units_do_not_decide_but_get_a_value() {
        let specs = [
            AttributeSpec::from_range(ActionUnit(1), 0, 0.0, 4.0, 0.0),
            AttributeSpec::from_range(ActionUnit(6), 1, 0.05, 0.06, 0.0),
        ];
        let rows: Vec<Vec<f32>> = (0..10).map(|i| vec![i as f32 * 0.4, 0.06 - i as f32 * 0.001]).collect();
        assert_eq!(neutral_intensities(&rows, &specs), [0.0, 0.06]);
        assert_eq!(neutral_intensities(&[], &specs), [0.0, 0.0]);
    }

    #[test]
    fn medians() {
        assert_eq!(median(&mut []), None);
        assert_eq!(median(&mut [3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(&mut [4.0, 1.0, 2.0, 3.0]), Some(2.5));
    }
}
