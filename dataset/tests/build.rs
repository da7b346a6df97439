//! `dataset build`, `verify` and `export` on small takes with known answers.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod common;

use std::path::Path;

use common::{FRAMES, HEIGHT, WIDTH};
use glam::DVec3;
use risorius_dataset::export::{Target, export};
use risorius_dataset::verify::verify;
use risorius_dataset::{BuildOptions, DatasetError, Report, Sampling, TAKE_OFFSET, build};
use risorius_formats::landmark_table::LandmarkTable;
use risorius_formats::mask::LabelImage;
use risorius_formats::nerfies::{self, Dataset};
use risorius_formats::pose_report::PoseMethod;
use risorius_formats::report::Collected;
use risorius_formats::{ActionUnit, AttributeTable, Hint, Intensity, Isometry, RegionTable, Silent};

fn options() -> BuildOptions {
    BuildOptions { frames: 40, scale: 2, scales: vec![1, 2], ..BuildOptions::default() }
}

fn built(change: impl FnOnce(&mut common::Take), options: &BuildOptions) -> (tempfile::TempDir, Report, Collected) {
    let dir = tempfile::tempdir().unwrap();
    let mut take = common::take();
    change(&mut take);
    take.write(&dir.path().join("take"));
    let collected = Collected::default();
    let report = build(&[dir.path().join("take")], &dir.path().join("data"), options, &collected).unwrap();
    (dir, report, collected)
}

fn problems(dir: &Path) -> Vec<String> {
    verify(dir, &Silent).problems.into_iter().map(|p| format!("{}: {}", p.path.display(), p.message)).collect()
}

#[test]
fn a_take_becomes_a_dataset_that_verifies() {
    let (dir, report, warnings) = built(|_| {}, &options());
    let data = dir.path().join("data");
    assert_eq!(problems(&data), Vec::<String>::new());
    let dataset = Dataset::read(&data).unwrap();
    let table = AttributeTable::read(data.join("attributes.toml")).unwrap();

    // Ids, splits, indices.
    assert_eq!((dataset.ids.len(), report.chosen), (40, 40));
    assert!(dataset.ids.is_sorted() && dataset.ids.iter().all(|id| id.len() == 6));
    assert_eq!(dataset.val_ids, [dataset.ids[10].clone(), dataset.ids[30].clone()]);
    assert_eq!(dataset.train_ids.len(), 38);
    for (k, id) in dataset.train_ids.iter().enumerate() {
        let m = dataset.metadata[id];
        assert_eq!((m.warp_id as usize, m.time_id), (k, Some(id.parse().unwrap())));
    }

    // Attributes: the 17 AUs region after region, AU06 inactive and named.
    assert_eq!(dataset.mapping.len(), 17);
    assert_eq!(dataset.mapping[3..8], ["AU05", "AU06", "AU07", "AU09", "AU45"]);
    let cheek = &table.attributes[table.index_of(ActionUnit(6)).unwrap()];
    assert!(!cheek.active && table.attributes.iter().filter(|a| a.active).count() == 16);
    assert!(warnings.warnings().iter().any(|w| w.kind == "inactive-au" && w.message.contains("AU06")));
    for a in &table.attributes {
        assert!((a.neutral - 0.2).abs() < 0.25, "{} rests at {}", a.unit, a.neutral);
    }
    // Annotations: eq. 1 of the smoothed curve, which at 5 frames of order 3 is the curve itself but for little.
    for a in &dataset.annotations {
        let spec = &table.attributes[a.class];
        let k = risorius_formats::au::OPENFACE_INTENSITIES.iter().position(|u| *u == spec.unit).unwrap();
        let expected = spec.scale().attribute(Intensity(common::intensity(a.frame, k))).0;
        assert!((a.value - expected).abs() < 0.03, "{} in frame {}: {} and {expected}", spec.unit, a.frame, a.value);
    }
    assert_eq!(dataset.annotations.len(), 40 * 17);

    // Pictures: trimmed to multiples of 8, the true mean of their blocks.
    let id = &dataset.ids[7];
    let f: u32 = id.parse().unwrap();
    let full = image::open(nerfies::rgb_path(&data, 1, id)).unwrap().to_rgb8();
    let half = image::open(nerfies::rgb_path(&data, 2, id)).unwrap().to_rgb8();
    assert_eq!(
        (full.width(), full.height(), half.width(), half.height()),
        (WIDTH / 8 * 8, HEIGHT, WIDTH / 8 * 4, HEIGHT / 2)
    );
    assert_eq!(*full.get_pixel(31, 40), common::pixel(f, 31, 40));
    let sum: u32 =
        [(20, 30), (21, 30), (20, 31), (21, 31)].iter().map(|&(x, y)| u32::from(common::pixel(f, x, y).0[2])).sum();
    assert_eq!(u32::from(half.get_pixel(10, 15).0[2]), (sum + 2) / 4);

    // Masks: landmarks in their regions, through the camera that was written.
    let take = common::take();
    let labels = LabelImage::read_png(nerfies::region_path(&data, 1, id)).unwrap();
    for (range, label) in [(18..26, 1), (36..48, 2), (48..60, 3)] {
        for k in range {
            let p = dataset.cameras[id].project(take.report.landmarks_in_world[k]);
            assert_eq!(labels.get(p.x as u32, p.y as u32), label, "landmark {k}");
        }
    }
    // The landmarks of all chosen frames, as they were tracked.
    let landmarks = LandmarkTable::read(&data).unwrap().unwrap();
    assert!(landmarks.rows.keys().eq(&dataset.ids));
    let tracked = take.track.rows[f as usize].landmarks.as_ref().unwrap();
    for (found, expected) in landmarks.rows[id].points_px.iter().flatten().zip(tracked.points_px.iter().flatten()) {
        assert!((found - expected).abs() < 0.06, "{found} and {expected}");
    }
    // The polygon file says the same, under the name of the first AU of each group.
    let polygons = nerfies::Polygons::read(nerfies::polygons_path(&data, id)).unwrap();
    let again = polygons.label_image(&[("AU05", 2), ("AU01", 1), ("AU10", 3)], 1, labels.width, labels.height);
    assert_eq!(again, labels);

    // The scene fits the unit ball.
    for camera in dataset.cameras.values() {
        assert!(dataset.scene.scene_from_world(camera.center()).length() <= 1.0 + 1e-6);
    }
    let ratio = dataset.scene.far / dataset.scene.near;
    assert!((ratio - 7.0 / 3.8).abs() < 1e-9 && dataset.scene.far < 2.0);
    for name in ["stats.json", "settings.toml", "distribution.svg", "contact_sheet.png"] {
        assert!(data.join("report").join(name).metadata().unwrap().len() > 100, "{name}");
    }
    assert!(report.evenness_after.coefficient_of_variation < report.evenness_uniform.coefficient_of_variation);
}

