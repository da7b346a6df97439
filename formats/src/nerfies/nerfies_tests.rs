use std::fs;

use proptest::prelude::*;

use super::*;
use crate::{ErrorKind, Intrinsics, Isometry};

fn dataset(ids: &[&str]) -> Dataset {
    let ids: Vec<String> = ids.iter().map(|&i| i.to_owned()).collect();
    let camera = |i: usize| {
        let pose = Isometry::from_wxyz([1.0, 0.0, 0.0, 0.0], DVec3::new(i as f64, 0.0, 2.0));
        Camera { intrinsics: Intrinsics::pinhole(64, 48, 50.0), camera_from_world: pose }
    };
    let metadata = |i: usize| FrameMetadata {
        warp_id: i as u32,
        appearance_id: i as u32,
        camera_id: 0,
        time_id: Some(10 * i as u32),
    };
    Dataset {
        train_ids: ids[1..].to_vec(),
        val_ids: ids[..1].to_vec(),
        metadata: ids.iter().enumerate().map(|(i, id)| (id.clone(), metadata(i))).collect(),
        cameras: ids.iter().enumerate().map(|(i, id)| (id.clone(), camera(i))).collect(),
        scene: SceneBounds { center_in_world: DVec3::new(0.1, 0.2, 0.3), scale: 0.5, near: 0.1, far: 1.5 },
        mapping: vec!["AU01".into(), "AU12".into()],
        annotations: vec![Annotation { class: 1, frame: 3, value: -0.25 }],
        extras: Some(Extras {
            version: 1,
            default_scale: 4,
            method: PoseMethod::ColmapModel,
            head_center: DVec3::ZERO,
            head_radius: 0.1,
            head_hull_in_world: None,
            units_per_metre: Some(1.0),
            takes: vec!["ada".into()],
            ids_without_masks: vec![ids[0].clone()],
            neutral_id: None,
            written_by: "test".into(),
        }),
        ids,
    }
}

fn written(ids: &[&str]) -> (tempfile::TempDir, Dataset) {
    let dir = tempfile::tempdir().unwrap();
    let data = dataset(ids);
    data.write(dir.path()).unwrap();
    (dir, data)
}

#[test]
fn a_dataset_comes_back_as_written_and_in_the_same_bytes() {
    let (dir, data) = written(&["000001", "000002", "000003"]);
    let back = Dataset::read(dir.path()).unwrap();
    assert_eq!(back, data);
    let again = tempfile::tempdir().unwrap();
    back.write(again.path()).unwrap();
    for name in ["dataset.json", "metadata.json", "scene.json", "mapping.yml", "annotations.yml", "camera/000002.json"]
    {
        assert_eq!(fs::read(dir.path().join(name)).unwrap(), fs::read(again.path().join(name)).unwrap(), "{name}");
    }
}

#[test]
fn the_keys_are_the_familys() {
    let (dir, _) = written(&["000001", "000002"]);
    let json = |name: &str| -> serde_json::Value {
        serde_json::from_slice(&fs::read(dir.path().join(name)).unwrap()).unwrap()
    };
    let d = json("dataset.json");
    assert_eq!((d["count"].as_u64(), d["num_exemplars"].as_u64()), (Some(2), Some(1)));
    assert_eq!(d["val_ids"][0], "000001");
    assert_eq!(json("metadata.json")["000002"]["time_id"], 10);
    assert_eq!(json("scene.json")["center"][2], 0.3);
    assert_eq!(json("camera/000001.json")["image_size"], serde_json::json!([64, 48]));
}

#[test]
fn a_folder_of_another_tool_is_read() {
    let (dir, data) = written(&["left1_000000", "right1_000000"]);
    let root = dir.path();
    fs::remove_file(root.join("mapping.yml")).unwrap();
    fs::remove_file(root.join("annotations.yml")).unwrap();
    let plain = r#"{"count": 2, "num_exemplars": 1, "ids": ["left1_000000", "right1_000000"], "train_ids": ["left1_000000"], "val_ids": []}"#;
    fs::write(root.join("dataset.json"), plain).unwrap();
    fs::write(
        root.join("metadata.json"),
        r#"{"left1_000000": {"warp_id": 7}, "right1_000000": {"warp_id": 8, "time_id": 3}, "x": {"warp_id": 1}}"#,
    )
    .unwrap();
    fs::write(
        root.join("scene.json"),
        r#"{"scale": 0.0387, "center": [1, 2, 3], "near": 0.0206, "far": 0.826, "bbox": [[0,0,0],[1,1,1]]}"#,
    )
    .unwrap();
    let got = Dataset::read(root).unwrap();
    assert!(got.extras.is_none() && got.mapping.is_empty() && got.annotations.is_empty());
    assert_eq!(got.cameras, data.cameras);
    assert_eq!((got.source_frame("left1_000000"), got.source_frame("right1_000000")), (Some(7), Some(3)));
    assert_eq!(got.source_frame("000042"), Some(42));
}

