//! Packages from strangers: names that lead out of their folder, links and pipes in the place of pictures. All are refused
//! with the file's name, nothing is read through them, and nothing is written outside.

#![cfg(unix)]

use std::os::unix::fs::symlink;
use std::path::Path;
use std::process::Command;

use risorius_formats::nerfies::Dataset;
use risorius_tests::{linked_copy, run};
use serde_json::Value;

use crate::support::{text, tiny};

/// What is done to a dataset and one of its ids.
type Change = Box<dyn Fn(&Path, &str)>;

/// A copy of the tiny dataset with one thing wrong.
fn wrong(change: impl FnOnce(&Path, &str)) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    linked_copy(&tiny().join("data"), &data);
    std::fs::write(dir.path().join("secret.png"), b"nobody's business").unwrap();
    let id = Dataset::read(&data).unwrap().train_ids[0].clone();
    change(&data, &id);
    dir
}

fn refused(name: &str, args: &[&str], words: &[&str]) {
    let output = run(name, args);
    let said = format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert_eq!(output.status.code(), Some(1), "{name} {args:?}: {said}");
    for word in words {
        assert!(said.contains(word), "{name} {args:?}: expected `{word}` in {said}");
    }
    assert!(!said.contains("nobody's business"), "{said}");
}

fn replace(path: &Path, put: impl FnOnce(&Path)) {
    std::fs::remove_file(path).unwrap();
    put(path);
}

#[test]
fn links_and_pipes_in_datasets_are_refused() {
    let picture = |data: &Path, id: &str| data.join(format!("rgb/2x/{id}.png"));
    let fifo = |path: &Path| assert!(Command::new("mkfifo").arg(path).status().unwrap().success());
    let changes: [(&str, &str, Change); 5] = [
        (
            "a link out",
            "leads out",
            Box::new(move |d, id| replace(&picture(d, id), |p| symlink("../../../secret.png", p).unwrap())),
        ),
        (
            "an endless device",
            "leads out",
            Box::new(move |d, id| replace(&picture(d, id), |p| symlink("/dev/zero", p).unwrap())),
        ),
        ("a pipe that nobody fills", "pipe", Box::new(move |d, id| replace(&picture(d, id), fifo))),
        (
            "a camera elsewhere",
            "leads out",
            Box::new(|d, id| replace(&d.join(format!("camera/{id}.json")), |p| symlink("/etc/hostname", p).unwrap())),
        ),
        (
            "masks elsewhere",
            "leads out",
            Box::new(|d, id| {
                replace(&d.join(format!("regions/2x/{id}.png")), |p| symlink("../../../secret.png", p).unwrap());
            }),
        ),
    ];
    for (name, words, change) in changes {
        let dir = wrong(|d, id| change(d, id));
        let (data, out) = (dir.path().join("data"), dir.path().join("out"));
        refused("dataset", &["verify", text(&data), "-q"], &[words]);
        refused("trainer", &["fit", text(&data), "--out", text(&out), "--steps", "2", "-q"], &[words]);
        // An import of a folder that is no export of ours leaves its masks alone.
        if name != "masks elsewhere" {
            refused("dataset", &["import", text(&data), "--out", text(&out), "-q"], &["error: "]);
        }
        assert!(!out.join("model.json").exists(), "{name}");
    }
}

fn edit(path: &Path, change: impl FnOnce(&mut Value)) {
    let mut value: Value = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    change(&mut value);
    replace(path, |p| std::fs::write(p, value.to_string()).unwrap());
}

