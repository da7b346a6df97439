//! Poison through `risorius-dataset`: levels, the two samplers, neutral values, views, regions, splits, pictures.

use glam::{DMat3, DVec3};
use risorius_dataset::balance::{self, BalanceOptions, Bins, Quota};
use risorius_dataset::entropy::{self, EntropyOptions, Seen};
use risorius_dataset::regions::{self, RegionStyle, Shape};
use risorius_dataset::split::{self, Facts, SplitKind, SplitOptions};
use risorius_dataset::{neutral, raster, scale, smooth, stats, views};
use risorius_formats::{ActionUnit, AttributeSpec, Camera, Intrinsics, Isometry, Landmarks68};

use crate::support::{Ledger, POISON, check, finite, finite_32};

/// The level of a frame.
type Level = fn(usize) -> usize;

#[test]
fn samplers_choose_what_was_asked_whatever_the_numbers() {
    let mut ledger = Ledger::default();
    let spec = AttributeSpec::from_range(ActionUnit(12), 2, 0.2, 4.0, 0.3);
    for levels in [0, 1, 2, 6, 1000] {
        ledger.poke_32("balance::level_of", [2.0], |[v]| {
            let level = balance::level_of(v, levels);
            let of_frame = balance::levels_of_frame(&[v], std::slice::from_ref(&spec), levels, Bins::Range);
            check(level < levels.max(1) && of_frame[0] < levels.max(1), || format!("{level}, {of_frame:?}"))
        });
    }
    // All alike, all different, flipping every frame; targets from none to more than there are.
    let patterns: [(&str, Level); 3] = [("alike", |_| 3), ("different", |i| i % 6), ("flipping", |i| 5 * (i % 2))];
    for (name, level) in patterns {
        let levels: Vec<Vec<usize>> = (0..50).map(|i| vec![level(i), level(i + 1)]).collect();
        for target in [0, 1, 7, 50, 51, usize::MAX / 4] {
            for quota in [Quota::Running, Quota::Fixed, Quota::Ceiling] {
                for count_existing in [false, true] {
                    ledger.one("balance::select_balanced", &format!("{name}, {target}, {quota:?}"), || {
                        let options = BalanceOptions { levels: 6, quota, count_existing };
                        for active in [[true, true], [true, false], [false, false]] {
                            let chosen = balance::select_balanced(&levels, &active, target, options);
                            check(chosen.len() == target.min(50) && chosen.is_sorted_by(|a, b| a < b), || {
                                format!("{chosen:?}")
                            })?;
                        }
                        Ok(())
                    });
                }
            }
            ledger.one("balance::select_uniform", &format!("{target}"), || {
                check(balance::select_uniform(50, target).len() == target.min(50), || "another count".into())
            });
        }
    }
    let levels: Vec<Vec<usize>> = (0..50).map(|i| vec![i % 6, i / 9]).collect();
    for place in 0..4 {
        for (name, v) in POISON {
            ledger.one("entropy::select", &format!("{place} = {name}"), || {
                let seen: Vec<Seen<'_>> = (0..50)
                    .map(|i| Seen {
                        levels: &levels[i],
                        cell: if place == 0 && i == 3 { [v as i32, i32::MIN] } else { [(i % 5) as i32, 0] },
                        take: 0,
                        secs: if place == 1 && i == 3 { v } else { i as f64 / 30.0 },
                        sharpness: if place == 2 && i == 3 { Some(v as f32) } else { Some(i as f32) },
                    })
                    .collect();
                let usable = v.is_finite() && v >= 0.0;
                let options = EntropyOptions {
                    view_weight: if place == 3 && usable { v } else { 0.25 },
                    ..EntropyOptions::default()
                };
                let chosen = entropy::select(&seen, &[true, true], 10, options);
                check(chosen.len() == 10 && chosen.is_sorted_by(|a, b| a < b), || format!("{chosen:?}"))
            });
        }
    }
    for (name, v) in POISON {
        for kind in [SplitKind::TimeBlocks, SplitKind::Views, SplitKind::AuCombinations, SplitKind::Periodic] {
            for place in 0..4 {
                ledger.one("split::roles", &format!("{kind:?}, {place} = {name}"), || {
                    let mut facts: Vec<Facts> = (0..80)
                        .map(|i| Facts {
                            take: 0,
                            secs: f64::from(i) / 10.0,
                            view: [f64::from(i % 9) * 8.0 - 30.0, 0.0],
                            combination: u64::from(i as u32 % 4),
                        })
                        .collect();
                    let mut options = SplitOptions { kind, val_share: 0.2, guard_secs: 0.3 };
                    match place {
                        0 => facts[7].secs = v,
                        1 => facts[7].view[0] = v,
                        2 => facts[79].secs = v,
                        _ => options.guard_secs = v,
                    }
                    check(split::roles(&facts, options).len() == 80, || "another count".into())
                });
            }
        }
    }
    ledger.close("samplers");
}

