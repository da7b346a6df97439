//! What a stranger's bad input is answered with: one clear line with the file, a hint, exit status 1, nothing left.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::fs;
use std::path::{Path, PathBuf};

use risorius_tests::{run, succeed, text};

/// A small capture, taken, tracked and posed.
struct Bench {
    dir: tempfile::TempDir,
}

impl Bench {
    fn new() -> Self {
        let bench = Self { dir: tempfile::tempdir().unwrap() };
        let (capture, take) = (bench.at("capture"), bench.at("take"));
        succeed("synth", &["-q", "--out", text(&capture), "--frames", "40", "--size", "96x160", "--fps", "30"]);
        let video = capture.join("video.mp4");
        succeed("capture", &["-q", "record", "--input", text(&video), "--out", text(&take)]);
        bench.import();
        let model = capture.join("truth_colmap");
        succeed("tracker", &["-q", "poses", text(&take), "--colmap-model", text(&model)]);
        bench
    }

    fn import(&self) {
        let table = self.at("capture/openface.csv");
        succeed("tracker", &["-q", "import", text(&self.at("take")), "--openface", text(&table)]);
    }

    fn at(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    fn file(&self, name: &str, bytes: &[u8]) -> PathBuf {
        fs::write(self.at(name), bytes).unwrap();
        self.at(name)
    }

    /// Runs a command that has to fail, and gives what it said: `error: …`, a blank line, `hint: …`.
    fn fails(&self, name: &str, args: &[&str]) -> String {
        let before = self.entries();
        let output = run(name, &[&["-q"], args].concat());
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{name} {args:?}: {said}");
        let lines: Vec<&str> = said.lines().filter(|l| !l.starts_with("warning")).collect();
        assert!(lines.len() == 3 && lines[0].starts_with("error: ") && lines[2].starts_with("hint: "), "{said}");
        assert!(said.chars().all(|c| c == '\n' || !c.is_control() && c != '\u{fffd}'), "{said:?}");
        assert_eq!(self.entries(), before, "{name} {args:?} left something: {said}");
        said
    }

    fn entries(&self) -> Vec<PathBuf> {
        let list = |dir: &Path| fs::read_dir(dir).unwrap().map(|e| e.unwrap().path()).collect::<Vec<_>>();
        let mut all = list(self.dir.path());
        all.extend(list(&self.at("take")));
        all.sort();
        all
    }
}

#[test]
fn every_bad_input_is_answered_with_its_place_and_advice() {
    let bench = Bench::new();
    let (take, capture, out) = (bench.at("take"), bench.at("capture"), bench.at("out"));
    let binary = bench.file("binary", b"\x7fELF\x02\x01\0\0\0\xff\xfe\n\x1b[31m,\x80");
    let empty = bench.file("empty", b"");
    fs::create_dir(bench.at("folder")).unwrap();
    let folder = bench.at("folder");
    let says = |said: &str, words: &str| assert!(said.contains(words), "expected `{words}` in: {said}");

    // Videos.
    let video = fs::read(capture.join("video.mp4")).unwrap();
    let cut = bench.file("cut.mp4", &video[..video.len() * 2 / 3]);
    for (input, words) in [
        (&bench.at("none.mp4"), "none.mp4: does not exist"),
        (&empty, "empty: is empty"),
        (&binary, "binary: is not a video"),
        (&folder, "folder: has no PNG or JPEG"),
        (&cut, "cut.mp4: is truncated"),
    ] {
        says(&bench.fails("capture", &["record", "--input", text(input), "--out", text(&out)]), words);
    }
    let video = capture.join("video.mp4");
    for (to, words) in [
        (&empty.join("take"), "empty: cannot create the folder: a file is in its place"),
        (&take, "take: already exists"),
        (&PathBuf::from("/proc/take"), "/proc/take: cannot create the folder: nothing can be made there"),
    ] {
        says(&bench.fails("capture", &["record", "--input", text(&video), "--out", text(to)]), words);
    }

    // Tables.
    let table = fs::read_to_string(capture.join("openface.csv")).unwrap();
    let bad_cell = bench.file("cell.csv", table.replacen("\n2,", "\nx,", 1).replacen("\n2, ", "\nx, ", 1).as_bytes());
    for (input, words) in [
        (&bench.at("none.csv"), "none.csv: does not exist"),
        (&empty, "empty: the table is empty"),
        (&folder, "folder: is a folder, not a file"),
        (&binary, "binary:1: is not a text table"),
        (&take.join("frames.csv"), "frames.csv:1: there is no column `frame`"),
        (&bad_cell, "cell.csv:3: column `frame`: expected a whole number from 0, found `x`"),
    ] {
        says(&bench.fails("tracker", &["import", text(&take), "--openface", text(input)]), words);
    }

    // COLMAP models.
    let model = bench.at("model");
    fs::create_dir(&model).unwrap();
    for (name, bytes, words) in [
        ("images.txt", &b"# nothing\n"[..], "model: the model has no registered images"),
        ("images.txt", b"\x7fELF\xff\xfe", "images.txt:1: column `IMAGE_ID`: is not text"),
        ("cameras.txt", b"", "has camera `1`, which the model does not hold"),
    ] {
        for part in ["cameras.txt", "images.txt", "points3D.txt"] {
            fs::copy(capture.join("truth_colmap").join(part), model.join(part)).unwrap();
        }
        fs::write(model.join(name), bytes).unwrap();
        says(&bench.fails("tracker", &["poses", text(&take), "--colmap-model", text(&model)]), words);
    }
    says(&bench.fails("tracker", &["poses", text(&take), "--colmap-model", text(&folder)]), "is not a COLMAP model");

    // A take whose frames were damaged, and one without a face.
    let frames = fs::read_to_string(take.join("frames.csv")).unwrap();
    for (damaged, words) in [
        (String::new(), "frames.csv: the table is empty"),
        (frames[..frames.len() - 9].to_owned(), "frames.csv:41: "),
        (frames.replacen("\n3,", "\n4,", 1), "frames.csv:5: column `index`: expected frame 3, found 4"),
    ] {
        fs::write(take.join("frames.csv"), damaged).unwrap();
        says(&bench.fails("capture", &["check", text(&take)]), words);
    }
    fs::write(take.join("frames.csv"), frames).unwrap();
    let tracked = take.join("track/openface.csv");
    let header = table.lines().next().unwrap();
    let place = |name: &str| header.split(',').position(|c| c.trim() == name).unwrap();
    let (success, confidence) = (place("success"), place("confidence"));
    let faceless = |line: &str| {
        let mut cells: Vec<&str> = line.split(',').collect();
        (cells[success], cells[confidence]) = ("0", "0");
        cells.join(",")
    };
    let rows: Vec<String> = table.lines().skip(1).map(faceless).collect();
    fs::write(&tracked, format!("{header}\n{}\n", rows.join("\n"))).unwrap();
    for method in ["colmap", "head"] {
        let said = bench.fails("tracker", &["poses", text(&take), "--method", method]);
        says(&said, "openface.csv: no frame has `success` = 1");
    }
    says(&bench.fails("dataset", &["build", text(&take), "--out", text(&out)]), "none of 40 frames has a usable face");
    bench.import();

    // Outputs that are somebody's own.
    says(&bench.fails("dataset", &["build", text(&take), "--out", text(&take)]), "take: already exists and is not");
    says(&bench.fails("synth", &["--frames", "2", "--out", text(&take)]), "take: already exists and is not");
}

#[test]
fn the_problems_of_a_dataset_are_one_document() {
    let bench = Bench::new();
    let (take, dataset) = (bench.at("take"), bench.at("dataset"));
    let build = ["-q", "build", text(&take), "--frames", "10", "--scale", "4", "--out", text(&dataset)];
    succeed("dataset", &build);
    let verify = || {
        let output = run("dataset", &["-q", "verify", text(&dataset), "--json"]);
        (output.status.code(), serde_json::from_slice::<serde_json::Value>(&output.stdout).unwrap())
    };
    let (status, document) = verify();
    assert_eq!((status, document["problems"].as_array().map(Vec::len)), (Some(0), Some(0)));
    let mut pictures: Vec<_> = fs::read_dir(dataset.join("rgb/4x")).unwrap().map(|e| e.unwrap().path()).collect();
    pictures.sort();
    fs::remove_file(&pictures[0]).unwrap();
    fs::write(&pictures[1], b"\x89PNG").unwrap();
    let (status, document) = verify();
    assert_eq!(status, Some(1));
    let problems = document["problems"].as_array().unwrap();
    assert_eq!(problems.len(), 2, "{document}");
    assert_eq!(problems[0]["path"], text(&pictures[0]));
    assert_eq!(problems[0]["message"], "does not exist");
    assert!(document.get("error").is_none());
}

#[test]
fn a_run_of_the_field_that_is_gone_is_told_in_a_sentence() {
    let bench = Bench::new();
    let run_dir = bench.at("old");
    fs::create_dir_all(run_dir.join("checkpoints")).unwrap();
    fs::write(run_dir.join("model.json"), r#"{"version":2,"field":"brick","layout":{}}"#).unwrap();
    fs::write(run_dir.join("settings.toml"), "field = \"brick\"\nbudget_secs = 120.0\n").unwrap();
    let words = "was made by the brick field of an earlier version";
    let out = bench.at("pictures");
    let said = bench.fails("trainer", &["render", text(&run_dir), "--out", text(&out)]);
    assert!(said.contains(words), "{said}");
    let (take, dataset) = (bench.at("take"), bench.at("dataset"));
    succeed("dataset", &["-q", "build", text(&take), "--frames", "10", "--scale", "4", "--out", text(&dataset)]);
    let said = bench.fails("trainer", &["fit", text(&dataset), "--out", text(&run_dir), "--resume"]);
    assert!(said.contains(words) && said.contains("fit the dataset again"), "{said}");
}