#[test]
fn names_that_lead_out_are_refused() {
    for bad in ["../secret", "/etc/passwd", "..", "a/b", "a\\b", "C:x", "a\u{0}b", ""] {
        let dir = wrong(|data, _| edit(&data.join("dataset.json"), |v| v["ids"][0] = bad.into()));
        refused("dataset", &["verify", text(&dir.path().join("data")), "-q"], &["cannot be a file name"]);
    }
    // Views: the id is written.
    let dir = tempfile::tempdir().unwrap();
    let views = dir.path().join("views.json");
    let camera =
        r#"{"width":16,"height":16,"fx":20,"fy":20,"cx":8,"cy":8,"camera_from_world":[[1,0,0,0],[0,1,0,0],[0,0,1,2]]}"#;
    let run_dir = tiny().join("splat");
    for (id, image, words) in [("../out", "a.png", "plain file name"), (".hidden", "a.png", "plain file name")] {
        std::fs::write(&views, format!(r#"{{"views":[{{"id":"{id}","image":"{image}","camera":{camera}}}]}}"#))
            .unwrap();
        let out = dir.path().join("out");
        refused("trainer", &["render", text(&run_dir), "--views", text(&views), "--out", text(&out), "-q"], &[words]);
        refused(
            "trainer",
            &["eval", text(&run_dir), "--views", text(&views), "--lpips", "none", "--out", text(&out), "-q"],
            &[words],
        );
        assert!(!dir.path().join("out.png").exists());
    }
    // Networks.
    let models = dir.path().join("models");
    std::fs::create_dir(&models).unwrap();
    std::fs::write(
        models.join("models.toml"),
        "version = 1\n[detector]\nfile = \"../../../etc/passwd\"\nkind = \"boxes\"\nwidth = 320\nheight = 240\nlayout = \"nchw\"\nscale = 0.0078125\nboxes = \"b\"\nscores = \"s\"\n[landmarks]\nfile = \"l.onnx\"\nkind = \"points68\"\nwidth = 64\nheight = 64\nlayout = \"nhwc\"\nscale = 0.0039\npoints = \"p\"\n",
    )
    .unwrap();
    let take = dir.path().join("take");
    linked_copy(&tiny().join("take"), &take);
    refused("tracker", &["run", text(&take), "--models", text(&models), "-q"], &["leads out"]);
}

#[test]
fn names_in_models_and_tables_stay_words() {
    // A COLMAP model names pictures wherever it likes: only the frame number in the name counts.
    let dir = tempfile::tempdir().unwrap();
    let (model, take) = (dir.path().join("model"), dir.path().join("take"));
    linked_copy(&tiny().join("capture/truth_colmap"), &model);
    linked_copy(&tiny().join("take"), &take);
    let images = std::fs::read_to_string(model.join("images.txt")).unwrap();
    let lines: Vec<String> = images
        .lines()
        .map(|l| match l.rsplit_once(' ') {
            Some((front, name)) if Path::new(name).extension().is_some_and(|e| e == "png") => {
                format!("{front} ../../../evil/{name}")
            }
            _ => l.to_owned(),
        })
        .collect();
    replace(&model.join("images.txt"), |p| std::fs::write(p, lines.join("\n") + "\n").unwrap());
    let output = run("tracker", &["poses", text(&take), "--colmap-model", text(&model), "-q"]);
    assert!(matches!(output.status.code(), Some(0 | 1)), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(!dir.path().join("evil").exists() && !dir.path().parent().unwrap().join("evil").exists());
    if output.status.success() {
        let written = std::fs::read_to_string(take.join("poses/sparse/images.txt")).unwrap();
        assert!(!written.contains(".."), "names are the frames' numbers");
    }
    // The name of a take becomes a folder of tables.
    let dir = wrong(|data, _| {
        let path = data.join("takes.toml");
        let text = std::fs::read_to_string(&path).unwrap();
        let name = "name = \"../../../evil\"";
        let lines: Vec<&str> = text.lines().map(|l| if l.starts_with("name") { name } else { l }).collect();
        replace(&path, |p| std::fs::write(p, lines.join("\n")).unwrap());
    });
    let (data, out) = (dir.path().join("data"), dir.path().join("out"));
    let output = run("dataset", &["import", text(&data), "--out", text(&out), "-q"]);
    assert!(matches!(output.status.code(), Some(0 | 1)), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(!dir.path().join("evil").exists() && !dir.path().parent().unwrap().join("evil").exists());
}
