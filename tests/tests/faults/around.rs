//! What goes on around a command: files that change or vanish while they are read, the same command twice at once, clocks
//! that jump.

use std::fs;
use std::path::Path;
use std::process::{Child, Output, Stdio};
use std::time::{Duration, SystemTime};

use crate::kill::{Victim, of_avatars, of_datasets};
use crate::world::{Dice, Made, check_told, command, copy_of, files, hidden, models, rounds, said, succeed, world};

fn start(dir: &Path, line: &str) -> Child {
    command(dir, line).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
}

/// Done, or told: never a bug, never ended by a signal.
fn check_decent(line: &str, output: &Output) {
    match output.status.code() {
        Some(0) => {}
        Some(1) => {
            check_told(line, output);
        }
        other => panic!("`{line}` ended with {other:?} ({:?}): {}", output.status, said(output)),
    }
}

/// A command, what it is given, which file something happens to, what, and how many milliseconds it runs before, at most.
type Harm<'a> = (&'static str, &'static [&'static str], &'static str, &'a dyn Fn(&Path), u64);

#[test]
fn files_that_change_or_vanish_while_they_are_read() {
    world(Made::Run);
    let mut dice = Dice(11);
    let tracks = models().is_some();
    let cut = |path: &Path| fs::File::options().write(true).open(path).and_then(|f| f.set_len(1500)).unwrap();
    let remove = |path: &Path| fs::remove_file(path).unwrap();
    let fit = "trainer -q fit dataset --out new --steps 30 --set splat.gaussians=2000";
    let harms: [Harm<'_>; 7] = [
        ("tracker -q run take --threads 1", &["take"], "take/video.mp4", &cut, 600),
        ("tracker -q run take --threads 1", &["take"], "take/frames.csv", &remove, 300),
        ("dataset -q build take --frames 24 --scale 2 --out new", &["take"], "take/video.mp4", &cut, 200),
        ("dataset -q build take --frames 24 --scale 2 --out new", &["take"], "take/track/openface.csv", &cut, 60),
        (fit, &["dataset"], "dataset/scene.json", &remove, 60),
        (fit, &["dataset"], "dataset/rgb/2x/", &remove, 100),
        ("trainer -q eval run --lpips none --out new", &["run", "dataset"], "run/model.safetensors", &cut, 200),
    ];
    let mut tried = 0;
    for (line, given, file, harm, most) in harms {
        if line.contains("tracker") && !tracks {
            continue;
        }
        for round in 0..2 * rounds() {
            let dir = copy_of(Made::Run, given);
            let mut path = dir.path().join(file);
            if path.is_dir() {
                let mut all: Vec<_> = fs::read_dir(&path).unwrap().map(|e| e.unwrap().path()).collect();
                all.sort();
                path = all.swap_remove((dice.roll() * all.len() as f64) as usize);
            }
            // Once before it starts, then at any moment.
            let life = if round == 0 { 0.0 } else { dice.roll() * most as f64 / 1e3 };
            if round == 0 {
                harm(&path);
            }
            let child = start(dir.path(), line);
            if round > 0 {
                std::thread::sleep(Duration::from_secs_f64(life));
                harm(&path);
            }
            let output = child.wait_with_output().unwrap();
            check_decent(line, &output);
            if round == 0 {
                let told = check_told(line, &output);
                let name = path.file_name().unwrap().to_str().unwrap();
                assert!(told.contains(name), "`{line}` does not name {name}: {told}");
            }
            let there = files(dir.path());
            assert!(hidden(&there).is_empty(), "`{line}` left {:?}", hidden(&there));
            tried += 1;
        }
    }
    eprintln!("| files changed or removed underneath | {tried} | | |");
}

/// Two of the same at once: each is done or says why not; what comes out is that of one.
#[test]
fn the_same_command_twice_at_once() {
    world(Made::Run);
    let mut refused = 0;
    let mut tried = 0;
    // The short round takes every other command, and a full disk the others.
    let step = if rounds() > 1 { 1 } else { 2 };
    for victim in of_datasets().iter().chain(&of_avatars()).skip(step - 1).step_by(step) {
        let calm = copy_of(Made::Run, victim.given);
        succeed(calm.path(), &victim.line);
        let expected = files(calm.path());
        for _ in 0..rounds() {
            let dir = copy_of(Made::Run, victim.given);
            let two = [start(dir.path(), &victim.line), start(dir.path(), &victim.line)];
            let outputs = two.map(|child| child.wait_with_output().unwrap());
            for output in &outputs {
                check_decent(&victim.line, output);
            }
            let done = outputs.iter().filter(|o| o.status.success()).count();
            assert!(done > 0, "`{}`: both refused: {}", victim.line, said(&outputs[0]));
            refused += 2 - done;
            tried += 1;
            check_one(victim, &files(dir.path()), &expected);
        }
    }
    eprintln!("| the same command twice at once | {tried}, {refused} of them refused | | |");
}

fn check_one(
    victim: &Victim,
    found: &std::collections::BTreeMap<String, Vec<u8>>,
    expected: &std::collections::BTreeMap<String, Vec<u8>>,
) {
    assert!(hidden(found).is_empty(), "`{}` twice left {:?}", victim.line, hidden(found));
    for (name, bytes) in expected {
        // Both write lines of the same numbers into it.
        if !name.ends_with("metrics.jsonl") {
            assert!(found.get(name) == Some(bytes), "{name} is not that of one `{}`", victim.line);
        }
    }
}

#[test]
fn clocks_that_jump() {
    world(Made::Take);
    // The camera's clock: a time that does not rise is named by its line.
    let dir = copy_of(Made::Take, &["take"]);
    let path = dir.path().join("take/frames.csv");
    let frames = fs::read_to_string(&path).unwrap();
    let column = frames.lines().next().unwrap().split(',').position(|c| c == "timestamp_nanos").unwrap();
    for value in ["0", "-5000000000", "9223372036854775807"] {
        let lines: Vec<String> = frames
            .lines()
            .enumerate()
            .map(|(i, line)| {
                let mut cells: Vec<&str> = line.split(',').collect();
                if i == 8 {
                    cells[column] = value;
                }
                cells.join(",")
            })
            .collect();
        fs::write(&path, lines.join("\n") + "\n").unwrap();
        for line in ["capture -q check take", "dataset -q build take --frames 24 --scale 2 --out new"] {
            let said = check_told(line, &crate::world::run(dir.path(), line));
            assert!(said.contains("frames.csv:9") || said.contains("frames.csv:10"), "{value}: {said}");
        }
    }
    // The machine's clock: everything comes from the future, or from 1970.
    for time in [SystemTime::now() + Duration::from_secs(3 << 30), SystemTime::UNIX_EPOCH] {
        let dir = copy_of(Made::Take, &["take", "capture"]);
        let mut folders = vec![dir.path().to_owned()];
        while let Some(folder) = folders.pop() {
            for entry in fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                if path.is_dir() {
                    folders.push(path);
                } else {
                    fs::File::options().write(true).open(&path).unwrap().set_modified(time).unwrap();
                }
            }
        }
        succeed(dir.path(), "capture -q check take");
        succeed(dir.path(), "tracker -q import take --openface capture/openface.csv");
        succeed(dir.path(), "tracker -q poses take --colmap-model capture/truth_colmap");
        succeed(dir.path(), "dataset -q build take --frames 24 --scale 2 --out dataset");
        succeed(dir.path(), "dataset -q verify dataset");
    }
}
