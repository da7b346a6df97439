//! Exports that are imported again are equal; folders of other programs; what verification finds in them; redaction.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod common;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use risorius_dataset::export::{ExportOptions, Target, export, export_with};
use risorius_dataset::import::{ImportOptions, import};
use risorius_dataset::redact::redact;
use risorius_dataset::verify::verify;
use risorius_dataset::{BuildOptions, build, survey, tables};
use risorius_formats::mask::LabelImage;
use risorius_formats::nerfies::{self, Annotation, Dataset, Polygon, Polygons};
use risorius_formats::report::Collected;
use risorius_formats::{ActionUnit, AttributeTable, Hint, Silent};

const TARGETS: [(Target, &str); 4] = [
    (Target::Nerfies, "nerfies"),
    (Target::Transforms, "transforms"),
    (Target::Colmap, "colmap"),
    (Target::Parquet, "parquet"),
];

fn options() -> BuildOptions {
    BuildOptions { frames: 30, scale: 2, scales: vec![2, 4], ..BuildOptions::default() }
}

fn built(change: impl FnOnce(&mut common::Take)) -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let mut take = common::take();
    take.manifest.subject = "S01".into();
    take.manifest.consent = "research only".into();
    change(&mut take);
    take.write(&dir.path().join("take"));
    let data = dir.path().join("data");
    build(&[dir.path().join("take")], &data, &options(), &Silent).unwrap();
    (dir, data)
}

fn problems(dir: &Path) -> Vec<String> {
    verify(dir, &Silent).problems.into_iter().map(|p| format!("{}: {}", p.path.display(), p.message)).collect()
}

/// Panics with the names of files that only one side has or that differ.
fn assert_same(a: &BTreeMap<PathBuf, Vec<u8>>, b: &BTreeMap<PathBuf, Vec<u8>>, what: &str) {
    let differ = |(path, bytes): &(&PathBuf, &Vec<u8>)| b.get(*path) != Some(*bytes);
    let mut names: Vec<&PathBuf> = a.iter().filter(differ).map(|(path, _)| path).collect();
    names.extend(b.keys().filter(|path| !a.contains_key(*path)));
    assert!(names.is_empty(), "{what}: {names:?}");
}

/// The files below `dir` whose first folder is one of `names`.
fn files_in(dir: &Path, names: &[&str]) -> BTreeMap<PathBuf, Vec<u8>> {
    common::files(dir).into_iter().filter(|(p, _)| names.iter().any(|n| p.starts_with(n))).collect()
}

#[test]
fn every_export_is_clean_and_comes_back_equal() {
    // A lens with distortion, and a frame without masks.
    let (dir, data) = built(|take| {
        let lens = take.model.cameras.get_mut(&1).unwrap();
        lens.model = "OPENCV".into();
        lens.params = vec![160.0, 161.0, 54.2, 60.1, 0.02, -0.01, 0.001, -0.002];
        for row in &mut take.track.rows[0..80] {
            row.landmarks.as_mut().unwrap().points_px[28] = [2.0, 60.0];
        }
    });
    let original = Dataset::read(&data).unwrap();
    assert!(!original.extras.as_ref().unwrap().ids_without_masks.is_empty());
    for (target, name) in TARGETS {
        let (out, back) = (dir.path().join(name), dir.path().join(format!("{name}-back")));
        export(&data, target, &out, &Silent).unwrap();
        assert_eq!(problems(&out), Vec::<String>::new(), "{name}");
        import(&out, &back, &ImportOptions::default(), &Silent).unwrap();
        assert_eq!(problems(&back), Vec::<String>::new(), "{name}");
        assert_eq!(Dataset::read(&back).unwrap(), original, "{name}");
        // Whatever a fit reads is the same in every byte, at the scale that the layout has.
        let documents = [
            "dataset.json",
            "metadata.json",
            "scene.json",
            "camera",
            "annotations.yml",
            "mapping.yml",
            "annotations",
            "attributes.toml",
            "takes.toml",
        ];
        assert_same(&files_in(&back, &documents), &files_in(&data, &documents), name);
        let mut pictures = vec!["rgb/2x", "regions/2x", "head/2x"];
        if target == Target::Nerfies {
            pictures.extend(["rgb/4x", "regions/4x", "head/4x"]);
        }
        if target == Target::Parquet {
            // Its tables tell of the frames that were not chosen, too.
            assert_same(&files_in(&back, &["tables"]), &files_in(&data, &["tables"]), name);
        }
        let found = files_in(&back, &pictures);
        assert_same(&found, &files_in(&data, &pictures), name);
        assert!(found.len() >= 2 * 30 + 10);
    }
}

