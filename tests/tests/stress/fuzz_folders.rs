//! Folders with a mutated or hostile file in them: datasets, avatars of both fields, takes. Refused or taken, but never a
//! panic, and never memory out of proportion.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use burn::tensor::Device;
use risorius_dataset::verify::verify;
use risorius_formats::{Silent, Take};
use risorius_tests::linked_copy;
use risorius_trainer::Avatar;
use risorius_trainer::data::TrainData;
use serde_json::{Value, json};

use crate::MEMORY;
use crate::fuzz_files::times;
use crate::mutate::mutation;
use crate::support::tiny;

fn put(path: &Path, bytes: &[u8]) {
    // It may be a link into the fixture.
    let _ = std::fs::remove_file(path);
    std::fs::write(path, bytes).unwrap();
}

/// Runs `open`, which must neither panic nor take more than `room` bytes; gives what it gives.
fn safely<T>(what: &str, room: usize, open: impl FnOnce() -> T) -> T {
    MEMORY.reset_peak_usage();
    let before = MEMORY.current_usage();
    let result = catch_unwind(AssertUnwindSafe(open));
    let used = MEMORY.peak_usage().saturating_sub(before);
    assert!(used < room, "{what} took {} MiB", used >> 20);
    result.unwrap_or_else(|_| panic!("{what}: panicked"))
}

#[test]
fn datasets_with_a_mutated_file() {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    linked_copy(&tiny().join("data"), &data);
    let files = [
        "dataset.json",
        "metadata.json",
        "scene.json",
        "annotations.yml",
        "mapping.yml",
        "attributes.toml",
        "intensities.csv",
        "landmarks.csv",
        "takes.toml",
    ];
    let (mut taken, mut refused) = (0, 0);
    for name in files {
        let path = data.join(name);
        let Ok(sound) = std::fs::read(&path) else { panic!("{name} is not there") };
        for n in 0..40 * times() {
            put(&path, &mutation(std::slice::from_ref(&sound), n));
            let what = format!("{name}, mutation {n}");
            let loaded = safely(&what, 512 << 20, || TrainData::load(&data, 0, &Silent).map_err(|e| e.to_string()));
            if n % 8 == 0 {
                safely(&what, 512 << 20, || verify(&data, &Silent));
            }
            match loaded {
                Ok(loaded) => {
                    taken += 1;
                    let sound = loaded.frames.iter().all(|f| {
                        let attributes = f.attributes.iter().flatten().all(|v| v.0.is_finite());
                        attributes && f.intensities.iter().flatten().all(|v| v.0.is_finite())
                    });
                    assert!(sound && loaded.dataset.scene.is_valid(), "{what}: a number that is none");
                }
                Err(_) => refused += 1,
            }
        }
        put(&path, &sound);
    }
    eprintln!("datasets: {taken} taken, {refused} refused");
    assert!(taken > 0 && refused > 0);
    assert!(TrainData::load(&data, 0, &Silent).is_ok());
}

#[test]
fn takes_with_a_mutated_file() {
    let dir = tempfile::tempdir().unwrap();
    let take = dir.path().join("take");
    linked_copy(&tiny().join("take"), &take);
    for name in ["take.toml", "frames.csv"] {
        let path = take.join(name);
        let sound = std::fs::read(&path).unwrap();
        for n in 0..400 * times() {
            put(&path, &mutation(std::slice::from_ref(&sound), n));
            let what = format!("{name}, mutation {n}");
            let _ = safely(&what, 64 << 20, || {
                let opened = Take::open(&take)?;
                assert!(opened.fps().is_finite(), "{what}: {} frames per second", opened.fps());
                let all =
                    risorius_tracker::poses::keyframes::choose(&opened.frames, &risorius_formats::Track::default(), 5);
                assert!(all.len() <= opened.frames.len());
                Ok::<_, risorius_formats::FormatError>(())
            });
        }
        put(&path, &sound);
    }
}

/// `model.json` with one number that nothing good comes of.
fn hostile_descriptions(field: &str) -> Vec<(&'static str, Value)> {
    let splat = vec![
        ("/layout/images", json!(1_000_000_000_000u64)),
        ("/layout/regions", json!(200)),
        ("/layout/region_of/0", json!(999)),
        ("/layout/region_of/0", json!(3)),
        ("/layout/region_of", json!(vec![0; 100_000])),
        ("/layout/region_of", json!([])),
        ("/layout/latent", json!(1u64 << 62)),
        ("/layout/latent", json!(-1)),
        ("/groups", json!(0)),
        ("/groups", json!(1u64 << 60)),
        ("/deformable", json!(1u64 << 60)),
        ("/space/metres_per_unit", json!(0)),
        ("/space/metres_per_unit", json!(-1)),
        ("/space/metres_per_unit", json!(1e300)),
        ("/space/origin_in_world/1", json!(1e300)),
        ("/space/metric_from_world/0", json!(100)),
        ("/plate", json!([65535, 65535])),
        ("/plate", json!([0, 0])),
    ];
    let confies = vec![
        ("/frames", json!(1u64 << 50)),
        ("/frames", json!(0)),
        ("/coarse_samples", json!(1u64 << 50)),
        ("/fine_samples", json!(0)),
        ("/model/latent_dims", json!(1u64 << 40)),
        ("/model/hyper_dims", json!(0)),
        ("/model/template/width", json!(1u64 << 40)),
        ("/model/template/depth", json!(1u64 << 40)),
        ("/model/mask/branch", json!(1u64 << 40)),
        ("/model/template_bands", json!(1u64 << 40)),
        ("/model/color_width", json!(0)),
        ("/space/scale", json!(0)),
        ("/space/near", json!(-1)),
        ("/space/center_in_world/0", json!(1e300)),
    ];
    let both = vec![
        ("/table/attributes", json!([])),
        ("/attribute", json!([])),
        ("/table/attribute/0/region", json!(99)),
        ("/table/regions", json!([])),
        ("/default_camera/width", json!(4_000_000_000u32)),
        ("/default_camera/fx", json!(0)),
        ("/default_camera/camera_from_world/0/0", json!(100)),
        ("/default_camera/camera_from_world/0/3", json!(1e300)),
        ("/center_in_world/0", json!(1e300)),
        ("/neutral_frame", json!(1u64 << 60)),
        ("/orbit_rad/0", json!(1e300)),
        ("/field", json!("none")),
    ];
    if field == "splat" { [splat, both].concat() } else { [confies, both].concat() }
}

