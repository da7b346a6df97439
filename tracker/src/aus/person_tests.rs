use super::*;
use crate::aus::readout::Part;

fn readout() -> &'static Readout {
    Box::leak(Box::new(Readout {
        skin: Part::default(),
        points: [const { Part { weights: Vec::new(), scales: Vec::new() } }; 3],
        share: vec![0.5; UNITS],
        gain: vec![2.0; UNITS],
        presence: vec![1.0; UNITS],
        reliability: vec![0.8; UNITS],
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
            for (k, value) in frame[..SCORES].iter_mut().enumerate() {
                let rest = 40.0 - 0.1 * k as f64 + 0.6 * yaw - 0.4 * pitch + 0.1 * yaw * yaw;
                let expression = if active && k % UNITS == shown { 2.0 } else { 0.0 };
                *value = (rest + expression + 0.05 * (t * (1.7 + k as f64)).sin()) as f32;
            }
            frame[YAW] = yaw as f32;
            frame[PITCH] = pitch as f32;
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
    // No prior says where rest lies, so that it has to be shown in most of the frames: in 90 % of them, and in 65 %.
    for (share, at_least) in [(0.1, 3.7), (0.35, 3.6)] {
        let video = video(1500, 8, share);
        let frames: Vec<_> = video.iter().map(|f| f.0).collect();
        let mut person = Person::learn(readout(), &frames, Calibration::WholeVideo);
        let [active, resting, others] = measure(&mut person, &video, 8);
        assert!(active > at_least && resting < 0.15 && others < 0.1, "{share}: {active} {resting} {others}");
    }
}

#[test]
fn online_it_is_nearly_as_good_after_a_while() {
    let video = video(3000, 8, 0.2);
    let mut person = Person::learn(readout(), &[], Calibration::Online);
    measure(&mut person, &video[..1500], 8);
    let [active, resting, others] = measure(&mut person, &video[1500..], 8);
    assert!(active > 3.6 && resting < 0.15 && others < 0.1, "{active} {resting} {others}");
}

#[test]
fn without_frames_nothing_is_known_and_the_first_live_frame_is_rest() {
    let mut person = Person::learn(readout(), &[], Calibration::WholeVideo);
    assert!(person.units(&[1.2; FEATURES]).is_none());
    let mut person = Person::learn(readout(), &[], Calibration::Online);
    assert_eq!(person.units(&[1.2; FEATURES]).unwrap().intensities, [0.0; UNITS]);
    assert!(person.units(&[1.0; 3]).is_none());
}

#[test]
fn confidence_is_high_where_both_readouts_see_the_same() {
    let mut frames: Vec<[f32; FEATURES]> = video(1500, 8, 0.2).into_iter().map(|f| f.0).collect();
    // AU number 3 is seen by one readout only.
    for frame in frames.iter_mut().skip(700).step_by(9) {
        frame[3] += 2.0;
    }
    let mut person = Person::learn(readout(), &frames, Calibration::WholeVideo);
    let mut mean = [0.0; UNITS];
    for frame in &frames {
        let units = person.units(frame).unwrap();
        assert!(units.confidences.iter().all(|c| (0.0..=1.0).contains(c)));
        for (mean, c) in mean.iter_mut().zip(units.confidences) {
            *mean += c / frames.len() as f32;
        }
    }
    assert!(mean[8] > 0.7 && mean[3] < 0.3, "{mean:?}");
}