#[test]
fn a_camera_that_somebody_moved_counts() {
    let (dir, data) = built(|_| {});
    let (out, back) = (dir.path().join("out"), dir.path().join("back"));
    export(&data, Target::Transforms, &out, &Silent).unwrap();
    let path = out.join("transforms.json");
    let mut json: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    json["frames"][3]["transform_matrix"][0][3] = serde_json::json!(0.5);
    std::fs::write(&path, serde_json::to_vec(&json).unwrap()).unwrap();
    import(&out, &back, &ImportOptions::default(), &Silent).unwrap();
    let (a, b) = (Dataset::read(&data).unwrap(), Dataset::read(&back).unwrap());
    let moved = b.cameras[&a.ids[3]];
    assert!((moved.center().x - 0.5).abs() < 1e-6 && moved.intrinsics == a.cameras[&a.ids[3]].intrinsics);
    assert_eq!(a.cameras[&a.ids[4]], b.cameras[&a.ids[4]]);
}

#[test]
fn damage_to_an_export_is_found_with_its_path() {
    let (dir, data) = built(|_| {});
    let id = Dataset::read(&data).unwrap().ids[2].clone();
    for (target, name) in &TARGETS[1..] {
        let out = dir.path().join(name);
        export(&data, *target, &out, &Silent).unwrap();
        let picture = out.join("images").join(format!("{id}.png"));
        std::fs::write(&picture, b"\x89PNG").unwrap();
        let found = problems(&out);
        assert!(found.len() == 1 && found[0].contains(&format!("{id}.png: cannot be decoded")), "{name}: {found:?}");
        std::fs::remove_file(&picture).unwrap();
        assert!(problems(&out)[0].ends_with("does not exist"));
        // An import says which picture vanished and leaves nothing.
        let error = import(&out, &dir.path().join("back"), &ImportOptions::default(), &Silent).unwrap_err();
        assert!(error.to_string().contains(&format!("{id}.png")) && error.hint().is_some(), "{error}");
        assert!(!dir.path().join("back").exists());
    }
    let path = dir.path().join("transforms/transforms.json");
    let text = std::fs::read_to_string(&path).unwrap();
    std::fs::write(&path, text.replacen("images/", "../images/", 1)).unwrap();
    assert!(problems(&dir.path().join("transforms")).iter().any(|p| p.contains("leads out of the folder")));
    std::fs::write(&path, &text[..text.len() / 2]).unwrap();
    let found = problems(&dir.path().join("transforms"));
    assert!(found.len() == 1 && found[0].contains("transforms.json: line"), "{found:?}");
    std::fs::write(dir.path().join("colmap/sparse/0/images.txt"), "1 1 0 0\n").unwrap();
    assert!(problems(&dir.path().join("colmap"))[0].contains("images.txt"));
    std::fs::write(dir.path().join("parquet/frames.parquet"), b"PAR1PAR1").unwrap();
    assert!(problems(&dir.path().join("parquet"))[0].contains("frames.parquet: is not a Parquet table"));
}

