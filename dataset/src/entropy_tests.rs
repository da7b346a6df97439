use proptest::prelude::*;

use super::*;

fn plain(levels: &[usize]) -> Seen<'_> {
    Seen { levels, cell: [0, 0], take: 0, secs: 0.0, sharpness: None }
}

/// J · N without its constant, from its definition.
fn objective(seen: &[Seen<'_>], active: &[bool], chosen: &[usize], options: EntropyOptions) -> f64 {
    let n = chosen.len() as f64;
    let share = |keys: Vec<i64>, all: Vec<i64>| {
        let distinct: std::collections::BTreeSet<i64> = all.into_iter().collect();
        if distinct.len() < 2 {
            return 0.0;
        }
        let entropy: f64 = distinct
            .iter()
            .map(|k| keys.iter().filter(|q| *q == k).count() as f64 / n)
            .filter(|p| *p > 0.0)
            .map(|p| -p * p.ln())
            .sum();
        entropy / (distinct.len() as f64).ln()
    };
    let term = |key: &dyn Fn(&Seen<'_>) -> i64| {
        share(chosen.iter().map(|&c| key(&seen[c])).collect(), seen.iter().map(key).collect())
    };
    let units: Vec<usize> = (0..active.len()).filter(|&a| active[a]).collect();
    let aus: f64 = units.iter().map(|&a| term(&|s| s.levels[a] as i64)).sum::<f64>() / units.len().max(1) as f64;
    let view = term(&|s| i64::from(s.cell[0]) * 1000 + i64::from(s.cell[1]));
    let time = term(&|s| (s.secs / options.slot_secs).floor() as i64);
    let ranks = sharpness_ranks(seen);
    let sharp: f64 = chosen.iter().map(|&c| ranks[c]).sum::<f64>() / n;
    aus + options.view_weight * view + options.time_weight * time + options.sharp_weight * sharp
}

#[test]
fn rare_levels_rare_views_and_sharp_frames_are_taken() {
    let neutral = [0usize];
    let raised = [4usize];
    let mut seen: Vec<Seen<'_>> = (0..100).map(|i| Seen { secs: f64::from(i), ..plain(&neutral) }).collect();
    seen[17].levels = &raised;
    seen[40].cell = [3, 0];
    let chosen = select(&seen, &[true], 10, EntropyOptions::default());
    assert!(chosen.contains(&17) && chosen.contains(&40) && chosen.len() == 10);
    // Of two that are alike but for their sharpness, the sharper one.
    let mut twins: Vec<Seen<'_>> = vec![plain(&neutral); 6];
    twins[4].sharpness = Some(9.0);
    twins[5].sharpness = Some(1.0);
    assert_eq!(select(&twins, &[true], 1, EntropyOptions::default()), [4]);
}

#[test]
fn ranks_are_within_a_take_and_unknown_is_in_the_middle() {
    let levels = [0usize];
    let with = |take, sharpness| Seen { take, sharpness, ..plain(&levels) };
    let seen = [
        with(0, Some(5.0)),
        with(0, Some(1.0)),
        with(0, Some(5.0)),
        with(1, Some(100.0)),
        with(1, Some(200.0)),
        with(1, None),
        with(1, Some(f32::NAN)),
    ];
    assert_eq!(sharpness_ranks(&seen), [0.5, 0.0, 0.5, 0.0, 1.0, 0.5, 0.5]);
}

#[test]
fn options_out_of_range_are_refused() {
    assert!(EntropyOptions::default().check().is_ok());
    for bad in [
        EntropyOptions { view_weight: -1.0, ..EntropyOptions::default() },
        EntropyOptions { sharp_weight: f64::NAN, ..EntropyOptions::default() },
        EntropyOptions { slot_secs: 0.0, ..EntropyOptions::default() },
    ] {
        assert!(bad.check().is_err());
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// The heap gives what trying every candidate at every step gives.
    #[test]
    fn the_heap_is_the_plain_greedy_choice(
        rows in prop::collection::vec((prop::collection::vec(0usize..4, 2), -2i32..3, 0u8..8, prop::option::of(0f32..9.0)), 1..40),
        target in 0usize..45,
    ) {
        let seen: Vec<Seen<'_>> = rows
            .iter()
            .map(|(levels, yaw, t, sharpness)| Seen { levels, cell: [*yaw, 0], take: 0, secs: f64::from(*t), sharpness: *sharpness })
            .collect();
        let options = EntropyOptions { slot_secs: 1.0, ..EntropyOptions::default() };
        let active = [true, true];
        let got = select(&seen, &active, target, options);
        prop_assert_eq!(got.len(), target.min(seen.len()));
        prop_assert!(got.windows(2).all(|w| w[0] < w[1]));
        let bins = bins(&seen, &active, options);
        let mut counts = vec![0usize; bins.weights.len()];
        let mut left: Vec<usize> = (0..seen.len()).collect();
        let mut plain = Vec::new();
        while plain.len() < target && !left.is_empty() {
            let gain = |c: usize| bins.own[c] - bins.of[c * bins.width..][..bins.width].iter().map(|&b| bins.weights[b as usize] * step(counts[b as usize])).sum::<f64>();
            let best = left.iter().copied().reduce(|a, b| if gain(b) > gain(a) { b } else { a }).unwrap();
            left.retain(|&c| c != best);
            bins.of[best * bins.width..][..bins.width].iter().for_each(|&b| counts[b as usize] += 1);
            plain.push(best);
        }
        plain.sort_unstable();
        prop_assert_eq!(got, plain);
    }

    /// What a frame adds to `Σ c ln c` is what the objective's definition says.
    #[test]
    fn the_bins_add_up_to_the_objective(
        rows in prop::collection::vec((prop::collection::vec(0usize..3, 2), -2i32..3, 0u8..4), 4..20),
        take in 2usize..4,
    ) {
        let seen: Vec<Seen<'_>> = rows.iter().map(|(levels, yaw, t)| Seen { levels, cell: [*yaw, 0], take: 0, secs: f64::from(*t), sharpness: None }).collect();
        let options = EntropyOptions { slot_secs: 1.0, ..EntropyOptions::default() };
        let active = [true, true];
        let bins = bins(&seen, &active, options);
        let of_bins = |chosen: &[usize]| {
            let mut counts = vec![0usize; bins.weights.len()];
            for &c in chosen {
                bins.of[c * bins.width..][..bins.width].iter().for_each(|&b| counts[b as usize] += 1);
            }
            let n = chosen.len() as f64;
            let own: f64 = chosen.iter().map(|&c| bins.own[c]).sum::<f64>() / n;
            own - counts.iter().zip(&bins.weights).map(|(&c, w)| w * (0..c).map(step).sum::<f64>()).sum::<f64>() / n
        };
        // Two choices of one size: their differences agree, the constant falls out.
        let (a, b): (Vec<usize>, Vec<usize>) = ((0..take).collect(), (seen.len() - take..seen.len()).collect());
        let expected = objective(&seen, &active, &a, options) - objective(&seen, &active, &b, options);
        prop_assert!((of_bins(&a) - of_bins(&b) - expected).abs() < 1e-9);
    }
}