#[test]
fn the_same_takes_give_the_same_bytes_whatever_the_order_of_rows() {
    let (a, ..) = built(|_| {}, &options());
    let (b, ..) = built(|take| take.track.rows.reverse(), &options());
    let (a, b) = (common::files(&a.path().join("data")), common::files(&b.path().join("data")));
    assert_eq!(a.len(), b.len());
    for (x, y) in a.iter().zip(&b) {
        assert_eq!(x.0, y.0);
        assert!(x.1 == y.1, "{} differs", x.0.display());
    }
}

#[test]
fn balance_keeps_rare_intensities_that_the_baseline_loses() {
    let few = BuildOptions { frames: 16, ..options() };
    let (.., balanced, _) = built(|_| {}, &few);
    let (.., uniform, _) = built(|_| {}, &BuildOptions { sampling: Sampling::Uniform, ..few });
    let cv = |r: &Report| r.evenness_after.coefficient_of_variation;
    assert!(cv(&balanced) < cv(&uniform), "{} and {}", cv(&balanced), cv(&uniform));
    assert_eq!(uniform.evenness_after, uniform.evenness_uniform);
}

#[test]
fn lost_repeated_and_unposed_frames_are_never_chosen_and_are_counted() {
    let all = BuildOptions { frames: 500, ..options() };
    let (dir, report, warnings) = built(
        |take| {
            take.track.rows[20].success = false;
            take.track.rows[21].confidence = 0.4;
            take.frames[33].repeated = true;
            take.model.images.remove(&51);
        },
        &all,
    );
    let dataset = Dataset::read(dir.path().join("data")).unwrap();
    for frame in [20, 21, 33, 50] {
        assert!(!dataset.ids.contains(&format!("{frame:06}")), "{frame}");
    }
    assert_eq!(dataset.ids.len(), FRAMES as usize - 4);
    let counts = report.takes[0].counts;
    assert_eq!((counts.lost, counts.low_confidence, counts.valid), (1, 1, FRAMES - 2));
    assert_eq!((warnings.count("few-candidates"), warnings.count("untrusted-frames")), (1, 1));
}