/// A CoNeRF folder by hand: three classes, few annotated frames, outlines of their own.
fn conerf(dir: &Path, data: &Path) -> PathBuf {
    let out = dir.join("conerf");
    export_with(data, Target::Nerfies, &out, ExportOptions { plain: true }, &Silent).unwrap();
    let mut dataset = Dataset::read(&out).unwrap();
    dataset.mapping = vec!["left eye".into(), "right eye".into(), "AU26".into()];
    dataset.annotations.clear();
    for (k, id) in dataset.ids.iter().enumerate() {
        let path = nerfies::polygons_path(&out, id);
        if k % 10 != 0 {
            std::fs::remove_file(path).unwrap();
            continue;
        }
        let frame: u32 = id.parse().unwrap();
        let value = if k == 0 { -1.0 } else { 1.0 };
        dataset.annotations.extend((0..3).map(|class| Annotation { class, frame, value }));
        let square = |label: &str, x: f64| Polygon {
            label: label.to_owned(),
            points_px: vec![[x, 20.0], [x + 20.0, 20.0], [x + 20.0, 40.0], [x, 40.0]],
        };
        let polygons = vec![square("left eye", 10.0), square("right eye", 40.0), square("AU26", 70.0)];
        Polygons { polygons, image_path: None, image_size: None }.write(path).unwrap();
    }
    dataset.write(&out).unwrap();
    out
}

#[test]
fn a_conerf_folder_becomes_a_dataset() {
    let (dir, data) = built(|_| {});
    let folder = conerf(dir.path(), &data);
    let back = dir.path().join("back");
    let error = import(&folder, &back, &ImportOptions::default(), &Silent).unwrap_err();
    assert!(error.to_string().contains("left eye, right eye are no AUs"), "{error}");
    assert!(error.hint().unwrap().contains("--au \"left eye=AU12\"") && !back.exists());

    let units = [("left eye".to_owned(), ActionUnit(46)), ("right eye".to_owned(), ActionUnit(45))].into();
    let how = ImportOptions { units, ..ImportOptions::default() };
    let report = import(&folder, &back, &how, &Silent).unwrap();
    assert_eq!(problems(&back), Vec::<String>::new());
    let (dataset, table) = (Dataset::read(&back).unwrap(), AttributeTable::read(back.join("attributes.toml")).unwrap());
    assert_eq!(dataset.mapping, ["AU46", "AU45", "AU26"]);
    assert_eq!(table.regions, ["region-1", "eye", "mouth"]);
    assert_eq!((report.chosen, report.candidates), (30, 3));
    assert_eq!(dataset.annotations.len(), 9);
    let first: u32 = dataset.ids[0].parse().unwrap();
    assert!(dataset.annotations.iter().all(|a| a.value == if a.frame == first { -1.0 } else { 1.0 }));
    let labels = LabelImage::read_png(nerfies::region_path(&back, 2, &dataset.ids[10])).unwrap();
    assert_eq!([labels.get(8, 15), labels.get(25, 15), labels.get(40, 15), labels.get(50, 50)], [1, 2, 3, 0]);
    assert_eq!(dataset.extras.as_ref().unwrap().ids_without_masks.len(), 27);
    // The head is looked at: in front of every camera.
    let head = dataset.extras.as_ref().unwrap().head_center;
    assert!(dataset.cameras.values().all(|c| c.camera_from_world.transform_point(head).z > 0.0));
}

