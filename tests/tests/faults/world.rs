//! Small captures, takes, datasets and avatars to do harm to, and what a folder holds.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use risorius_tests::binary;
use serde_json::Value;

/// How far the world is made; each holds what is before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Made {
    /// `capture/`: video, tables, cameras with known answers.
    Capture,
    /// `take/`, tracked and posed.
    Take,
    /// `dataset/`.
    Dataset,
    /// `run/`, and `driver/`, a tracked take.
    Run,
}

/// A folder with everything up to `made`. It lies below Cargo's folder for tests and is made anew when a program was built
/// anew: each test is a process of its own. Programs run with it as their working folder, so that its copies work as well.
pub(crate) fn world(made: Made) -> PathBuf {
    let base = PathBuf::from(env!("CARGO_TARGET_TMPDIR"));
    fs::create_dir_all(&base).unwrap();
    let lock = fs::File::create(base.join("faults.lock")).unwrap();
    lock.lock().unwrap();
    let dir = base.join("faults");
    let key = ["synth", "capture", "tracker", "dataset", "trainer"]
        .map(|name| format!("{:?}", fs::metadata(binary(name)).and_then(|m| m.modified())))
        .join("\n");
    if fs::read_to_string(dir.join("key")).ok().as_ref() != Some(&key) {
        if dir.exists() {
            fs::remove_dir_all(&dir).unwrap();
        }
        fs::create_dir_all(&dir).unwrap();
        fs::write(dir.join("key"), key).unwrap();
    }
    let steps: [(Made, &[&str]); 4] = [
        (Made::Capture, &["synth -q --out capture --frames 32 --fps 30 --size 64x96 --driver"]),
        (
            Made::Take,
            &[
                "capture -q record --input capture/video.mp4 --out take",
                "tracker -q import take --openface capture/openface.csv",
                "tracker -q poses take --colmap-model capture/truth_colmap",
            ],
        ),
        (Made::Dataset, &["dataset -q build take --balance --frames 24 --scale 2 --out dataset"]),
        (
            Made::Run,
            &[
                "capture -q record --input capture/driver.mp4 --out driver",
                "tracker -q import driver --openface capture/driver_openface.csv",
                "trainer -q fit dataset --out run --steps 60 --set splat.gaussians=2000",
            ],
        ),
    ];
    for (step, lines) in steps.iter().filter(|(step, _)| *step <= made) {
        let mark = dir.join(format!("{step:?}.made"));
        if !mark.exists() {
            for line in *lines {
                succeed(&dir, line);
            }
            if *step == Made::Run {
                // Hundreds of megabytes that nothing here needs, and that every copy would hold.
                fs::remove_dir_all(dir.join("run/checkpoints")).unwrap();
            }
            fs::write(mark, "").unwrap();
        }
    }
    dir
}

/// A copy of some of the world's folders, to do harm to.
pub(crate) fn copy_of(made: Made, parts: &[&str]) -> tempfile::TempDir {
    let from = world(made);
    let dir = tempfile::tempdir().unwrap();
    for part in parts {
        copy(&from.join(part), &dir.path().join(part));
    }
    dir
}

pub(crate) fn copy(from: &Path, to: &Path) {
    if from.is_dir() {
        fs::create_dir_all(to).unwrap();
        for entry in fs::read_dir(from).unwrap() {
            let entry = entry.unwrap();
            copy(&entry.path(), &to.join(entry.file_name()));
        }
    } else {
        fs::copy(from, to).unwrap();
    }
}

/// A command line, to be run in `dir`; its own settings and networks are left out of the user's reach.
pub(crate) fn command(dir: &Path, line: &str) -> Command {
    let mut words = line.split(' ');
    let mut command = Command::new(binary(words.next().unwrap()));
    command.args(words).current_dir(dir).stdin(Stdio::null());
    command
}

/// Runs a command line in `dir`.
pub(crate) fn run(dir: &Path, line: &str) -> Output {
    command(dir, line).output().unwrap_or_else(|e| panic!("`{line}` cannot be started: {e}"))
}

pub(crate) fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Runs a command line that has to succeed.
pub(crate) fn succeed(dir: &Path, line: &str) -> Output {
    let output = run(dir, line);
    assert!(output.status.success(), "`{line}` failed: {}", said(&output));
    output
}

/// Checks that a command told what is wrong as all commands do: status 1, `error: …`, a blank line, `hint: …`.
pub(crate) fn check_told(line: &str, output: &Output) -> String {
    let said = said(output);
    assert_eq!(output.status.code(), Some(1), "`{line}`: {said}");
    assert!(said.contains("error: ") && said.contains("\n\nhint: "), "`{line}`: {said}");
    said
}

