//! Stages run again, twice at once, and after a kill; a corpus of their results; the workflow over a table of takes.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]
#![allow(clippy::print_stderr, reason = "a skipped test says so")]

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use risorius_tests::{binary, run, succeed, text};
use serde_json::Value;

fn json(output: &str) -> Value {
    serde_json::from_str(output).unwrap_or_else(|e| panic!("not one JSON document ({e}): {output}"))
}

/// Runs a stage with `--if-changed`; whether there was nothing to do.
fn is_current(command: &[&str]) -> bool {
    let output = succeed(command[0], &[&command[1..], &["--if-changed", "--json", "-q"]].concat());
    json(&output)["up_to_date"].as_bool().unwrap_or(false)
}

/// Small captures, and the stages on them as the workflow runs them.
struct Lab {
    dir: tempfile::TempDir,
}

impl Lab {
    fn new(seeds: &[&str]) -> Self {
        let lab = Self { dir: tempfile::tempdir().unwrap() };
        for seed in seeds {
            let out = lab.at(&format!("capture{seed}"));
            let size = ["--frames", "40", "--fps", "30", "--size", "64x96", "--seed", seed, "-q"];
            succeed("synth", &[&["--out", text(&out)][..], &size].concat());
        }
        lab
    }

    fn at(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    fn take(&self, seed: &str) -> PathBuf {
        let (capture, take) = (self.at(&format!("capture{seed}")), self.at(&format!("take{seed}")));
        let (video, table, model) =
            (capture.join("video.mp4"), capture.join("openface.csv"), capture.join("truth_colmap"));
        let stages: [&[&str]; 3] = [
            &["capture", "record", "--input", text(&video), "--out", text(&take), "--subject", "ada", "--force"],
            &["tracker", "import", text(&take), "--openface", text(&table)],
            &["tracker", "poses", text(&take), "--colmap-model", text(&model)],
        ];
        for stage in stages {
            assert!(!is_current(stage), "{stage:?} was not there");
            assert!(is_current(stage), "{stage:?} was made again");
        }
        take
    }

    /// What stands in a folder, hidden files too.
    fn hidden(&self) -> Vec<String> {
        let names = std::fs::read_dir(self.dir.path()).unwrap().map(|e| e.unwrap().file_name());
        names.map(|n| n.to_string_lossy().into_owned()).filter(|n| n.starts_with('.')).collect()
    }
}

#[test]
fn what_is_made_is_made_once_until_something_changes() {
    let lab = Lab::new(&["1"]);
    let (take, data, out) = (lab.take("1"), lab.at("data"), lab.at("run"));
    let build = ["dataset", "build", text(&take), "--frames", "20", "--scale", "2", "--out", text(&data)];
    // Two at once: one makes it, the other waits and finds it made.
    let start = || {
        Command::new(binary("dataset"))
            .args(&build[1..])
            .args(["--if-changed", "--json", "-q"])
            .stdout(Stdio::piped())
            .spawn()
            .unwrap()
    };
    let both = [start(), start()].map(|child| child.wait_with_output().unwrap());
    let current: Vec<bool> = both
        .iter()
        .map(|o| {
            assert!(o.status.success(), "{o:?}");
            json(std::str::from_utf8(&o.stdout).unwrap())["up_to_date"].as_bool().unwrap_or(false)
        })
        .collect();
    assert_eq!(current.iter().filter(|c| **c).count(), 1, "{current:?}");
    assert!(!is_current(&[&build[..], &["--uniform"]].concat()), "another setting");
    assert!(!is_current(&build));

    // A fit that is killed: its lock stays, is known to be a dead one's, and the fit goes on.
    let fit = |steps: &'static str| {
        let args = ["trainer", "fit", text(&data), "--out", text(&out), "--steps", steps, "--checkpoint-every", "5"];
        args.map(str::to_owned).to_vec()
    };
    let long = fit("100000");
    let mut child = Command::new(binary("trainer")).args(&long[1..]).arg("-q").spawn().unwrap();
    let has_checkpoint =
        || std::fs::read_dir(out.join("checkpoints")).is_ok_and(|entries| entries.flatten().any(|e| is_step(&e)));
    while !has_checkpoint() {
        assert!(child.try_wait().unwrap().is_none(), "the fit ended by itself");
        std::thread::sleep(Duration::from_millis(20));
    }
    let second = run("trainer", &long[1..].iter().map(String::as_str).chain(["-q"]).collect::<Vec<_>>());
    let said = String::from_utf8_lossy(&second.stderr).into_owned();
    assert_eq!(second.status.code(), Some(1), "{said}");
    assert!(said.contains(&format!("run: is being made by `trainer fit` (process {} on ", child.id())), "{said}");
    child.kill().unwrap();
    child.wait().unwrap();
    assert_eq!(lab.hidden(), [".run.lock"]);
    // Another fit is refused, as ever; with --force it replaces what the dead one left.
    let short = fit("10");
    let refused = run("trainer", &short[1..].iter().map(String::as_str).chain(["--if-changed"]).collect::<Vec<_>>());
    assert_eq!(refused.status.code(), Some(1), "another fit is not replaced without --force");
    let takes_over = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(takes_over.contains(&format!("takes over from `trainer fit` (process {} on", child.id())), "{takes_over}");
    let forced: Vec<&str> = short.iter().map(String::as_str).chain(["--force"]).collect();
    assert!(!is_current(&forced));
    assert!(is_current(&forced));
    assert!(lab.hidden().is_empty());
}

