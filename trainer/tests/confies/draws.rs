//! Which rays are drawn (fact sheet §2.4).

use std::collections::BTreeSet;

use risorius_trainer::batch::{Draw, RayBatch, draw};
use risorius_trainer::config::{FitSettings, RayOrder};

use crate::scene::{FRAMES, SIDE, scene, settings, space};

/// Which ray each of a batch is: its frame and its direction, which tells the pixel.
fn rays(batch: &RayBatch) -> Vec<(i32, [u32; 3])> {
    batch.frames.iter().zip(&batch.directions).map(|(&f, d)| (f, d.to_array().map(f32::to_bits))).collect()
}

#[test]
fn an_epoch_takes_every_ray_once_and_the_next_repeats_its_order() {
    let data = scene(&[]);
    let settings = FitSettings { ray_order: RayOrder::Epochs, ..settings() };
    let (space, how) = (space(&data, &settings), Draw::from(&settings));
    let all = FRAMES * (SIDE * SIDE) as usize;
    let steps = (all / settings.rays) as u64;
    assert_eq!(steps as usize * settings.rays, all, "the test wants whole epochs");
    let epoch =
        |first: u64| (first..first + steps).flat_map(|s| rays(&draw(&data, &space, &how, s))).collect::<Vec<_>>();
    let once = epoch(1);
    assert_eq!(once.iter().collect::<BTreeSet<_>>().len(), all, "a ray came twice");
    assert_eq!(once, epoch(1 + steps));
    // And in no order that follows the frames.
    assert!(once[..settings.rays].iter().map(|r| r.0).collect::<BTreeSet<_>>().len() > 2);
    let other = Draw { seed: 1, ..how };
    assert_ne!(rays(&draw(&data, &space, &other, 1)), once[..settings.rays]);
}

#[test]
fn annotated_frames_get_their_share_where_both_sorts_exist() {
    for order in [RayOrder::Independent, RayOrder::Epochs] {
        let settings = FitSettings { annotated_share: 0.75, ray_order: order, ..settings() };
        let how = Draw::from(&settings);
        let data = scene(&[0, 1, 2, 4]);
        let space = space(&data, &settings);
        for step in 1..5 {
            let batch = draw(&data, &space, &how, step);
            let annotated = batch.frames.iter().map(|f| [3, 5].contains(f)).collect::<Vec<_>>();
            assert_eq!(annotated, [vec![true; 18], vec![false; 6]].concat(), "{order:?}");
        }
        // Every frame annotated: the released loader stops here.
        let data = scene(&[]);
        assert_eq!(draw(&data, &space, &how, 1).len(), settings.rays);
    }
}

#[test]
fn settings_that_contradict_each_other_are_refused() {
    let wrong = [
        FitSettings { ray_order: RayOrder::Epochs, region_share: 0.1, ..settings() },
        FitSettings { annotated_share: 1.5, ..settings() },
        FitSettings { interval: 3, ..settings() },
    ];
    for settings in wrong {
        assert!(settings.validate().is_err());
    }
}