#[test]
fn views_regions_and_pictures_have_sane_answers() {
    let mut ledger = Ledger::default();
    ledger.poke_32("neutral::neutral_intensities", [0.3, 2.0], |[low, v]| {
        let specs = [AttributeSpec::from_range(ActionUnit(12), 0, low, 4.0, 0.0)];
        let rows: Vec<Vec<f32>> = (0..10u8).map(|i| vec![if i == 4 { v } else { f32::from(i) * 0.4 }]).collect();
        let got = neutral::neutral_intensities(&rows, &specs);
        if v.is_finite() { finite_32(got) } else { check(got.len() == 1, || "another count".into()) }
    });
    ledger.poke("smooth::smooth_segments", [1.0], |[v]| {
        let mut values: Vec<f64> = (0..30).map(|i| f64::from(i) / 10.0).collect();
        values[12] = v;
        let out = smooth::smooth_segments(&values, &[0..10, 10..30], 7);
        check(out[..10].iter().all(|v| (0.0..=5.0).contains(v)), || format!("{out:?}"))?;
        let sound = v.is_finite() && v.abs() < 1e300;
        if sound { check(out.iter().all(|v| (0.0..=5.0).contains(v)), || format!("{out:?}")) } else { Ok(()) }
    });
    ledger.poke("views::direction", [0.1, 0.2, -2.0, 0.0], |a| {
        let rotation = DMat3::IDENTITY;
        let camera = Camera {
            intrinsics: Intrinsics::pinhole(64, 48, 60.0),
            camera_from_world: Isometry::new(rotation, -DVec3::new(a[0], a[1], a[2])),
        };
        let head = Isometry::new(DMat3::IDENTITY, DVec3::splat(a[3]));
        let Some(d) = views::direction(&camera, &head) else { return Ok(()) };
        let angles = views::yaw_pitch_deg(d);
        let _ = views::cell(angles);
        check((d.length() - 1.0).abs() < 1e-9, || format!("{d}")).and(finite(angles))
    });
    ledger.poke("views::coverage", [10.0, -5.0], |a| {
        let seen = [[0.0, 0.0], a, [20.0, 3.0]];
        let c = views::coverage(&seen, &[0, 2]);
        let empty = views::coverage(&[], &[]);
        finite([c.entropy, empty.entropy, empty.mean_gap_deg, empty.largest_gap_deg])?;
        if a.iter().all(|v| v.is_finite()) { finite([c.mean_gap_deg, c.largest_gap_deg]) } else { Ok(()) }
    });
    let face: [[f32; 2]; 68] = std::array::from_fn(|i| {
        let t = i as f32;
        match i {
            0..17 => [
                320.0 - 150.0 * (t / 16.0 * std::f32::consts::PI).cos(),
                240.0 + 170.0 * (t / 16.0 * std::f32::consts::PI).sin(),
            ],
            17..27 => [200.0 + 24.0 * (t - 17.0), 170.0],
            _ => [320.0 + 30.0 * t.sin(), 250.0 + 40.0 * t.cos()],
        }
    });
    for place in [0, 8, 19, 28, 36, 48] {
        ledger.poke_32("regions::polygons", face[place], |p| {
            let mut points = face;
            points[place] = p;
            let landmarks = Landmarks68 { points_px: points };
            let styles = [(Shape::Brow, 1), (Shape::Eye, 2), (Shape::Mouth, 3)].map(|(shape, label)| RegionStyle {
                shape,
                polygon_label: format!("AU{label:02}"),
                label,
            });
            let Ok(found) = regions::polygons(Some(&landmarks), &styles, 640, 480) else { return Ok(()) };
            finite(found.polygons.iter().flat_map(|p| p.points_px.iter().flatten().copied()))?;
            let image = regions::label_image(&found, &styles, 4, 160, 120);
            check(image.labels.iter().all(|&l| l <= 3), || "another label".into())
        });
    }
    for (w, h) in [(0, 0), (1, 1), (7, 7), (8, 8), (u32::MAX, 9), (9, u32::MAX)] {
        ledger.one("scale::trimmed_size", &format!("{w}×{h}"), || {
            let _ = scale::trimmed_size(w, h);
            Ok(())
        });
    }
    for (w, h) in [(1, 1), (3, 2), (8, 8)] {
        for divisor in [1, 2, 8] {
            ledger.one("scale::reduced", &format!("{w}×{h}/{divisor}"), || {
                let _ = scale::reduced(&image::RgbImage::new(w, h), divisor);
                Ok(())
            });
        }
    }
    ledger.poke("raster::hull_mask", [0.1, 0.2, 2.0, 60.0], |a| {
        let camera = Camera { intrinsics: Intrinsics::pinhole(64, 48, a[3]), camera_from_world: Isometry::IDENTITY };
        let corners = [DVec3::new(a[0], a[1], a[2]), DVec3::new(0.3, 0.0, 2.0), DVec3::new(0.0, 0.3, 2.0)];
        let mask = raster::hull_mask(&corners, &camera);
        check(mask.labels.len() == 64 * 48, || "another size".into())
    });
    for counts in [vec![vec![]], vec![vec![0; 6]], vec![vec![0, 0, 5, 0, 0, 0]], vec![vec![usize::MAX / 8; 6]]] {
        ledger.one("stats::evenness", &format!("{counts:?}"), || {
            let e = stats::evenness(&counts, &counts, &[true]);
            finite([e.block_entropy, e.entropy, e.coefficient_of_variation, e.raised_variation])
        });
    }
    ledger.close("views, regions and pictures");
}