fn is_step(entry: &std::fs::DirEntry) -> bool {
    entry.file_name().to_string_lossy().starts_with("step-")
}

#[test]
fn an_installation_that_lacks_something_is_told_from_a_bad_take() {
    let lab = Lab::new(&["1"]);
    let take = lab.take("1");
    std::fs::create_dir(lab.at("empty")).unwrap();
    let lacks = |program: &str, args: &[&str]| {
        let mut command = Command::new(binary(program));
        command.args(args).env("PATH", lab.at("empty")).env("RISORIUS_MODELS", lab.at("empty")).args(["-q", "--json"]);
        let output = command.output().unwrap();
        assert_eq!(output.status.code(), Some(1), "{}", String::from_utf8_lossy(&output.stderr));
        let document: Value = serde_json::from_slice(&output.stdout).unwrap();
        document["error"]["of_installation"] == true
    };
    let nothing = lab.at("nothing");
    std::fs::create_dir(&nothing).unwrap();
    assert!(lacks("tracker", &["poses", text(&take), "--method", "colmap"]));
    assert!(lacks("tracker", &["run", text(&take)]));
    assert!(!lacks("tracker", &["run", text(&take), "--models", text(&nothing)]), "a path that was named");
    assert!(!lacks("tracker", &["run", text(&nothing)]), "a bad take");
    // Neither took anything away.
    assert!(take.join("track/openface.csv").is_file() && take.join("poses/report.json").is_file());
}

#[test]
fn takes_become_a_corpus_that_engines_read() {
    let lab = Lab::new(&["1", "2"]);
    let corpus = lab.at("corpus");
    for (number, seed) in ["1", "2"].into_iter().enumerate() {
        let (take, data) = (lab.take(seed), lab.at(&format!("data{seed}")));
        let frames = ["--frames", "20", "--scale", "2"];
        succeed("dataset", &[&["build", text(&take), "--out", text(&data), "-q"][..], &frames].concat());
        let number = number.to_string();
        let collect = ["collect", text(&data), "--out", text(&corpus), "--number", &number, "--json", "-q"];
        for _ in 0..2 {
            let done = json(&succeed("dataset", &collect));
            assert_eq!((&done["subject"], &done["files"]), (&Value::from("ada"), &Value::from(4)));
        }
    }
    let place = |table: &str, take: &str| {
        corpus.join(format!("tables/{table}/subject_dir=subject-ada/take_dir=take-{take}/{table}.parquet"))
    };
    assert!(place("aus", "take1").is_file() && place("datasets", "take2").is_file());
    assert!(!place("fits", "take1").exists());
    let stats = json(&succeed("dataset", &["stats", text(&corpus), "--json", "-q"]));
    assert_eq!((&stats["takes"], &stats["frames"]), (&Value::from(2), &Value::from(80)));
    assert_eq!(stats["chosen"], 40);
    let levels: u64 =
        stats["aus"]["ada"]["AU12"]["levels"].as_array().unwrap().iter().map(|l| l.as_u64().unwrap()).sum();
    assert_eq!(stats["aus"]["ada"]["AU12"]["frames"], levels);
    let human = succeed("dataset", &["stats", text(&corpus), "-q"]);
    assert!(human.starts_with("2 takes of 1 subjects, 80 frames"), "{human}");
    let wrong = run("dataset", &["stats", text(&lab.at("capture1")), "-q"]);
    assert_eq!(wrong.status.code(), Some(1));
}

