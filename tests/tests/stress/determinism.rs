//! The same inputs and seed give the same bytes: over repetitions, and over thread counts where the documentation promises
//! it. (What `dataset build` promises is tested in `datasets.rs`, the kernels' threads in `trainer/tests/kernels.rs`.)

use std::path::Path;
use std::process::Command;

use risorius_tests::{binary, files};

use crate::support::{text, tiny};

/// Runs a command with a number of threads.
fn with_threads(threads: &str, name: &str, args: &[&str]) {
    let mut command = Command::new(binary(name));
    command.args(args).env("RAYON_NUM_THREADS", threads);
    let output = command.output().unwrap();
    assert!(output.status.success(), "{name} {args:?}: {}", String::from_utf8_lossy(&output.stderr));
}

fn same(a: &Path, b: &Path, but: &[&str]) {
    let (a, b) = (files(a), files(b));
    assert!(a.keys().eq(b.keys()), "{:?} and {:?}", a.keys(), b.keys());
    for (path, bytes) in &a {
        let differs_by_nature = but.iter().any(|name| path.ends_with(name));
        assert!(differs_by_nature || b[path] == *bytes, "{} differs", path.display());
    }
    assert!(!a.is_empty());
}

#[test]
fn captures_tracks_and_poses_repeat_themselves() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    for (capture, take, threads) in [("c1", "t1", "1"), ("c2", "t2", "3")] {
        let (capture, take) = (at(capture), at(take));
        // The video's encoder deals a picture's slices to its threads, and promises nothing about their number.
        with_threads(
            "2",
            "synth",
            &["-q", "--out", text(&capture), "--frames", "10", "--fps", "30", "--size", "64x96"],
        );
        // The same video for both: a take keeps the hash and the name of what it was made from.
        let (video, table) = (at("c1").join("video.mp4"), at("c1").join("openface.csv"));
        let (model, take) = (at("c1").join("truth_colmap"), text(&take));
        with_threads(threads, "capture", &["-q", "record", "--input", text(&video), "--out", take]);
        with_threads(threads, "tracker", &["-q", "import", take, "--openface", text(&table)]);
        with_threads(threads, "tracker", &["-q", "poses", take, "--colmap-model", text(&model)]);
    }
    same(&at("c1"), &at("c2"), &[]);
    // The report says how long it took.
    same(&at("t1"), &at("t2"), &["report.json"]);
}

#[test]
fn avatars_and_their_pictures_repeat_themselves() {
    let tiny = tiny();
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let model = |run: &Path| std::fs::read(run.join("model.safetensors")).unwrap();
    for (field, more) in [("splat", &["--steps", "20"][..]), ("confies", &["--preset", "tiny", "--steps", "2"])] {
        let (run, data, given) = (at(field), tiny.join("data"), tiny.join(field));
        let args = ["fit", text(&data), "--out", text(&run), "--field", field, "-q"];
        // The networks' sums depend on the number of threads, the Gaussians' do not.
        let threads: &[Option<&str>] = if field == "splat" { &[None, Some("1"), Some("3")] } else { &[None] };
        for count in threads {
            let mut command = Command::new(binary("trainer"));
            command.args(args).args(more).envs(count.map(|n| ("RAYON_NUM_THREADS", n)));
            assert!(command.status().unwrap().success());
            assert!(model(&run) == model(&given), "{field}: another fit with {count:?} threads, another avatar");
            std::fs::remove_dir_all(&run).unwrap();
        }
        for threads in ["1", "2", "5"] {
            let out = at(&format!("{field}-{threads}"));
            let args = ["render", text(&given), "--orbit", "2", "--au", "AU12=4", "--depth", "--masks", "-q"];
            with_threads(threads, "trainer", &[&args[..], &["--out", text(&out)]].concat());
        }
        same(&at(&format!("{field}-1")), &at(&format!("{field}-2")), &[]);
        same(&at(&format!("{field}-1")), &at(&format!("{field}-5")), &[]);
    }
}