#[test]
fn ids_cannot_lead_out_of_the_folder() {
    for id in ["../x", "a/b", "..", ".", "", ".hidden", "a\\b", "c:x", "a\0b", &"9".repeat(300)] {
        assert!(check_id(id).is_err(), "{id:?}");
    }
    for id in ["000123", "left1_000000", "frame-3.b"] {
        check_id(id).unwrap();
    }
    let (dir, _) = written(&["000001", "000002"]);
    let path = dir.path().join("dataset.json");
    let text = fs::read_to_string(&path).unwrap().replace("000002", "../../000002");
    fs::write(&path, text).unwrap();
    let error = Dataset::read(dir.path()).unwrap_err();
    assert_eq!((error.kind(), error.path()), (ErrorKind::Inconsistent, Some(path.as_path())));
    let mut bad = dataset(&["000001", "000002"]);
    bad.ids[0] = "../x".into();
    assert!(bad.write(dir.path().join("new")).is_err());
    assert!(!dir.path().join("new").exists());
}

#[test]
fn what_is_missing_or_contradictory_is_named() {
    type Damage = fn(&Path);
    let cases: [(&str, Damage, &str); 8] = [
        ("dataset.json", |d| fs::remove_file(d.join("dataset.json")).unwrap(), "does not exist"),
        ("dataset.json", |d| fs::write(d.join("dataset.json"), "{\"ids\": []}").unwrap(), "no ids"),
        ("dataset.json", |d| fs::write(d.join("dataset.json"), "{\n\"ids\": [\"1\", 2]}").unwrap(), ":2:"),
        ("dataset.json", |d| fs::write(d.join("dataset.json"), r#"{"ids": ["1", "1"]}"#).unwrap(), "twice"),
        (
            "dataset.json",
            |d| fs::write(d.join("dataset.json"), r#"{"ids": ["1"], "val_ids": ["2"]}"#).unwrap(),
            "val_ids",
        ),
        ("metadata.json", |d| fs::write(d.join("metadata.json"), "{}").unwrap(), "000001"),
        (
            "scene.json",
            |d| fs::write(d.join("scene.json"), r#"{"scale":1,"center":[0,0,0],"near":2,"far":1}"#).unwrap(),
            "near 2",
        ),
        ("camera/000002.json", |d| fs::remove_file(d.join("camera/000002.json")).unwrap(), "does not exist"),
    ];
    for (name, damage, word) in cases {
        let (dir, _) = written(&["000001", "000002"]);
        damage(dir.path());
        let error = Dataset::read(dir.path()).unwrap_err();
        assert_eq!(error.path(), Some(dir.path().join(name).as_path()), "{error}");
        assert!(error.to_string().contains(word), "{error}");
    }
    let error = Dataset::read("no/such/folder").unwrap_err();
    assert!(crate::Hint::hint(&error).is_some() && error.to_string().starts_with("no/such/folder"));
}

proptest! {
    // Each case writes a folder of synced files.
    #![proptest_config(ProptestConfig::with_cases(48))]
    #[test]
    fn damaged_folders_never_make_it_panic(which in 0usize..6, at in 0usize..400, put in any::<u8>(), cut in any::<bool>()) {
        let (dir, _) = written(&["000001", "000002"]);
        let names = ["dataset.json", "metadata.json", "scene.json", "mapping.yml", "annotations.yml", "camera/000002.json"];
        let path = dir.path().join(names[which]);
        let mut bytes = fs::read(&path).unwrap();
        let at = at % bytes.len();
        if cut { bytes.truncate(at) } else { bytes[at] = put }
        fs::write(&path, bytes).unwrap();
        if let Err(error) = Dataset::read(dir.path()) {
            prop_assert!(error.path().is_some());
        }
    }
}
