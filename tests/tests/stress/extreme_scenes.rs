//! Extreme scenes through the real binaries, at toy size: each ends in a result of finite numbers or in one clear refusal.

use std::path::Path;

use glam::DVec3;
use image::RgbImage;
use risorius_formats::Camera;
use risorius_formats::mask::LabelImage;
use risorius_formats::nerfies::{self, Dataset};
use risorius_tests::linked_copy;
use serde_json::Value;

use crate::support::{survives, text, tiny};

/// The cell of an intensity in a row.
type Intensity = fn(usize) -> &'static str;

/// What is changed of the tiny dataset.
type Change = fn(&mut Scene);

/// A dataset under change.
struct Scene {
    data: Dataset,
    /// Every pixel of every picture, if it is replaced.
    paint: Option<[u8; 3]>,
    /// Whether all masks lose their area.
    no_masks: bool,
}

impl Scene {
    fn cameras(&mut self, change: impl Fn(usize, &mut Camera)) {
        self.data.cameras.values_mut().enumerate().for_each(|(i, c)| change(i, c));
    }

    fn put(camera: &mut Camera, at: DVec3) {
        camera.camera_from_world.translation = -(camera.camera_from_world.rotation * at);
    }

    fn middle(&self) -> DVec3 {
        self.data.extras.as_ref().unwrap().head_center
    }

    fn keep(&mut self, count: usize) {
        let d = &mut self.data;
        d.train_ids.truncate(count);
        d.val_ids.clear();
        d.ids = d.train_ids.clone();
        let kept = d.ids.clone();
        d.cameras.retain(|id, _| kept.contains(id));
        d.metadata.retain(|id, _| kept.contains(id));
        d.annotations.retain(|a| kept.iter().any(|id| id.parse() == Ok(a.frame)));
        if let Some(extras) = &mut d.extras {
            extras.neutral_id = None;
        }
    }

    /// The same scene in units `times` as small.
    fn grow(&mut self, times: f64) {
        self.cameras(|_, c| c.camera_from_world.translation *= times);
        let s = &mut self.data.scene;
        s.center_in_world *= times;
        s.scale /= times;
        let extras = self.data.extras.as_mut().unwrap();
        extras.head_center *= times;
        extras.head_radius *= times;
    }

    fn attributes(&mut self, value: impl Fn(u32) -> f32) {
        self.data.annotations.iter_mut().for_each(|a| a.value = value(a.frame));
    }
}

/// In the quick part: those that differ most from each other. The others join in the long part.
const QUICK: [(&str, Change); 6] = [
    ("a camera inside the head", |s| {
        let middle = s.middle();
        s.cameras(|_, c| Scene::put(c, middle));
    }),
    ("one frame", |s| s.keep(1)),
    ("all black, without masks", |s| {
        s.paint = Some([0; 3]);
        s.no_masks = true;
    }),
    ("a scene of 1 mm", |s| s.grow(1e-3)),
    ("a field of view of 179°", |s| {
        s.cameras(|_, c| {
            let k = &mut c.intrinsics;
            k.fx = f64::from(k.width) / 2.0 / 89.5f64.to_radians().tan();
            k.fy = k.fx;
        });
    }),
    ("extreme distortion", |s| {
        s.cameras(|i, c| c.intrinsics.distortion.radial = if i % 2 == 0 { [1e4, -1e6, 1e8] } else { [-3.0, 0.0, 0.0] });
    }),
];

