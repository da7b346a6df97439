use proptest::prelude::*;

use super::*;

fn facts(count: usize, fps: f64) -> Vec<Facts> {
    (0..count)
        .map(|i| {
            let secs = i as f64 / fps;
            let view = [25.0 * (secs * 0.7).sin(), 12.0 * (secs * 0.45).cos()];
            // AU 0 and 1 alone and together, AU 2 alone and with 0.
            let combination = [0b0, 0b1, 0b11, 0b10, 0b100, 0b101, 0b0][(secs as usize) % 7];
            Facts { take: 0, secs, view, combination }
        })
        .collect()
}

fn options(kind: SplitKind) -> SplitOptions {
    SplitOptions { kind, val_share: 0.1, guard_secs: 0.25 }
}

fn share(roles: &[Role], role: Role) -> f64 {
    roles.iter().filter(|r| **r == role).count() as f64 / roles.len() as f64
}

#[test]
fn time_blocks_keep_their_distance() {
    let facts = facts(2400, 120.0);
    let roles = roles(&facts, options(SplitKind::TimeBlocks));
    assert!((share(&roles, Role::Val) - 0.1).abs() < 0.01);
    for (f, _) in facts.iter().zip(&roles).filter(|(_, r)| **r == Role::Val) {
        let nearest =
            facts.iter().zip(&roles).filter(|(_, r)| **r == Role::Train).map(|(t, _)| (t.secs - f.secs).abs());
        assert!(nearest.fold(f64::INFINITY, f64::min) > 0.25);
    }
    // Two stretches of 20 s · 0.1 / 2 = 1 s.
    let starts = roles.windows(2).filter(|w| w[0] != Role::Val && w[1] == Role::Val).count();
    assert_eq!(starts, 2);
}

#[test]
fn held_out_views_are_not_seen_in_fitting() {
    let facts = facts(4800, 120.0);
    let roles = roles(&facts, options(SplitKind::Views));
    let of = |role: Role| facts.iter().zip(&roles).filter(move |(_, r)| **r == role).map(|(f, _)| f.view);
    assert!((0.02..0.3).contains(&share(&roles, Role::Val)), "{}", share(&roles, Role::Val));
    for val in of(Role::Val) {
        assert!(of(Role::Train).all(|t| (t[0] - val[0]).abs().max((t[1] - val[1]).abs()) >= RIM_DEG));
    }
}

#[test]
fn held_out_combinations_consist_of_aus_that_fitting_sees() {
    let facts = facts(8400, 120.0);
    let roles = roles(&facts, SplitOptions { val_share: 0.2, ..options(SplitKind::AuCombinations) });
    let seen = |role: Role| -> BTreeSet<u64> {
        facts.iter().zip(&roles).filter(|(_, r)| **r == role).map(|(f, _)| f.combination).collect()
    };
    let (train, val) = (seen(Role::Train), seen(Role::Val));
    assert!(!val.is_empty() && val.is_disjoint(&train) && val.iter().all(|c| c.count_ones() >= 2));
    let raised = train.iter().fold(0, |all, c| all | c);
    assert!(val.iter().all(|c| c & !raised == 0));
}

#[test]
fn splits_by_place() {
    let held = |kind, count| (0..count).filter(|&p| is_held_out(kind, p, count)).collect::<Vec<_>>();
    assert_eq!(held(SplitKind::Periodic, 45), [10, 30]);
    assert_eq!(held(SplitKind::EveryOther, 6), [1, 3]);
    assert_eq!(held(SplitKind::EveryOther, 7), [1, 3, 5]);
    assert_eq!(held(SplitKind::None, 7), [0usize; 0]);
}

proptest! {
    #[test]
    fn neighbours_in_time_are_found(times in prop::collection::vec((0usize..2, 0u32..200), 0..60), secs in 0.0f64..20.0, seed in any::<u64>()) {
        let mut facts: Vec<Facts> = times.into_iter().map(|(take, t)| Facts { take, secs: f64::from(t), view: [0.0; 2], combination: 0 }).collect();
        facts.sort_by(|a, b| a.take.cmp(&b.take).then(a.secs.total_cmp(&b.secs)));
        let marked: Vec<bool> = (0..facts.len()).map(|i| seed >> (i % 64) & 1 == 1 && i % 3 == 0).collect();
        let plain: Vec<bool> = facts.iter().map(|f| (0..facts.len()).any(|j| marked[j] && facts[j].take == f.take && (facts[j].secs - f.secs).abs() <= secs)).collect();
        prop_assert_eq!(near_in_time(&facts, &marked, secs), plain);
    }
}