/// Every file below `dir` by its path, hidden ones too; files hold what has to be the same in two runs.
pub(crate) fn files(dir: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut folders = vec![dir.to_owned()];
    while let Some(folder) = folders.pop() {
        let entries: Vec<PathBuf> = fs::read_dir(&folder).unwrap().map(|e| e.unwrap().path()).collect();
        if entries.is_empty() && folder != dir {
            found.insert(format!("{}/", name_in(dir, &folder)), Vec::new());
        }
        for path in entries {
            if path.is_dir() && !path.is_symlink() {
                // Event files are named after the time.
                if !path.ends_with("tensorboard") {
                    folders.push(path);
                }
            } else {
                let bytes = fs::read(&path).unwrap();
                found.insert(name_in(dir, &path), lasting(&path, bytes));
            }
        }
    }
    found
}

fn name_in(dir: &Path, path: &Path) -> String {
    path.strip_prefix(dir).unwrap().to_str().unwrap().to_owned()
}

/// The file without what no two runs share: how long things took, what COLMAP says, what the video encoder does.
fn lasting(path: &Path, bytes: Vec<u8>) -> Vec<u8> {
    let ending = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    match ending {
        // In a `.bpk`, parameters have new identities in each process.
        "mp4" | "bpk" => vec![u8::from(!bytes.is_empty())],
        "log" => Vec::new(),
        "json" | "jsonl" => {
            let text = String::from_utf8_lossy(&bytes);
            let lines: Vec<String> = serde_json::Deserializer::from_str(&text)
                .into_iter::<Value>()
                .map(|value| {
                    let mut value = value.unwrap_or_else(|e| panic!("{} is half-written ({e})", path.display()));
                    drop_times(&mut value);
                    value.to_string()
                })
                .collect();
            assert!(!lines.is_empty(), "{} is half-written", path.display());
            lines.join("\n").into_bytes()
        }
        _ => bytes,
    }
}

fn drop_times(value: &mut Value) {
    match value {
        Value::Object(map) => {
            map.retain(|key, _| {
                let is_time = key == "seconds" || key.ends_with("_secs") || key.contains("per_sec");
                !is_time && !key.starts_with("seconds_per") && key != "version_of"
            });
            map.values_mut().for_each(drop_times);
        }
        Value::Array(list) => list.iter_mut().for_each(drop_times),
        _ => {}
    }
}

/// Checks that a file is whole, as far as its kind tells.
pub(crate) fn check_whole(dir: &Path, name: &str) {
    let path = dir.join(name);
    let ending = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    let bytes = fs::read(&path).unwrap();
    let whole = match ending {
        "png" => image::load_from_memory(&bytes).is_ok(),
        "safetensors" => is_whole_safetensors(&bytes),
        "csv" | "toml" | "txt" | "html" | "svg" => bytes.ends_with(b"\n") || bytes.ends_with(b">"),
        // `files` has read it.
        "json" => true,
        _ => !bytes.is_empty(),
    };
    assert!(whole, "{name} is half-written: {} bytes", bytes.len());
}

fn is_whole_safetensors(bytes: &[u8]) -> bool {
    let Some((length, rest)) = bytes.split_first_chunk::<8>() else { return false };
    let length = u64::from_le_bytes(*length) as usize;
    let Some(header) = rest.get(..length) else { return false };
    let Ok(Value::Object(header)) = serde_json::from_slice(header) else { return false };
    let end = header.values().filter_map(|t| t["data_offsets"][1].as_u64()).max().unwrap_or(0);
    rest.len() as u64 == length as u64 + end
}

/// Hidden entries below `dir`, where what is not whole lies.
pub(crate) fn hidden(names: &BTreeMap<String, Vec<u8>>) -> Vec<&String> {
    names.keys().filter(|name| name.split('/').any(|part| part.starts_with('.'))).collect()
}

/// Numbers that are the same in every run.
pub(crate) struct Dice(pub u64);

impl Dice {
    /// From 0 up to 1.
    pub(crate) fn roll(&mut self) -> f64 {
        // Knuth's multiplier; the upper bits are good enough to choose moments by.
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as f64 / f64::from(1_u32 << 31)
    }
}

/// How often each fault is tried, against once in the short round.
pub(crate) fn rounds() -> u64 {
    std::env::var("RISORIUS_FAULTS").ok().and_then(|n| n.parse().ok()).unwrap_or(1)
}

/// Where the networks of `tracker run` are, or `None` with a loud word about it.
pub(crate) fn models() -> Option<PathBuf> {
    let models = risorius_tracker::models::default_dir();
    let found = models.join("models.toml").is_file();
    if !found {
        eprintln!("SKIPPED: no networks in {}; `tools/models` fetches them", models.display());
    }
    found.then_some(models)
}
