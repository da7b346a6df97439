//! The paper's networks from the command line, on the built-in capture at a small size.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::fs;
use std::path::Path;

use risorius_tests::{posed_take, run, succeed, text};
use serde_json::Value;

fn json(output: &str) -> Value {
    serde_json::from_str(output).unwrap_or_else(|e| panic!("not one JSON document ({e}): {output}"))
}

/// A dataset of 24 frames.
fn dataset(dir: &Path) -> std::path::PathBuf {
    let at = |name: &str| dir.join(name);
    let (capture, take, dataset) = (at("capture"), at("take"), at("dataset"));
    posed_take(&capture, &take, 40);
    let build = ["build", text(&take), "--balance", "--frames", "24", "--scale", "2", "--out", text(&dataset), "-q"];
    succeed("dataset", &build);
    dataset
}

#[test]
fn costs_are_told_before_and_tables_go_on_where_they_were() {
    let dir = tempfile::tempdir().unwrap();
    let dataset = dataset(dir.path());
    let (data, run_dir) = (text(&dataset), dir.path().join("run"));

    // What a fit costs; nothing is written.
    let dry = |args: &[&str]| {
        let all =
            [&["fit", data, "--out", text(&run_dir), "--field", "confies", "--dry-run", "--json", "-q"], args].concat();
        json(&succeed("trainer", &all))
    };
    let plan = dry(&["--preset", "tiny"]);
    for key in ["parameters", "flops_per_iteration", "frames"] {
        assert!(plan[key].as_f64().unwrap() > 0.0, "{key}: {plan}");
    }
    let total = plan["memory"]["total_bytes"].as_u64().unwrap();
    assert!(total > 100 << 20 && plan["memory"]["rays_together"] == 64, "{plan}");
    assert!(plan["expected"]["expected_secs"].as_f64().unwrap() > 0.0, "{plan}");
    let limit = (total - (5 << 20)).to_string();
    let limited = dry(&["--preset", "tiny", "--memory-limit", &limit]);
    let together = limited["memory"]["rays_together"].as_u64().unwrap();
    assert!((1..64).contains(&together), "{limited}");
    assert!(limited["memory"]["total_bytes"].as_u64().unwrap() <= total - (5 << 20));
    assert!(!run_dir.exists());
    let refuse = |args: &[&str], code: i32| {
        let all = [&["fit", data, "--out", text(&run_dir), "--dry-run", "-q"], args].concat();
        let output = run("trainer", &all);
        assert_eq!(output.status.code(), Some(code), "{args:?}");
    };
    refuse(&["--field", "confies", "--memory-limit", "1MiB"], 1);
    refuse(&["--field", "confies", "--model", "gan"], 2);
    refuse(&["--field", "confies", "--set", "model.hyper_dim=3"], 2);
    refuse(&["--field", "splat", "--model", "nerf"], 2);
    refuse(&["--field", "brick"], 2);

    // Two rows of the table, of which one is measured already when the rest is asked for.
    let work = dir.path().join("table");
    let table = |models: &str, more: &[&str]| {
        let args = [
            "table2",
            "--dataset",
            data,
            "--work",
            text(&work),
            "--preset",
            "tiny",
            "--steps",
            "20",
            "--lpips",
            "none",
            "--models",
            models,
            "--json",
            "-q",
        ];
        json(&succeed("bench-confies", &[&args[..], more].concat()))
    };
    let planned = table("nerf,confies", &["--dry-run"]);
    assert!(planned[1]["expected_secs"].as_f64().unwrap() > 0.0 && !work.join("nerf").exists(), "{planned}");
    let first = table("confies", &[]);
    assert!(first[0]["means"]["psnr_db"].as_f64().unwrap() > 5.0, "{first}");
    let run_of = |model: &str| work.join(model).join("model.safetensors");
    let made = fs::metadata(run_of("confies")).unwrap().modified().unwrap();
    let both = table("nerf,confies", &[]);
    assert_eq!(both[1], first[0]);
    assert_eq!(fs::metadata(run_of("confies")).unwrap().modified().unwrap(), made, "it was fitted again");
    assert!(both[0]["parameters"].as_u64().unwrap() < both[1]["parameters"].as_u64().unwrap());
    assert_eq!(fs::read_to_string(work.join("table2.csv")).unwrap().lines().count(), 3);
    let md = fs::read_to_string(work.join("table2.md")).unwrap();
    assert!(md.lines().nth(2).unwrap().starts_with("| nerf |"), "{md}");

    // Every other frame was held out, and lies between two others; a model without AUs says that they do nothing.
    let settings = fs::read_to_string(work.join("nerf/settings.toml")).unwrap();
    assert!(settings.contains("interval = 2") && settings.contains("kind = \"nerf\""), "{settings}");
    let eval = json(&fs::read_to_string(work.join("nerf/eval/eval.json")).unwrap());
    assert!(eval["views"].as_array().unwrap().len() > 8);
    let pictures = dir.path().join("pictures");
    let rendered = run("trainer", &["render", text(&work.join("nerf")), "--au", "AU12=4", "--out", text(&pictures)]);
    assert!(rendered.status.success() && String::from_utf8_lossy(&rendered.stderr).contains("no attributes"));

    let devices = json(&succeed("trainer", &["devices", "--json"]));
    assert_eq!((&devices[0]["name"], &devices[0]["compiled_in"]), (&"cpu".into(), &true.into()));
}