#[test]
fn folders_that_cannot_be_steered_are_refused() {
    let (dir, data) = built(|_| {});
    let back = dir.path().join("back");
    let plain = ExportOptions { plain: true };
    for (target, name) in TARGETS {
        let out = dir.path().join(name);
        export_with(&data, target, &out, plain, &Silent).unwrap();
        assert!(!out.join("risorius").exists());
        assert_eq!(problems(&out), Vec::<String>::new());
        if target == Target::Nerfies {
            // Ours has AUs for classes: it imports as CoNFies' do, region by region.
            import(&out, &back, &ImportOptions::default(), &Silent).unwrap();
            let table = AttributeTable::read(back.join("attributes.toml")).unwrap();
            assert_eq!(
                (table.regions.as_slice(), table.attributes.len()),
                (&["brow", "eye", "mouth"].map(String::from)[..], 17)
            );
            let masks = ["regions", "rgb", "annotations"];
            assert_same(&files_in(&back, &masks), &files_in(&data, &masks), name);
            std::fs::remove_file(out.join("annotations.yml")).unwrap();
            std::fs::remove_dir_all(&back).unwrap();
        }
        let error = import(&out, &back, &ImportOptions::default(), &Silent).unwrap_err();
        assert!(error.to_string().contains("attributes") && error.hint().is_some(), "{error}");
        assert!(!back.exists());
    }
    for bad in [dir.path().join("nothing"), dir.path().join("take"), data.join("dataset.json")] {
        assert!(import(&bad, &back, &ImportOptions::default(), &Silent).unwrap_err().hint().is_some());
    }
    assert!(import(&data, &data.join("inner"), &ImportOptions::default(), &Silent).is_err());
}

fn two_takes() -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    for name in ["first", "secret take"] {
        let mut take = common::take();
        take.manifest.subject = "S01".into();
        take.manifest.consent = format!("consent of {name}");
        take.write(&dir.path().join(name));
    }
    let data = dir.path().join("data");
    let all = BuildOptions { frames: 60, ..options() };
    build(&[dir.path().join("first"), dir.path().join("secret take")], &data, &all, &Silent).unwrap();
    (dir, data)
}

#[test]
fn a_redacted_take_leaves_no_trace() {
    let (_dir, data) = two_takes();
    let before = Dataset::read(&data).unwrap();
    let gone: Vec<&String> = before.ids.iter().filter(|id| id.starts_with('1')).collect();
    assert!(!gone.is_empty() && gone.len() < 60);
    let done = redact(&data, "secret take", &Silent).unwrap();
    assert_eq!((done.frames_removed, done.frames_left), (gone.len(), 60 - gone.len()));
    assert_eq!(problems(&data), Vec::<String>::new());
    let after = Dataset::read(&data).unwrap();
    for (path, bytes) in common::files(&data) {
        let name = path.display().to_string();
        let text = String::from_utf8_lossy(&bytes);
        for trace in ["secret", "secret%20take"].into_iter().chain(gone.iter().map(|id| id.as_str())) {
            assert!(!name.contains(trace), "{name}");
            assert!(path.extension().is_some_and(|e| e == "png") || !text.contains(trace), "{name} holds {trace}");
        }
    }
    // The rest is as it was, numbered anew.
    for (k, id) in after.train_ids.iter().enumerate() {
        assert_eq!(after.metadata[id].warp_id as usize, k);
        assert_eq!(after.cameras[id], before.cameras[id]);
    }
    let rows = tables::read(&data).unwrap();
    assert_eq!((rows.takes.len(), rows.takes[0].frames.len()), (1, 90));
    // The last take, and one that is not there, are refused, and nothing changes.
    let files = common::files(&data);
    for name in ["first", "secret take"] {
        assert!(redact(&data, name, &Silent).unwrap_err().hint().is_some());
    }
    assert_same(&common::files(&data).into_iter().collect(), &files.into_iter().collect(), "after a refusal");
}

#[test]
fn the_first_take_can_go_too_and_exports_still_work() {
    let (dir, data) = two_takes();
    redact(&data, "first", &Silent).unwrap();
    assert_eq!(problems(&data), Vec::<String>::new());
    let after = Dataset::read(&data).unwrap();
    assert!(after.ids.iter().all(|id| id.starts_with('1')));
    assert_eq!(after.extras.as_ref().unwrap().takes, ["redacted", "secret take"]);
    let (out, back) = (dir.path().join("out"), dir.path().join("back"));
    export(&data, Target::Parquet, &out, &Silent).unwrap();
    import(&out, &back, &ImportOptions::default(), &Silent).unwrap();
    assert_eq!(Dataset::read(&back).unwrap(), after);
}