#[test]
fn frames_without_masks_only_fill_up_and_are_named() {
    let spoil = |take: &mut common::Take| {
        for row in &mut take.track.rows[40..50] {
            row.landmarks.as_mut().unwrap().points_px[28] = [2.0, 60.0];
        }
    };
    let (dir, report, _) = built(spoil, &options());
    assert_eq!((report.rejected_masks["self-intersection"], report.chosen_without_masks), (10, 0));
    drop(dir);
    let (dir, report, _) = built(spoil, &BuildOptions { frames: 88, ..options() });
    let data = dir.path().join("data");
    assert_eq!(report.chosen_without_masks, 8);
    let without = Dataset::read(&data).unwrap().extras.unwrap().ids_without_masks;
    assert_eq!(without.len(), 8);
    assert!(!nerfies::region_path(&data, 2, &without[0]).exists() && nerfies::rgb_path(&data, 2, &without[0]).exists());
    assert_eq!(problems(&data), Vec::<String>::new());
}

#[test]
fn the_head_route_marks_what_is_rigid_with_the_head() {
    let ball: Vec<_> = (0..60)
        .map(|i| {
            let (z, a) = (1.0 - (2 * i + 1) as f64 / 60.0, f64::from(i) * 2.4);
            DVec3::new((1.0 - z * z).sqrt() * a.cos(), (1.0 - z * z).sqrt() * a.sin(), z)
        })
        .collect();
    let (dir, ..) = built(
        |take| {
            take.report.method = PoseMethod::Head;
            take.report.head_hull_in_world = Some(ball);
        },
        &options(),
    );
    let data = dir.path().join("data");
    let dataset = Dataset::read(&data).unwrap();
    assert!(dataset.extras.as_ref().unwrap().head_hull_in_world.is_some());
    let mask = LabelImage::read_png(nerfies::valid_path(&data, 2, &dataset.ids[3])).unwrap();
    let middle = dataset.cameras[&dataset.ids[3]].reduced(2).project(DVec3::ZERO);
    assert_eq!((mask.get(middle.x as u32, middle.y as u32), mask.get(0, 0)), (255, 0));
    // A unit ball at distance 5 with a focal length of 80 pixels.
    let expected = std::f64::consts::PI * 80.0 * 80.0 / 24.0 / f64::from(mask.width * mask.height);
    assert!((mask.share(255) / expected - 1.0).abs() < 0.12, "{} of {expected}", mask.share(255));
    assert_eq!(problems(&data), Vec::<String>::new());
}

#[test]
fn two_takes_share_one_world() {
    let dir = tempfile::tempdir().unwrap();
    let first = common::take();
    let mut second = common::take();
    // The second take's world is turned, moved and three times as large.
    let turn = Isometry::from_wxyz([0.8, 0.1, 0.5, -0.2], DVec3::ZERO).rotation;
    let away = |p: DVec3| turn * p * 3.0 + DVec3::new(1.0, -2.0, 0.5);
    for image in second.model.images.values_mut() {
        let center = away(image.camera_from_world.camera_center());
        let rotation = image.camera_from_world.rotation * turn.transpose();
        image.camera_from_world = Isometry::new(rotation, -(rotation * center));
    }
    second.report.landmarks_in_world.iter_mut().for_each(|p| *p = away(*p));
    second.report.head_center = away(second.report.head_center);
    second.report.near *= 3.0;
    second.report.far *= 3.0;
    first.write(&dir.path().join("a"));
    second.write(&dir.path().join("b"));
    let data = dir.path().join("data");
    let all = BuildOptions { frames: 180, ..options() };
    build(&[dir.path().join("a"), dir.path().join("b")], &data, &all, &Silent).unwrap();
    let dataset = Dataset::read(&data).unwrap();
    assert_eq!(dataset.extras.as_ref().unwrap().takes, ["a", "b"]);
    assert_eq!((dataset.ids[0].as_str(), dataset.ids[90].as_str()), ("0000000", "1000000"));
    for f in [0u32, 17, 80] {
        let (a, b) = (&dataset.cameras[&format!("{f:07}")], &dataset.cameras[&format!("{:07}", f + TAKE_OFFSET)]);
        assert!((a.center() - b.center()).length() < 1e-4);
        assert!((a.project(DVec3::new(0.3, 0.2, 0.1)) - b.project(DVec3::new(0.3, 0.2, 0.1))).length() < 1e-2);
    }
    assert!((dataset.scene.far / dataset.scene.near - 7.0 / 3.8).abs() < 1e-6);
    assert_eq!(problems(&data), Vec::<String>::new());
}

