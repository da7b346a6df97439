use super::*;

/// People's resting scores vary by about 1, and the video's noise is 0.1.
fn readout() -> &'static Readout {
    let prior_deviation = [1.0, 0.5, 0.5, 0.3, 0.3, 0.3].repeat(UNITS);
    Box::leak(Box::new(Readout {
        parts: vec![],
        gain: vec![2.0; UNITS],
        threshold: vec![0.2; UNITS],
        presence: vec![1.0; UNITS],
        prior_mean: vec![0.0; UNITS * POSE_TERMS],
        prior_deviation,
        noise: vec![0.1; UNITS],
    }))
}

/// A video of a person with resting scores of their own who turns the head and shows AU `shown` in `share` of the frames.
fn video(frames: usize, shown: usize, share: f64) -> Vec<([f32; FEATURES], bool)> {
    (0..frames)
        .map(|i| {
            let t = i as f64;
            let (yaw, pitch) = (0.5 * (t * 0.013).sin(), 0.2 * (t * 0.021).cos());
            let active = (t * 0.01).fract() < share;
            let mut frame = [0.0; FEATURES];
            for (j, value) in frame[..UNITS].iter_mut().enumerate() {
                let rest = 0.8 - 0.1 * j as f64 + 0.6 * yaw - 0.4 * pitch + 0.3 * yaw * yaw;
                let expression = if active && j == shown { 2.0 } else { 0.0 };
                *value = (rest + expression + 0.05 * (t * (1.7 + j as f64)).sin()) as f32;
            }
            frame[UNITS] = yaw as f32;
            frame[UNITS + 1] = pitch as f32;
            (frame, active)
        })
        .collect()
}

/// Mean intensity of `shown` in active and in resting frames, and of all the others.
fn measure(person: &mut Person, video: &[([f32; FEATURES], bool)], shown: usize) -> [f64; 3] {
    let (mut sums, mut counts) = ([0.0; 3], [0.0; 3]);
    for (frame, active) in video {
        let units = person.units(frame).unwrap();
        assert_eq!(units.presences[shown], units.intensities[shown] >= 1.0);
        for (j, v) in units.intensities.iter().enumerate() {
            let kind = if j == shown { usize::from(!active) } else { 2 };
            sums[kind] += f64::from(*v);
            counts[kind] += 1.0;
        }
    }
    [0, 1, 2].map(|i| sums[i] / f64::max(counts[i], 1.0))
}

#[test]
fn the_rest_of_a_person_who_turns_and_smiles_is_found() {
    // Shown in a tenth of the frames, in a third, and most of the time.
    for (share, at_least) in [(0.1, 3.3), (0.35, 3.2), (0.55, 2.5)] {
        let video = video(1500, 8, share);
        let frames: Vec<_> = video.iter().map(|f| f.0).collect();
        let mut person = Person::learn(readout(), &frames, Calibration::WholeVideo);
        let [active, resting, others] = measure(&mut person, &video, 8);
        assert!(active > at_least && resting < 0.1 && others < 0.02, "{share}: {active} {resting} {others}");
    }
}

#[test]
fn online_it_is_nearly_as_good_after_a_while() {
    let video = video(3000, 8, 0.2);
    let mut person = Person::learn(readout(), &[], Calibration::Online);
    measure(&mut person, &video[..1500], 8);
    let [active, resting, others] = measure(&mut person, &video[1500..], 8);
    assert!(active > 3.2 && resting < 0.1 && others < 0.02, "{active} {resting} {others}");
}

#[test]
fn without_frames_people_in_general_are_assumed() {
    let mut person = Person::learn(readout(), &[], Calibration::WholeVideo);
    let units = person.units(&[1.2; FEATURES]).unwrap();
    assert!((units.intensities[0] - 2.0).abs() < 1e-5, "{units:?}");
    assert!(person.units(&[1.0; 3]).is_none());
}

#[test]
fn what_is_remembered_stays_spread_over_all_that_was_seen() {
    let mut memory = Memory { frames: Vec::new(), seen: 0, step: 1 };
    for i in 0..5000 {
        memory.push(&[i as f32; FEATURES]);
    }
    assert!(memory.frames.len() < REMEMBERED && memory.frames.len() > REMEMBERED / 3);
    let gaps: Vec<f32> = memory.frames.windows(2).map(|w| w[1][0] - w[0][0]).collect();
    assert!(gaps.iter().all(|g| *g == gaps[0]), "{gaps:?}");
}