#[test]
fn a_survey_counts_what_the_datasets_hold() {
    let (_a, one) = built(|_| {});
    let (_b, two) = two_takes();
    let got = survey::survey(&[one.clone(), two.clone()], &Silent).unwrap();
    assert_eq!((got.chosen, got.datasets[0].chosen, got.datasets[1].chosen), (90, 30, 60));
    assert_eq!(got.datasets[1].subjects, ["S01"]);
    assert_eq!(got.active_in[&ActionUnit(12)], 2);
    assert!(!got.active_in.contains_key(&ActionUnit(6)));
    assert_eq!(got.levels[&ActionUnit(12)].iter().sum::<usize>(), 90);
    // What the table says is what the report says.
    let report: serde_json::Value =
        serde_json::from_slice(&std::fs::read(one.join("report/stats.json")).unwrap()).unwrap();
    let alone = survey::survey(&[one], &Silent).unwrap();
    for a in report["attributes"].as_array().unwrap().iter().filter(|a| a["active"] == true) {
        let unit: ActionUnit = a["unit"].as_str().unwrap().parse().unwrap();
        let expected: Vec<usize> =
            a["histogram_after"].as_array().unwrap().iter().map(|v| v.as_u64().unwrap() as usize).collect();
        assert_eq!(alone.levels[&unit], expected, "{unit}");
    }
    let error = survey::survey(&[two.join("nothing")], &Silent).unwrap_err();
    assert!(error.hint().is_some());
}

#[test]
fn a_package_tells_neither_machine_nor_place() {
    let (dir, data) = built(|_| {});
    let host = std::fs::read_to_string("/etc/hostname").unwrap_or_default().trim().to_owned();
    let place = dir.path().display().to_string();
    let mut folders = vec![data.clone()];
    for (target, name) in TARGETS {
        let out = dir.path().join(name);
        export(&data, target, &out, &Silent).unwrap();
        folders.push(out);
    }
    for folder in folders {
        for (path, bytes) in common::files(&folder) {
            let found = |word: &str| word.len() > 3 && bytes.windows(word.len()).any(|w| w == word.as_bytes());
            assert!(!found(&place), "{} holds {place}", path.display());
            assert!(!found(&host), "{} holds {host}", path.display());
            for word in ["/home/", "/root/", "/tmp/", "file://"] {
                assert!(!found(word), "{} holds {word}", path.display());
            }
        }
    }
    // Whom it shows and under which consent goes along.
    let card = std::fs::read_to_string(dir.path().join("parquet/README.md")).unwrap();
    assert!(card.contains("S01") && card.contains("research only"));
    let takes = std::fs::read_to_string(data.join("takes.toml")).unwrap();
    assert!(takes.contains("S01") && takes.contains("research only"));
}

#[test]
fn warnings_of_an_import_are_counted() {
    let (dir, data) = built(|_| {});
    let folder = conerf(dir.path(), &data);
    let id = Dataset::read(&folder).unwrap().ids[0].clone();
    let path = nerfies::polygons_path(&folder, &id);
    let mut polygons = Polygons::read(&path).unwrap();
    polygons.polygons.push(Polygon { label: "hat".into(), points_px: vec![[0.0, 0.0], [5.0, 0.0], [0.0, 5.0]] });
    polygons.write(&path).unwrap();
    let units = [("left eye".to_owned(), ActionUnit(46)), ("right eye".to_owned(), ActionUnit(45))].into();
    let collected = Collected::default();
    import(&folder, &dir.path().join("back"), &ImportOptions { units, ..ImportOptions::default() }, &collected)
        .unwrap();
    assert_eq!(collected.count("unknown-class"), 1);
    let twice = [("left eye".to_owned(), ActionUnit(26)), ("right eye".to_owned(), ActionUnit(45))].into();
    let how = ImportOptions { units: twice, ..ImportOptions::default() };
    let error = import(&folder, &dir.path().join("b2"), &how, &Silent).unwrap_err();
    assert!(error.to_string().contains("two classes stand for AU26"), "{error}");
}