/// Opens an avatar and takes a small picture with it.
fn look(run: &Path) -> Result<(), String> {
    let avatar = Avatar::open(run, &Device::flex()).map_err(|e| e.to_string())?;
    let camera = risorius_formats::Camera::from(&avatar.saved.default_camera).reduced(8);
    let render = avatar.render(&camera, &avatar.neutral(), &Silent).map_err(|e| e.to_string())?;
    assert!(render.depth.iter().chain(render.masks.iter().flatten()).all(|v| v.is_finite()), "a number that is none");
    Ok(())
}

#[test]
fn avatars_with_a_hostile_description() {
    for field in ["splat", "confies"] {
        let dir = tempfile::tempdir().unwrap();
        let run = dir.path().join("run");
        linked_copy(&tiny().join(field), &run);
        assert_eq!(look(&run), Ok(()), "{field}");
        let path = run.join("model.json");
        let sound = std::fs::read(&path).unwrap();
        let document: Value = serde_json::from_slice(&sound).unwrap();
        let mut refused = 0;
        let hostile = hostile_descriptions(field);
        let count = hostile.len();
        for (place, value) in hostile {
            let mut changed = document.clone();
            let Some(at) = changed.pointer_mut(place) else { continue };
            *at = value.clone();
            put(&path, changed.to_string().as_bytes());
            // A sound model takes a few hundred megabytes.
            refused += usize::from(safely(&format!("{field}: {place} = {value}"), 2 << 30, || look(&run)).is_err());
        }
        // And what a bad disk makes of it.
        for n in 0..15 * times() {
            put(&path, &mutation(std::slice::from_ref(&sound), n));
            refused += usize::from(safely(&format!("{field}, mutation {n}"), 2 << 30, || look(&run)).is_err());
        }
        eprintln!("{field}: {refused} of {count} descriptions and {} mutations refused", 15 * times());
        assert!(refused > count / 2);
    }
}

#[test]
fn avatars_with_hostile_arrays() {
    let dir = tempfile::tempdir().unwrap();
    let run = dir.path().join("run");
    linked_copy(&tiny().join("splat"), &run);
    let path = run.join("model.safetensors");
    let sound = std::fs::read(&path).unwrap();
    let head = 8 + u64::from_le_bytes(sound[..8].try_into().unwrap()) as usize;
    let header: Value = serde_json::from_slice(&sound[8..head]).unwrap();
    let place = |name: &str| {
        let at = |i: usize| header[name]["data_offsets"][i].as_u64().unwrap() as usize + head;
        at(0)..at(1)
    };
    let broken = |change: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = sound.clone();
        change(&mut bytes);
        put(&path, &bytes);
        safely("arrays", 2 << 30, || look(&run))
    };
    let long_header = |n: u64| move |b: &mut Vec<u8>| b[..8].copy_from_slice(&n.to_le_bytes());
    assert!(broken(&|b| b.truncate(7)).is_err());
    assert!(broken(&|b| b.truncate(head - 1)).is_err());
    assert!(broken(&|b| b.truncate(head + 100)).is_err());
    assert!(broken(&|b| b.clear()).is_err());
    assert!(broken(&long_header(u64::MAX)).is_err());
    assert!(broken(&long_header(1 << 60)).is_err());
    assert!(broken(&long_header(0)).is_err());
    // Numbers that are none, of either width.
    let half = |bits: u16| bits.to_le_bytes().to_vec();
    let [nan, inf, most] = [f32::NAN, f32::INFINITY, f32::MAX].map(|v| v.to_le_bytes().to_vec());
    let halves = [half(0x7e00), half(0x7c00), half(0x7bff)];
    for name in ["mean", "log_scale", "quaternion", "opacity", "color", "sh1", "membership", "delta_scales", "gates"] {
        let start = place(name).start;
        let [nan, inf, most] = if name == "mean" { [&nan, &inf, &most] } else { halves.each_ref() };
        let with = |value: &Vec<u8>| broken(&|b| b[start..start + value.len()].copy_from_slice(value));
        for value in [nan, inf] {
            let said = with(value).unwrap_err();
            assert!(said.contains(name), "{said}");
        }
        // Finite, but as large as can be: a picture all the same.
        let _ = with(most);
    }
    for n in 0..10 * times() {
        put(&path, &mutation(std::slice::from_ref(&sound), n));
        let _ = safely(&format!("mutation {n}"), 2 << 30, || look(&run));
    }
}