#[test]
fn other_region_tables_and_missing_units_work() {
    let regions: RegionTable =
        toml::from_str("[[regions]]\nname = \"mouth\"\nunits = [\"AU12\", \"AU26\", \"AU28\"]\n[[regions]]\nname = \"brow\"\nunits = [\"AU04\"]\n").unwrap();
    let (dir, _, warnings) = built(|_| {}, &BuildOptions { regions, ..options() });
    let data = dir.path().join("data");
    let table = AttributeTable::read(data.join("attributes.toml")).unwrap();
    assert_eq!((table.regions.as_slice(), table.attributes.len()), (&["mouth".to_owned(), "brow".to_owned()][..], 3));
    assert!(warnings.warnings().iter().any(|w| w.kind == "missing-au" && w.message.contains("AU28")));
    let dataset = Dataset::read(&data).unwrap();
    let labels = LabelImage::read_png(nerfies::region_path(&data, 2, &dataset.ids[0])).unwrap();
    assert!(labels.share(1) > 0.05 && labels.share(2) > 0.01 && labels.share(3) == 0.0);
    assert_eq!(problems(&data), Vec::<String>::new());
}

#[test]
fn what_cannot_be_built_is_explained_and_leaves_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let take = dir.path().join("take");
    let out = dir.path().join("data");
    let fails = |options: &BuildOptions| {
        let error = build(std::slice::from_ref(&take), &out, options, &Silent).unwrap_err();
        assert!(error.hint().is_some(), "{error}");
        let names: Vec<_> = std::fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
        assert!(names.iter().all(|n| n == "take"), "{names:?}");
        error
    };
    fails(&options());
    common::take().write(&take);
    for (bad, word) in [
        (BuildOptions { scale: 3, ..options() }, "scale 3"),
        (BuildOptions { scale: 4, ..options() }, "scale 4"),
        (BuildOptions { frames: 0, ..options() }, "0 frames"),
        (BuildOptions { levels: 1, ..options() }, "levels"),
        (BuildOptions { min_confidence: f32::NAN, ..options() }, "confidence"),
    ] {
        let text = fails(&bad).to_string();
        assert!(text.contains(word), "{text}");
    }
    let track = std::fs::read(take.join("track/openface.csv")).unwrap();
    std::fs::remove_file(take.join("track/openface.csv")).unwrap();
    assert!(fails(&options()).to_string().contains("not tracked"));
    std::fs::write(take.join("track/openface.csv"), track).unwrap();
    std::fs::rename(take.join("poses"), take.join("poses2")).unwrap();
    assert!(fails(&options()).to_string().contains("no cameras"));
    std::fs::rename(take.join("poses2"), take.join("poses")).unwrap();

    let mut broken = common::take();
    broken.track.rows.iter_mut().for_each(|r| r.success = false);
    broken.write(&take);
    assert!(matches!(fails(&options()), DatasetError::NoValidFrames { .. }));
    let mut broken = common::take();
    broken.model.cameras.get_mut(&1).unwrap().width = 64;
    broken.write(&take);
    assert!(matches!(fails(&options()), DatasetError::Size { .. }));
    let mut broken = common::take();
    broken.track.rows.truncate(10);
    broken.model.images.retain(|&id, _| id > 50);
    broken.write(&take);
    assert!(matches!(fails(&options()), DatasetError::NoCandidates { .. }));
    // A video that ends early.
    common::take().write(&take);
    for f in 60..FRAMES {
        std::fs::remove_file(take.join(format!("images/{f:06}.png"))).unwrap();
    }
    fails(&options());
}

#[test]
fn a_folder_of_somebody_elses_is_not_replaced() {
    let dir = tempfile::tempdir().unwrap();
    let (take, other) = (dir.path().join("take"), dir.path().join("other"));
    common::take().write(&take);
    std::fs::create_dir(&other).unwrap();
    std::fs::write(other.join("notes.txt"), "mine").unwrap();
    for out in [&take, &other, &other.join("notes.txt")] {
        let error = build(std::slice::from_ref(&take), out, &options(), &Silent).unwrap_err();
        assert!(error.to_string().ends_with("not a dataset, so it is not replaced"), "{error}");
    }
    assert_eq!(std::fs::read(other.join("notes.txt")).unwrap(), b"mine");
    // A dataset, and an export, may be.
    let data = dir.path().join("data");
    for _ in 0..2 {
        build(std::slice::from_ref(&take), &data, &options(), &Silent).unwrap();
    }
    assert!(export(&data, Target::Parquet, &other, &Silent).is_err());
    for target in [Target::Parquet, Target::Transforms, Target::Nerfies, Target::Parquet] {
        export(&data, target, &dir.path().join("out"), &Silent).unwrap();
    }
}

