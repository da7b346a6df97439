use super::*;

#[test]
fn frames_between_are_spread_evenly_and_none_is_placed_already() {
    let placed = |every: usize| (0..100u32).step_by(every).map(|f| (f, Isometry::IDENTITY)).collect();
    let chosen = spread(100, &placed(10), 9);
    assert_eq!(chosen.len(), 9);
    assert!(chosen.iter().all(|f| f % 10 != 0), "{chosen:?}");
    let list: Vec<u32> = chosen.into_iter().collect();
    assert!(list.windows(2).all(|w| (9..=13).contains(&(w[1] - w[0]))), "{list:?}");
    // Of few frames half are left to judge by, of none there is none.
    assert_eq!(spread(100, &placed(2), 80).len(), 25);
    assert!(spread(100, &placed(1), 80).is_empty() && spread(100, &placed(10), 0).is_empty());
    assert!(spread(0, &BTreeMap::new(), 5).is_empty());
}