const MORE: [(&str, Change); 11] = [
    ("one view", |s| {
        let first = *s.data.cameras.values().next().unwrap();
        s.cameras(|_, c| *c = first);
    }),
    ("two views", |s| {
        let two: Vec<Camera> = s.data.cameras.values().take(2).copied().collect();
        s.cameras(|i, c| *c = two[i % 2]);
    }),
    ("cameras on a line through the head", |s| {
        let (middle, first) = (s.middle(), *s.data.cameras.values().next().unwrap());
        let back = first.center() - middle;
        s.cameras(|i, c| {
            *c = first;
            Scene::put(c, middle + back * (0.5 + 0.1 * i as f64));
        });
    }),
    ("cameras that look away", |s| {
        s.cameras(|_, c| {
            let center = c.center();
            c.camera_from_world.rotation =
                glam::DMat3::from_rotation_y(std::f64::consts::PI) * c.camera_from_world.rotation;
            Scene::put(c, center);
        });
    }),
    ("all white", |s| s.paint = Some([255; 3])),
    ("masks without area", |s| s.no_masks = true),
    ("a scene of 10 m", |s| s.grow(10.0)),
    ("a scene of 10 km", |s| s.grow(1e4)),
    ("AUs all equal", |s| s.attributes(|_| 0.0)),
    ("AUs all at rest", |s| s.attributes(|_| -1.0)),
    ("AUs that flip every frame", |s| s.attributes(|frame| if frame % 2 == 0 { -1.0 } else { 1.0 })),
];

fn write(scene: &Scene, from: &Path, data: &Path) {
    linked_copy(from, data);
    // What is written here takes the place of links into the fixture.
    for name in ["dataset.json", "metadata.json", "scene.json", "annotations.yml", "mapping.yml", "intensities.csv"] {
        let _ = std::fs::remove_file(data.join(name));
    }
    let _ = std::fs::remove_dir_all(data.join("camera"));
    std::fs::create_dir(data.join("camera")).unwrap();
    scene.data.write(data).unwrap();
    for id in &scene.data.ids {
        let size = scene.data.cameras[id].reduced(2).intrinsics;
        if let Some(rgb) = scene.paint {
            let path = nerfies::rgb_path(data, 2, id);
            std::fs::remove_file(&path).unwrap();
            RgbImage::from_pixel(size.width, size.height, image::Rgb(rgb)).save(&path).unwrap();
        }
        if scene.no_masks {
            let path = nerfies::region_path(data, 2, id);
            std::fs::remove_file(&path).unwrap();
            LabelImage::new(size.width, size.height).write_png(&path).unwrap();
        }
    }
}

/// Fits and renders; gives what happened in a word, or what was wrong.
fn fit_and_look(scene: &Scene, steps: &str, fields: &[&str]) -> Result<String, String> {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    write(scene, &tiny().join("data"), &data);
    let mut told = Vec::new();
    for field in fields {
        let out = dir.path().join(field);
        let steps: &[&str] =
            if *field == "splat" { &["--steps", steps] } else { &["--preset", "tiny", "--steps", "3"] };
        let args = ["fit", text(&data), "--out", text(&out), "--field", field, "-q"];
        let (fitted, said) = survives("trainer", &[&args[..], steps].concat())?;
        if !fitted {
            if said.matches("error: ").count() != 1 {
                return Err(format!("{field}: no clear refusal: {said}"));
            }
            told.push(format!("{field} refused: {}", said.lines().next().unwrap_or_default()));
            continue;
        }
        let metrics = std::fs::read_to_string(out.join("metrics.jsonl")).map_err(|e| e.to_string())?;
        for line in metrics.lines() {
            let line: Value = serde_json::from_str(line).map_err(|e| format!("{field}: {e}: {line}"))?;
            // A NaN is written as null.
            if let Some((key, _)) = line.as_object().and_then(|o| o.iter().find(|(_, v)| v.is_null())) {
                return Err(format!("{field}: `{key}` is no number in {line}"));
            }
        }
        let pictures = dir.path().join(format!("{field}-pictures"));
        let args = ["render", text(&out), "--orbit", "2", "--depth", "--masks", "-q", "--out", text(&pictures)];
        let (rendered, said) = survives("trainer", &args)?;
        if !rendered || image::open(pictures.join("000.png")).is_err() {
            return Err(format!("{field}: no picture: {said}"));
        }
        told.push(format!("{field} fitted"));
    }
    Ok(told.join(", "))
}