#[test]
fn a_dataset_of_ours_without_its_attributes_is_damaged() {
    let (dir, ..) = built(|_| {}, &options());
    let data = dir.path().join("data");
    for name in ["annotations.yml", "mapping.yml"] {
        let text = std::fs::read(data.join(name)).unwrap();
        std::fs::write(data.join(name), "").unwrap();
        let found = problems(&data);
        assert!(found.len() == 1 && found[0].ends_with(&format!("{name}: is missing or empty")), "{found:?}");
        std::fs::write(data.join(name), text).unwrap();
    }
    assert_eq!(problems(&data), Vec::<String>::new());
}

#[test]
fn every_damage_is_found_with_its_path() {
    let (dir, ..) = built(|_| {}, &options());
    let data = dir.path().join("data");
    let ids = Dataset::read(&data).unwrap().ids;
    std::fs::remove_file(nerfies::rgb_path(&data, 1, &ids[0])).unwrap();
    std::fs::write(nerfies::rgb_path(&data, 2, &ids[1]), b"\x89PNG").unwrap();
    image::RgbImage::new(5, 5).save(nerfies::rgb_path(&data, 2, &ids[2])).unwrap();
    let path = nerfies::region_path(&data, 2, &ids[3]);
    let mut labels = LabelImage::read_png(&path).unwrap();
    labels.labels[0] = 9;
    labels.write_png(&path).unwrap();
    let found = problems(&data);
    assert_eq!(found.len(), 4, "{found:#?}");
    for (id, word) in [(&ids[0], "does not exist"), (&ids[1], "decoded"), (&ids[2], "5 × 5"), (&ids[3], "label 9")] {
        assert!(found.iter().any(|p| p.contains(id.as_str()) && p.contains(word)), "{id} {word}: {found:#?}");
    }
    // Two broken cameras are both named.
    for id in &ids[4..6] {
        std::fs::write(nerfies::camera_path(&data, id), b"{").unwrap();
    }
    assert_eq!(problems(&data).len(), 2);
    assert!(!problems(Path::new("no/such/dataset")).is_empty());
}

#[test]
fn exports_hold_the_same_frames() {
    let (dir, ..) = built(|_| {}, &options());
    let data = dir.path().join("data");
    let dataset = Dataset::read(&data).unwrap();
    assert!(export(&data, Target::Parquet, &data.join("inside"), &Silent).is_err());

    let plain = dir.path().join("plain");
    export(&data, Target::Nerfies, &plain, &Silent).unwrap();
    assert_eq!(Dataset::read(&plain).unwrap(), Dataset { extras: None, ..dataset.clone() });
    assert_eq!(problems(&plain), Vec::<String>::new());
    assert!(!plain.join("regions").exists() && plain.join("annotations").exists());

    let transforms = dir.path().join("transforms");
    export(&data, Target::Transforms, &transforms, &Silent).unwrap();
    let json: serde_json::Value =
        serde_json::from_slice(&std::fs::read(transforms.join("transforms.json")).unwrap()).unwrap();
    let frame = &json["frames"][5];
    let id = &dataset.ids[5];
    assert_eq!(json["frames"].as_array().unwrap().len(), 40);
    assert_eq!(frame["w"], WIDTH / 8 * 8 / 2);
    let center = dataset.cameras[id].center().to_array();
    for k in 0..3 {
        assert!((frame["transform_matrix"][k][3].as_f64().unwrap() - center[k]).abs() < 1e-9);
    }
    assert!(transforms.join(frame["file_path"].as_str().unwrap()).exists());
    assert_eq!(frame["attributes"].as_object().unwrap().len(), 17);

    let parquet = dir.path().join("parquet");
    export(&data, Target::Parquet, &parquet, &Silent).unwrap();
    let bytes = std::fs::read(parquet.join("frames.parquet")).unwrap();
    assert!(bytes.starts_with(b"PAR1") && bytes.ends_with(b"PAR1"));
}
