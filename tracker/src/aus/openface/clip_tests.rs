use risorius_formats::ActionUnit;

use super::*;
use crate::openface_install::wave;

const NUMBERS: usize = HOG_NUMBERS + 204 + 3;
const FRAMES: usize = 401;

fn predictor(unit: u8, purpose: Purpose, is_dynamic: bool, weights: &[(usize, f64)], constant: f64) -> Predictor {
    let mut all = vec![0.0; NUMBERS];
    for (i, w) in weights {
        all[*i] = *w;
    }
    Predictor { unit: ActionUnit(unit), purpose, is_dynamic, weights: all, constant }
}

/// Whether the person smiles in a frame: in the last third.
fn smiles(frame: usize) -> bool {
    frame % 30 >= 20
}

/// x of a person with numbers of their own at rest; a smile adds 0.3 to number 100 and 12 to number 4,600.
fn x(frame: usize) -> Vec<f32> {
    let mut x: Vec<f32> =
        (0..NUMBERS).map(|i| if i < HOG_NUMBERS { 0.2 + 0.1 * wave(i) } else { 5.0 * wave(i) } as f32).collect();
    x[7] = 0.0;
    if smiles(frame) {
        x[100] += 0.3;
        x[4600] += 12.0;
    }
    x
}

fn learn(predictors: Vec<Predictor>, lost: impl Fn(usize) -> bool) -> (ClipAus, Vec<f32>) {
    let predictors = Predictors(predictors);
    let mut statistics = ClipStatistics::of(&predictors, NUMBERS);
    let products: Vec<_> = (0..FRAMES).map(|i| statistics.push((!lost(i)).then(|| x(i)).as_deref())).collect();
    let aus = statistics.aus(products.into_iter().map(Ok)).unwrap();
    (aus, statistics.medians())
}

/// The definition, slowly: medians by sorting, one frame at a time.
fn slow(p: &Predictor, cutoff: Option<f64>) -> Vec<f64> {
    let seen: Vec<Vec<f32>> = (0..FRAMES).map(x).collect();
    let medians: Vec<f64> = (0..NUMBERS)
        .map(|i| {
            let mut values: Vec<f32> = (0..FRAMES).step_by(2).map(|f| seen[f][i]).collect();
            values.sort_unstable_by(f32::total_cmp);
            f64::from(values[values.len() / 2])
        })
        .collect();
    let y = |f: usize| {
        let x = &seen[f];
        let median = |i: usize| if p.is_dynamic { medians[i] } else { 0.0 };
        (0..NUMBERS).map(|i| (f64::from(x[i]) - median(i)) * p.weights[i]).sum::<f64>() + p.constant
    };
    let all: Vec<f64> = (0..FRAMES).map(y).collect();
    let mut sorted = all.clone();
    sorted.sort_unstable_by(f64::total_cmp);
    let rest = cutoff.map_or(0.0, |c| sorted[(FRAMES as f64 * c) as usize]);
    let clamped: Vec<f64> = all.iter().map(|v| (v - rest).clamp(0.0, 5.0)).collect();
    (0..FRAMES)
        .map(|i| if i == 0 || i == FRAMES - 1 { clamped[i] } else { clamped[i - 1..=i + 1].iter().sum::<f64>() / 3.0 })
        .collect()
}

#[test]
fn static_and_dynamic_intensities_are_those_of_the_definition() {
    let weights = [(100, 8.0), (4600, 0.05), (33, -2.0)];
    let fixed = predictor(12, Purpose::Intensity { cutoff: None }, false, &weights, 0.4);
    let dynamic = predictor(1, Purpose::Intensity { cutoff: Some(0.5) }, true, &weights, 0.7);
    let uncut = predictor(2, Purpose::Intensity { cutoff: None }, true, &weights, 0.7);
    let (aus, medians) = learn(vec![fixed.clone(), dynamic.clone(), uncut.clone()], |_| false);
    assert_eq!(medians[7], 0.0, "a number of the skin that is always 0 has no median below it");
    let of = |unit: u8, p: &Predictor, cutoff: Option<f64>| {
        let slot = OPENFACE_INTENSITIES.iter().position(|u| u.0 == unit).unwrap();
        for (i, slow) in slow(p, cutoff).into_iter().enumerate() {
            let fast = f64::from(aus.get(i).unwrap().intensities[slot].unwrap());
            // Half a bin of each number: 0.0005 × 10 and 0.006 × 0.05.
            assert!((fast - slow).abs() < 0.0056, "AU{unit} frame {i}: {fast} {slow}");
        }
        aus.get(25).unwrap().intensities[slot].unwrap()
    };
    of(12, &fixed, None);
    // 0.3 × 8 + 12 × 0.05 above rest; the bias goes with the quantile, without one it stays.
    assert!((of(1, &dynamic, Some(0.5)) - 3.0).abs() < 0.01);
    assert!((of(2, &uncut, None) - 3.7).abs() < 0.01);
    assert_eq!(aus.get(25).unwrap().intensities[2], None, "no model gives AU04");
}

#[test]
fn the_cutoff_is_a_quantile_of_the_clip() {
    // A third of the frames smile: above the 0.75 quantile nothing is left.
    let purpose = Purpose::Intensity { cutoff: Some(0.75) };
    let (aus, _) = learn(vec![predictor(1, purpose, true, &[(100, 8.0)], 0.0)], |_| false);
    assert_eq!(aus.get(25).unwrap().intensities[0], Some(0.0));
}

#[test]
fn presences_are_means_of_seven_frames_and_lost_frames_have_none() {
    let purpose = Purpose::Presence { positive: 1.0, negative: 0.0 };
    let (aus, _) = learn(vec![predictor(12, purpose, true, &[(100, 8.0)], -1.2)], |i| (40..50).contains(&i));
    let slot = OPENFACE_INTENSITIES.iter().position(|u| u.0 == 12).unwrap();
    let present = |i: usize| aus.get(i).unwrap().presences[slot];
    assert_eq!(
        (present(15), present(19), present(20), present(25), present(32)),
        (Some(false), Some(false), Some(true), Some(true), Some(false))
    );
    assert_eq!((present(45), present(FRAMES - 1)), (None, Some(false)));
    assert_eq!(aus.get(FRAMES), None);
}
