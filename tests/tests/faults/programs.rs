//! Other people's programs: COLMAP and ONNX Runtime that are missing, broken, crash, hang, or outlive a killed tracker.

use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use crate::world::{Made, check_told, command, copy_of, files, hidden, models, run, said, world};

/// A COLMAP that tells its version, then does `what` at the step named `at`, and nothing at others.
fn fake(dir: &Path, at: &str, what: &str) -> String {
    let path = dir.join("fake-colmap");
    let script = format!(
        "#!/bin/sh\ncase \"$1\" in\n{at}) {what};;\nhelp) echo 'COLMAP 3.8 (Commit none)';;\n*) echo \"$1 done\";;\nesac\n"
    );
    fs::write(&path, script).unwrap();
    fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
    path.to_str().unwrap().to_owned()
}

#[test]
fn a_colmap_that_is_missing_crashes_hangs_or_finds_nothing() {
    world(Made::Take);
    let scratch = tempfile::tempdir().unwrap();
    let poses = |dir: &Path| fs::read(dir.join("take/poses/sparse/images.txt")).unwrap();
    let no_program = scratch.path().join("text");
    fs::write(&no_program, "not a program").unwrap();
    let cases: [(&str, String, &str); 8] = [
        ("missing", "/nowhere/colmap".to_owned(), "/nowhere/colmap"),
        ("no program", no_program.to_str().unwrap().to_owned(), "not an executable"),
        ("help crashes", fake(&scratch.path().join_made("a"), "help", "kill -SEGV $$"), "COLMAP"),
        (
            "features crash",
            fake(&scratch.path().join_made("b"), "feature_extractor", "echo oops; kill -ABRT $$"),
            "oops",
        ),
        (
            "matching fails",
            fake(&scratch.path().join_made("c"), "matches_importer", "echo no GPU >&2; exit 3"),
            "no GPU",
        ),
        ("mapper hangs", fake(&scratch.path().join_made("d"), "mapper", "sleep 600"), "2 s"),
        ("no model", fake(&scratch.path().join_made("e"), "mapper", "true"), "no camera poses"),
        (
            "half a model",
            fake(
                &scratch.path().join_made("f"),
                "mapper",
                "while [ \"$1\" != --output_path ]; do shift; done; mkdir -p \"$2/0\"; printf 'x' > \"$2/0/images.bin\"; printf 'x' > \"$2/0/cameras.bin\"; printf 'x' > \"$2/0/points3D.bin\"",
            ),
            ".bin",
        ),
    ];
    for (case, program, words) in &cases {
        let dir = copy_of(Made::Take, &["take"]);
        let before = poses(dir.path());
        let line = format!("tracker -q poses take --method colmap --time-limit 2 --colmap {program}");
        let said = check_told(case, &run(dir.path(), &line));
        assert!(said.contains(words), "{case}: expected `{words}` in: {said}");
        assert!(poses(dir.path()) == before, "{case}: the older poses changed");
        // What COLMAP had done so far is gone on with; nothing else stays.
        let left = files(&dir.path().join("take"));
        assert!(hidden(&left).iter().all(|name| name.starts_with(".poses-work/")), "{case}: {:?}", hidden(&left));
    }
    eprintln!("| COLMAP missing, crashing, hanging, finding nothing | {} | | |", cases.len());
}

trait JoinMade {
    fn join_made(&self, name: &str) -> PathBuf;
}

impl JoinMade for Path {
    /// A folder that is made.
    fn join_made(&self, name: &str) -> PathBuf {
        let path = self.join(name);
        fs::create_dir_all(&path).unwrap();
        path
    }
}

/// Else it would write into the database of the run that follows.
#[test]
#[cfg(target_os = "linux")]
fn colmap_ends_with_a_tracker_that_is_killed() {
    world(Made::Take);
    let dir = copy_of(Made::Take, &["take"]);
    let pid_file = dir.path().join("pid");
    let what = format!("echo $$ > {}.new; mv {0}.new {0}; exec sleep 600", pid_file.display());
    let program = fake(dir.path(), "feature_extractor", &what);
    let line = format!("tracker -q poses take --method colmap --colmap {program}");
    let mut child = command(dir.path(), &line).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    while !pid_file.exists() {
        assert!(child.try_wait().unwrap().is_none(), "it ended before COLMAP's features");
        std::thread::sleep(Duration::from_millis(5));
    }
    let colmap: u32 = fs::read_to_string(&pid_file).unwrap().trim().parse().unwrap();
    child.kill().unwrap();
    child.wait().unwrap();
    // Ended, or about to be collected by the system's first process.
    let state = || fs::read_to_string(format!("/proc/{colmap}/stat")).ok();
    let is_alive = || state().is_some_and(|s| !s.contains(") Z "));
    for _ in 0..600 {
        if !is_alive() {
            return;
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    panic!("COLMAP goes on alone");
}

#[test]
fn a_model_runtime_that_is_missing_or_broken() {
    let Some(models) = models() else { return };
    world(Made::Take);
    let dir = copy_of(Made::Take, &["take"]);
    let broken = dir.path().join("models");
    fs::create_dir(&broken).unwrap();
    for entry in fs::read_dir(&models).unwrap() {
        let entry = entry.unwrap();
        std::os::unix::fs::symlink(entry.path(), broken.join(entry.file_name())).unwrap();
    }
    let before = files(&dir.path().join("take"));
    let library = broken.join("libonnxruntime.so");
    let good = fs::read(&library).unwrap();
    let network = broken.join("face_detector.onnx");
    let weights = fs::read(&network).unwrap();
    let cases: [(&str, &Path, Option<&[u8]>, &str); 7] = [
        ("no runtime", &library, None, "ONNX Runtime"),
        ("empty runtime", &library, Some(b""), "libonnxruntime.so"),
        ("a text for a runtime", &library, Some(b"not a library\n"), "libonnxruntime.so"),
        ("half a runtime", &library, Some(&good[..good.len() / 2]), "libonnxruntime.so"),
        ("a head of a runtime", &library, Some(&good[..4096]), "libonnxruntime.so"),
        ("half a network", &network, Some(&weights[..weights.len() / 2]), "face_detector.onnx"),
        ("no network", &network, None, "face_detector.onnx"),
    ];
    for (case, path, bytes, words) in cases {
        let whole = fs::read(path).unwrap();
        fs::remove_file(path).unwrap();
        if let Some(bytes) = bytes {
            fs::write(path, bytes).unwrap();
        }
        let output = command(dir.path(), "tracker -q run take --models models")
            .env("XDG_CACHE_HOME", dir.path().join("nothing"))
            .env_remove("RISORIUS_MODELS")
            .output()
            .unwrap();
        assert!(output.status.code().is_some(), "{case}: ended by a signal: {:?}", output.status);
        let told = check_told(case, &output);
        assert!(told.contains(words) && told.contains("tools/models"), "{case}: {told}");
        assert!(files(&dir.path().join("take")) == before, "{case}: the take changed");
        fs::write(path, whole).unwrap();
    }
    let output = run(dir.path(), "tracker -q run take --models models");
    assert!(output.status.success(), "{}", said(&output));
    eprintln!("| model runtime and networks missing or broken | {} | | |", cases.len());
}