#[test]
fn a_bad_table_of_takes_is_answered_with_its_place() {
    if Command::new("python3").arg("--version").output().is_err() {
        eprintln!("SKIPPED: there is no python3 here");
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let (table, out) = (dir.path().join("captures.csv"), dir.path().join("corpus"));
    let tool = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tools/corpus");
    for (text_of_table, words) in [
        ("", "captures.csv: the table is empty"),
        ("subject,take\na,1\n", "captures.csv:1: there is no column `video`"),
        ("subject,take,video,colour\n", "captures.csv:1: column `colour` is not known"),
        ("subject,take,video\n", "captures.csv: the table has no rows"),
        ("subject,take,video\na,1,v.mp4\n,2,v.mp4\n", "captures.csv:3: column `subject`: is empty"),
        ("subject,take,video\na,1,v.mp4\na,1,w.mp4\n", "captures.csv:3: a/1 stands in line 2 already"),
        ("subject,take,video\na,1,v.mp4,x\n", "captures.csv:2: has more cells than the first line"),
        ("subject,take,video,driver\na,1,v.mp4,b/2\n", "captures.csv:2: column `driver`: `b/2` is neither"),
    ] {
        std::fs::write(&table, text_of_table).unwrap();
        let output = Command::new("python3").arg(&tool).args([text(&table), "--out", text(&out)]).output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(1), "{said}");
        assert!(said.starts_with("error: ") && said.contains(words) && said.contains("\nhint: "), "{words}: {said}");
        assert!(!out.exists());
    }
}

/// Two takes, one of them bad, through the whole workflow.
#[test]
fn the_workflow_goes_on_past_a_bad_take() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let snakemake = root.join("target/tools/workflow/bin/snakemake");
    if !snakemake.is_file() {
        eprintln!("SKIPPED: there is no Snakemake here; `tools/setup --workflow` installs it");
        return;
    }
    let lab = Lab::new(&["1"]);
    let (table, corpus) = (lab.at("captures.csv"), lab.at("corpus"));
    let rows = "ada,1,capture1/video.mp4,capture1/openface.csv,capture1/truth_colmap,ada/1\n\
                ada,2,capture1/openface.csv,capture1/openface.csv,capture1/truth_colmap,\n";
    std::fs::write(&table, format!("subject,take,video,openface,colmap,driver\n{rows}")).unwrap();
    let corpus_of = |more: &[&str]| {
        Command::new("python3")
            .arg(root.join("tools/corpus"))
            .args([text(&table), "--out", text(&corpus), "--cores", "2", "--json"])
            .args(["--bin", text(binary("capture").parent().unwrap())])
            .args(["--set", r#"fit_options = ["--steps", "20"]"#, "--set", r#"eval_options = ["--lpips", "none"]"#])
            .args(["--set", r#"dataset_options = ["--frames", "20", "--scale", "2"]"#])
            .args(["--set", r#"transfer_options = ["--fps", "3"]"#])
            .args(more)
            .output()
            .unwrap()
    };
    let done = corpus_of(&[]);
    let said = String::from_utf8_lossy(&done.stderr).into_owned();
    assert_eq!(done.status.code(), Some(1), "a take failed: {said}");
    let outcome = json(std::str::from_utf8(&done.stdout).unwrap());
    assert_eq!((&outcome["avatars"], &outcome["open"]), (&Value::from(1), &Value::from(0)), "{said}");
    assert_eq!(outcome["failed"][0]["take"], "ada/2");
    assert!(outcome["failed"][0]["error"].as_str().unwrap().contains("openface.csv: is not a video"), "{outcome}");
    assert!(corpus.join("transfers/ada+1.mp4").is_file() && corpus.join("report/index.html").is_file());
    assert!(corpus.join("tables/metrics/subject_dir=subject-ada/take_dir=take-1/metrics.parquet").is_file());
    let journal = || std::fs::read_to_string(corpus.join("state/ada+1/journal.jsonl")).unwrap();
    let before = journal();
    corpus_of(&[]);
    assert_eq!(journal(), before, "something was done twice");
}
