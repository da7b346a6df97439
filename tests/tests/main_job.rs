//! The main job, command after command as a user types it, on the built-in capture at a small size.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::path::Path;

use risorius_formats::views::ViewList;
use risorius_tests::{run, succeed, text};

fn json(output: &str) -> serde_json::Value {
    serde_json::from_str(output).unwrap_or_else(|e| panic!("not one JSON document ({e}): {output}"))
}

fn mean_difference(a: &Path, b: &Path) -> f64 {
    let (a, b) = (image::open(a).unwrap().into_rgb8(), image::open(b).unwrap().into_rgb8());
    assert_eq!(a.dimensions(), b.dimensions());
    let sum: f64 = a.as_raw().iter().zip(b.as_raw()).map(|(a, b)| (f64::from(*a) - f64::from(*b)).abs()).sum();
    sum / a.as_raw().len() as f64
}

#[test]
fn video_to_avatar_to_transfer() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let (capture, take, driver, dataset) = (at("capture"), at("take"), at("driver"), at("dataset"));

    succeed("synth", &["--out", text(&capture), "--frames", "90", "--fps", "30", "--size", "96x160", "--driver", "-q"]);
    let recorded = json(&succeed(
        "capture",
        &["record", "--input", text(&capture.join("video.mp4")), "--out", text(&take), "--json"],
    ));
    assert!(recorded.is_object());
    succeed("capture", &["check", text(&take), "-q"]);
    succeed("tracker", &["import", text(&take), "--openface", text(&capture.join("openface.csv")), "-q"]);
    succeed("tracker", &["poses", text(&take), "--colmap-model", text(&capture.join("truth_colmap")), "-q"]);
    for file in [
        "take.toml",
        "frames.csv",
        "track/openface.csv",
        "track/track.parquet",
        "poses/report.json",
        "poses/sparse/images.txt",
    ] {
        assert!(take.join(file).is_file(), "{file}");
    }

    let build =
        ["dataset", "build", text(&take), "--balance", "--frames", "40", "--scale", "2", "--out", text(&dataset), "-q"];
    succeed(build[0], &build[1..]);
    succeed("dataset", &["verify", text(&dataset), "-q"]);

    succeed("capture", &["record", "--input", text(&capture.join("driver.mp4")), "--out", text(&driver), "-q"]);
    succeed("tracker", &["import", text(&driver), "--openface", text(&capture.join("driver_openface.csv")), "-q"]);
    // The paper's networks show that the chain holds; the Gaussians have to show the head as well.
    for (field, length, value, least_db) in [("confies", "--preset", "tiny", 8.0), ("splat", "--steps", "400", 16.0)] {
        let run_dir = at(field);
        let fit = ["fit", text(&dataset), "--out", text(&run_dir), "--field", field, length, value, "--json"];
        let summary = json(&succeed("trainer", &fit));
        assert_eq!(summary["finished"], true);
        assert!(run_dir.join("model.safetensors").is_file() && run_dir.join("metrics.jsonl").is_file());
        // A second fit into the same folder is refused, not mixed in.
        assert_eq!(run("trainer", &fit).status.code(), Some(1));
        use_avatar(&capture, &run_dir, &driver, &at(&format!("{field}-out")), least_db);
    }
}

/// Renders, scores, edits and drives an avatar.
fn use_avatar(capture: &Path, run_dir: &Path, driver: &Path, out: &Path, least_db: f64) {
    let at = |name: &str| out.join(name);
    let views_path = capture.join("test/views.json");
    let views = ViewList::read(&views_path).unwrap();
    let renders = at("renders");
    succeed("trainer", &["render", text(run_dir), "--views", text(&views_path), "--out", text(&renders), "-q"]);
    for view in &views.views {
        let image = image::open(renders.join(format!("{}.png", view.id))).unwrap();
        assert_eq!((image.width(), image.height()), (view.camera.width, view.camera.height));
    }
    let scores = json(&succeed(
        "trainer",
        &["eval", text(run_dir), "--views", text(&views_path), "--renders", text(&renders), "--json"],
    ));
    assert!(scores["mean_psnr_db"].as_f64().unwrap() > least_db, "{scores}");

    let (neutral, smile) = (at("neutral"), at("smile"));
    succeed("trainer", &["render", text(run_dir), "--out", text(&neutral), "-q"]);
    succeed("trainer", &["render", text(run_dir), "--au", "AU12=5", "--au", "AU26=5", "--out", text(&smile), "-q"]);
    assert!(mean_difference(&neutral.join("000.png"), &smile.join("000.png")) > 0.0, "the AUs change nothing");

    let video = at("transfer.mp4");
    succeed(
        "trainer",
        &["transfer", text(run_dir), "--from", text(driver), "--fps", "3", "--video", text(&video), "-q"],
    );
    assert!(std::fs::metadata(&video).unwrap().len() > 1000);
}

#[test]
fn an_interrupted_fit_goes_on_as_if_nothing_had_happened() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let (capture, take, dataset) = (at("capture"), at("take"), at("dataset"));
    succeed("synth", &["--out", text(&capture), "--frames", "40", "--fps", "30", "--size", "64x96", "-q"]);
    succeed("capture", &["record", "--input", text(&capture.join("video.mp4")), "--out", text(&take), "-q"]);
    succeed("tracker", &["import", text(&take), "--openface", text(&capture.join("openface.csv")), "-q"]);
    succeed("tracker", &["poses", text(&take), "--colmap-model", text(&capture.join("truth_colmap")), "-q"]);
    succeed(
        "dataset",
        &["build", text(&take), "--balance", "--frames", "20", "--scale", "2", "--out", text(&dataset), "-q"],
    );
    // 240 steps of the Gaussian field change its size and grow it.
    for (field, length, value, every) in [("confies", "--preset", "tiny", 20), ("splat", "--steps", "240", 80)] {
        let every_text = every.to_string();
        let fit = |run_dir: &Path| {
            let args = ["fit", text(&dataset), "--out", text(run_dir), "--field", field, length, value, "-q"];
            succeed("trainer", &[&args[..], &["--checkpoint-every", &every_text]].concat())
        };
        let (whole, parted) = (at(&format!("{field}-whole")), at(&format!("{field}-parted")));
        fit(&whole);
        fit(&parted);
        // Back to an older checkpoint, as after a power cut, and on from there.
        let checkpoint = |step: u64| parted.join(format!("checkpoints/step-{step:08}"));
        assert!(checkpoint(3 * every).is_dir() && checkpoint(2 * every).is_dir());
        std::fs::remove_dir_all(checkpoint(3 * every)).unwrap();
        succeed("trainer", &["fit", text(&dataset), "--out", text(&parted), "--resume", "-q"]);
        same_model(&whole, &parted);
    }
}

fn same_model(whole: &Path, parted: &Path) {
    for name in ["model.safetensors", "model.json"] {
        assert!(
            std::fs::read(whole.join(name)).unwrap() == std::fs::read(parted.join(name)).unwrap(),
            "{name} differs"
        );
    }
}