fn all(scenes: &[(&str, Change)], steps: &str, fields: &[&str]) {
    let mut wrong = Vec::new();
    for (name, change) in scenes {
        let data = Dataset::read(tiny().join("data")).unwrap();
        let mut scene = Scene { data, paint: None, no_masks: false };
        change(&mut scene);
        match fit_and_look(&scene, steps, fields) {
            Ok(told) => eprintln!("{name}: {told}"),
            Err(message) => wrong.push(format!("{name}: {message}")),
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn extreme_scenes_fit_or_are_refused() {
    all(&QUICK, "12", &["splat"]);
}

#[test]
#[ignore = "minutes: the long part"]
fn all_extreme_scenes_fit_or_are_refused_by_both_fields() {
    all(&QUICK, "50", &["splat", "confies"]);
    all(&MORE, "50", &["splat", "confies"]);
}

/// From a video of one frame, and from AUs that never move or flip every frame, to a dataset.
#[test]
fn extreme_takes_become_datasets_or_are_refused() {
    let tiny = tiny();
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    // One frame.
    std::fs::create_dir(at("one")).unwrap();
    let picture = std::fs::read_dir(tiny.join("data/rgb/2x")).unwrap().next().unwrap().unwrap().path();
    std::fs::copy(picture, at("one/000000.png")).unwrap();
    let rows = std::fs::read_to_string(tiny.join("capture/openface.csv")).unwrap();
    let first: Vec<&str> = rows.lines().take(2).collect();
    std::fs::write(at("one.csv"), first.join("\n") + "\n").unwrap();
    let take = at("one-take");
    let (video, table) = (at("one"), at("one.csv"));
    let (model, data) = (tiny.join("capture/truth_colmap"), at("one-data"));
    let steps: [&[&str]; 5] = [
        &["capture", "record", "--input", text(&video), "--out", text(&take)],
        &["capture", "check", text(&take)],
        &["tracker", "import", text(&take), "--openface", text(&table)],
        &["tracker", "poses", text(&take), "--colmap-model", text(&model)],
        &["dataset", "build", text(&take), "--frames", "2", "--scale", "2", "--out", text(&data)],
    ];
    for step in steps {
        let (_, said) = survives(step[0], &[&step[1..], &["-q"]].concat()).unwrap();
        assert!(said.matches("error: ").count() <= 1, "{said}");
    }
    // AUs.
    let table = std::fs::read_to_string(tiny.join("capture/openface.csv")).unwrap();
    let header: Vec<&str> = table.lines().next().unwrap().split(',').map(str::trim).collect();
    let rewritten = |value: Intensity| {
        let mut lines = vec![table.lines().next().unwrap().to_owned()];
        for (i, line) in table.lines().skip(1).enumerate() {
            let cells =
                line.split(',').zip(&header).map(|(cell, name)| if name.ends_with("_r") { value(i) } else { cell });
            lines.push(cells.collect::<Vec<_>>().join(","));
        }
        lines.join("\n") + "\n"
    };
    let cases: [(&str, Intensity); 4] = [
        ("never", |_| "0.00"),
        ("always", |_| "5.00"),
        ("flip", |i| if i % 2 == 0 { "0.00" } else { "5.00" }),
        ("spike", |i| if i == 7 { "5.00" } else { "0.00" }),
    ];
    for (name, value) in cases {
        let (take, csv) = (at(name), at(&format!("{name}.csv")));
        linked_copy(&tiny.join("take"), &take);
        std::fs::remove_dir_all(take.join("track")).unwrap();
        std::fs::write(&csv, rewritten(value)).unwrap();
        let (imported, said) = survives("tracker", &["import", text(&take), "--openface", text(&csv), "-q"]).unwrap();
        assert!(imported, "{name}: {said}");
        for objective in ["paper", "entropy"] {
            let out = at(&format!("{name}-{objective}"));
            let args = [
                "build",
                text(&take),
                "--objective",
                objective,
                "--frames",
                "8",
                "--scale",
                "2",
                "--scales",
                "2",
                "-q",
            ];
            let (built, said) = survives("dataset", &[&args[..], &["--out", text(&out)]].concat()).unwrap();
            assert!(built || said.matches("error: ").count() == 1, "{name}: {said}");
            if built {
                let (sound, said) = survives("dataset", &["verify", text(&out), "-q"]).unwrap();
                assert!(sound, "{name}: {said}");
                let stats = std::fs::read_to_string(out.join("report/stats.json")).unwrap();
                assert!(!stats.contains("NaN") && !stats.contains("inf"), "{name}");
            }
        }
    }
}
