use proptest::prelude::*;

use super::*;

#[test]
fn intensities_round_to_levels() {
    for (intensity, level) in
        [(0.0, 0), (0.49, 0), (0.5, 1), (1.49, 1), (4.5, 5), (5.0, 5), (7.0, 5), (-1.0, 0), (f32::NAN, 0)]
    {
        assert_eq!(level_of(intensity, 6), level, "{intensity}");
    }
    assert_eq!((level_of(2.4, 11), level_of(2.5, 11), level_of(3.0, 1)), (5, 5, 0));
}

#[test]
fn ranks_are_the_papers_formula() {
    for (n, k) in [(10, 3), (7, 7), (100, 9), (5, 1), (3, 8)] {
        let expected: Vec<_> =
            (0..k.min(n)).map(|i| ((i as f64 + 0.5) * n as f64 / k.min(n) as f64).floor() as usize).collect();
        assert_eq!(spread(n, k), expected);
    }
    assert_eq!((spread(0, 4), spread(4, 0)), (vec![], vec![]));
}

#[test]
fn small_blocks_come_first_ties_by_unit_then_falling_level() {
    // Two AUs over six candidates.
    let levels_of: Vec<Vec<usize>> =
        [[0, 0], [0, 1], [0, 2], [1, 2], [1, 0], [0, 0]].iter().map(|l| l.to_vec()).collect();
    let order: Vec<_> =
        blocks(&levels_of, &[true, true], 6).iter().map(|b| (b.unit, b.level, b.members.len())).collect();
    assert_eq!(order, [(1, 1, 1), (0, 1, 2), (1, 2, 2), (1, 0, 3), (0, 0, 4)]);
    assert!(blocks(&levels_of, &[true, false], 6).iter().all(|b| b.unit == 0));
}

#[test]
fn rare_intensities_survive_where_uniform_sampling_loses_them() {
    // 1000 neutral frames and 10 of each rare level.
    let mut levels_of = vec![vec![0]; 1000];
    for level in 1..6 {
        levels_of.extend(vec![vec![level]; 10]);
    }
    let count = |chosen: &[usize], level: usize| chosen.iter().filter(|&&c| levels_of[c][0] == level).count();
    let balanced = select_balanced(&levels_of, &[true], 60, BalanceOptions::default());
    assert_eq!((1..6).map(|l| count(&balanced, l)).collect::<Vec<_>>(), [10; 5]);
    let uniform = select_uniform(levels_of.len(), 60);
    assert!((1..6).all(|l| count(&uniform, l) <= 1));
}

fn candidates() -> impl Strategy<Value = (Vec<Vec<usize>>, Vec<bool>)> {
    (1usize..5).prop_flat_map(|units| {
        let row = prop::collection::vec(prop_oneof![4 => Just(0usize), 1 => 0usize..6], units);
        (prop::collection::vec(row, 0..120), prop::collection::vec(any::<bool>(), units))
    })
}

fn options() -> impl Strategy<Value = BalanceOptions> {
    let quota = prop_oneof![Just(Quota::Running), Just(Quota::Fixed), Just(Quota::Ceiling)];
    (any::<bool>(), quota).prop_map(|(count_existing, quota)| BalanceOptions { levels: 6, quota, count_existing })
}

#[test]
fn quotas_share_the_budget_as_they_say() {
    // Blocks of 2, 6 and 100 frames of one AU.
    let levels_of: Vec<Vec<usize>> =
        [(2, 2), (1, 6), (0, 100)].into_iter().flat_map(|(level, n)| vec![vec![level]; n]).collect();
    let counts = |quota, target| {
        let options = BalanceOptions { quota, ..BalanceOptions::default() };
        let chosen = select_balanced(&levels_of, &[true], target, options);
        [2, 1, 0].map(|l| chosen.iter().filter(|&&c| levels_of[c][0] == l).count())
    };
    // 12: a third is 4; what the smallest leaves goes to both others, or to the fill.
    assert_eq!(counts(Quota::Running, 12), [2, 5, 5]);
    assert_eq!(counts(Quota::Ceiling, 12), [2, 5, 5]);
    let fixed = counts(Quota::Fixed, 12);
    assert_eq!((fixed[0], fixed.iter().sum::<usize>()), (2, 12));
    assert!(fixed[1] == 4 && fixed[2] == 6, "{fixed:?}");
    // A ceiling below 1 is 1; larger than all blocks it takes everything.
    assert_eq!(counts(Quota::Ceiling, 2), [1, 1, 0]);
    assert_eq!(counts(Quota::Ceiling, 500), [2, 6, 100]);
}

#[test]
fn levels_of_the_own_range_use_all_of_it() {
    let spec = AttributeSpec::from_range(risorius_formats::ActionUnit(12), 0, 0.5, 2.5, 0.5);
    let level = |v: f32, bins| levels_of_frame(&[v], std::slice::from_ref(&spec), 6, bins)[0];
    assert_eq!([0.5, 1.4, 2.5].map(|v| level(v, Bins::Range)), [0, 2, 5]);
    assert_eq!([0.5, 1.4, 2.5].map(|v| level(v, Bins::Scale)), [1, 1, 3]);
    assert_eq!(level(f32::NAN, Bins::Range), 0);
}

proptest! {
    #[test]
    fn exactly_as_many_as_asked_ascending_and_distinct((levels_of, active) in candidates(), target in 0usize..150, options in options()) {
        let chosen = select_balanced(&levels_of, &active, target, options);
        prop_assert_eq!(chosen.len(), target.min(levels_of.len()));
        prop_assert!(chosen.windows(2).all(|w| w[0] < w[1]) && chosen.iter().all(|&c| c < levels_of.len()));
    }

    #[test]
    fn blocks_within_their_quota_are_taken_whole((levels_of, active) in candidates(), target in 1usize..150) {
        let chosen = select_balanced(&levels_of, &active, target, BalanceOptions::default());
        let blocks = blocks(&levels_of, &active, 6);
        // The running quota never falls below the first one, which is what every block gets at least.
        let first_quota = if blocks.is_empty() { 0 } else { target / blocks.len() };
        for block in blocks.iter().filter(|b| b.members.len() <= first_quota) {
            prop_assert!(block.members.iter().all(|c| chosen.binary_search(c).is_ok()), "{:?}", block);
        }
    }
}
