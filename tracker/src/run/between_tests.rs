use super::*;

fn observation(t: f32) -> Observation {
    Observation { points_px: [[t * t, 3.0 * t]; 68], presence: 0.9, features: vec![t, 2.0], eyes: None }
}

fn interpolated(every: u32, frames: usize, lost: &[usize]) -> Vec<(Option<Observation>, bool)> {
    let tracked: Vec<usize> = (0..frames).filter(|f| f % every as usize == 0 || f + 1 == frames).collect();
    let source = tracked.into_iter().map(|f| Ok((!lost.contains(&f)).then(|| observation(f as f32))));
    let mut between = Interpolator::new(source, every, frames);
    (0..frames).map(|_| between.next_frame().unwrap()).collect()
}

#[test]
fn with_every_frame_tracked_nothing_is_made_up() {
    for (i, (found, is_between)) in interpolated(1, 9, &[4]).into_iter().enumerate() {
        assert!(!is_between);
        assert_eq!(found, (i != 4).then(|| observation(i as f32)));
    }
}

#[test]
fn a_parabola_is_followed_between_tracked_frames() {
    for (every, frames) in [(2, 21), (3, 23), (4, 22), (7, 50), (100, 5)] {
        for (i, (found, is_between)) in interpolated(every, frames, &[]).into_iter().enumerate() {
            assert_eq!(is_between, i % every as usize != 0 && i + 1 != frames, "{every} {frames} {i}");
            let (found, truth) = (found.unwrap(), observation(i as f32));
            // Inside, where both neighbours are known, the cubic is exact; at the ends it is the chord's.
            let inside = i >= every as usize && i + (2 * every as usize) < frames;
            let tolerance = if inside { 1e-2 * truth.points_px[0][0].max(1.0) } else { 0.3 * (every * every) as f32 };
            assert!((found.points_px[0][0] - truth.points_px[0][0]).abs() <= tolerance, "{every} {frames} {i}");
            assert!((found.points_px[0][1] - truth.points_px[0][1]).abs() < 1e-2);
            assert!((found.features[0] - i as f32).abs() < 1e-2);
        }
    }
}

#[test]
fn a_face_seen_on_one_side_only_is_not_made_up() {
    let all = interpolated(4, 17, &[8]);
    let there: Vec<bool> = all.iter().map(|(o, _)| o.is_some()).collect();
    let expected: Vec<bool> = (0..17).map(|f| !(5..12).contains(&f)).collect();
    assert_eq!(there, expected);
}

#[test]
fn scores_are_means_of_three_frames_where_all_three_are_known() {
    let source = (0..5).map(|f| Ok((f != 3).then(|| observation((f * f) as f32))));
    let mut smoothed = Smoothed::new(Interpolator::new(source, 1, 5), 1);
    let found: Vec<Option<Observation>> = (0..5).map(|_| smoothed.next_frame().unwrap().0).collect();
    let first = |o: &Option<Observation>| o.as_ref().map(|o| o.features[0]);
    assert_eq!(found.iter().map(first).collect::<Vec<_>>(), [Some(0.5), Some(5.0 / 3.0), Some(2.5), None, Some(16.0)]);
    assert_eq!(found[1].as_ref().unwrap().points_px, observation(1.0).points_px, "points stay as they are");
    assert_eq!(found[1].as_ref().unwrap().features[1], 2.0);
}
