use proptest::prelude::*;

use super::*;

/// `scipy.signal.savgol_filter(x, window, 3)` with its default mode `interp`; made by `tests/golden/savgol.py`.
const GOLDEN: &str = include_str!("../tests/golden/savgol.csv");

fn numbers(line: &str) -> Vec<f64> {
    line.split(',').map(|v| v.trim().parse().unwrap()).collect()
}

#[test]
fn it_agrees_with_scipy() {
    let lines: Vec<_> = GOLDEN.lines().filter(|l| !l.starts_with('#') && !l.is_empty()).collect();
    let x = numbers(lines[0]);
    assert_eq!(x.len(), 40);
    let mut cases = 0;
    for line in &lines[1..] {
        let (window, values) = line.split_once(':').unwrap();
        let expected = numbers(values);
        let got = smooth_run(&x, window.trim().parse().unwrap(), ORDER);
        for (i, (a, b)) in got.iter().zip(&expected).enumerate() {
            assert!((a - b).abs() < 1e-10, "window {window}, sample {i}: {a} and {b}");
        }
        cases += 1;
    }
    assert!(cases >= 4);
}

#[test]
fn short_segments_and_gaps() {
    for n in 0..5 {
        let samples: Vec<_> = (0..n).map(|i| f64::from(i * i)).collect();
        assert_eq!(smooth_run(&samples, 15, 3), samples);
    }
    // A step between two segments stays a step: nothing is filtered across the gap.
    let values: Vec<_> = (0..40).map(|i| if i < 20 { 1.0 } else { 4.0 }).collect();
    let apart = smooth_segments(&values, &[0..20, 20..40], 15);
    assert!(apart.iter().zip(&values).all(|(a, b)| (a - b).abs() < 1e-12));
    let joined = smooth_segments(&values, std::slice::from_ref(&(0..40)), 15);
    assert!((joined[20] - 4.0).abs() > 0.1);
}

#[test]
fn overshoot_is_clipped_and_nan_stays_outside() {
    let mut values = vec![0.0; 30];
    values[15..20].fill(5.0);
    values[29] = f64::NAN;
    let got = smooth_segments(&values, std::slice::from_ref(&(0..29)), 9);
    assert!(got[..29].iter().all(|v| (0.0..=5.0).contains(v)) && got[29].is_nan());
}

proptest! {
    #[test]
    fn noise_shrinks(seed in 0u64..1000) {
        let mut s = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
        let noise: Vec<f64> = (0..200).map(|_| { s ^= s << 13; s ^= s >> 7; s ^= s << 17; (s % 1000) as f64 / 500.0 - 1.0 }).collect();
        let power = |v: &[f64]| v.iter().map(|x| x * x).sum::<f64>();
        // The interior of a 15-point cubic filter keeps about 0.15 of the power of white noise.
        prop_assert!(power(&smooth_run(&noise, 15, 3)[7..193]) < 0.4 * power(&noise[7..193]));
    }
}
