//! `kill -9` at any moment of any command: what lies at its place is whole, the next run goes on or begins anew without
//! being asked twice, its results are those of an undisturbed one, and nothing else stays.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::{Child, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use crate::world::{
    Dice, Made, check_whole, command, copy_of, files, hidden, models, rounds, run, said, succeed, world,
};

/// Kills before a run is let go to its end.
const KILLS: u32 = 3;

/// A command that meets a fault.
pub(crate) struct Victim {
    made: Made,
    /// What it is given, of the world.
    pub(crate) given: &'static [&'static str],
    pub(crate) line: String,
    /// What is added to go on, once this is there.
    goes_on: Option<(&'static str, &'static str)>,
    /// Beginnings of the names of files that say more the further the command gets; whole, but not yet the last ones.
    grow: &'static [&'static str],
}

impl Victim {
    pub(crate) fn new(made: Made, given: &'static [&'static str], line: &str) -> Self {
        Self { made, given, line: line.to_owned(), goes_on: None, grow: &[] }
    }

    fn going_on(self, mark: &'static str, option: &'static str, grow: &'static [&'static str]) -> Self {
        Self { goes_on: Some((mark, option)), grow, ..self }
    }

    /// The line that goes on with what is there.
    pub(crate) fn line_in(&self, dir: &Path) -> String {
        match self.goes_on {
            Some((mark, option)) if dir.join(mark).exists() => format!("{} {option}", self.line),
            _ => self.line.clone(),
        }
    }

    fn grows(&self, name: &str) -> bool {
        self.grow.iter().any(|start| name.starts_with(start))
    }
}

/// How many of the kills found the process alive.
#[derive(Default)]
struct Tally {
    kills: u32,
    late: u32,
}

/// Starts a command line, its words going to a file.
fn start(dir: &Path, line: &str, log: &Path) -> Child {
    let log = fs::File::create(log).unwrap();
    command(dir, line).stdout(Stdio::null()).stderr(log).spawn().unwrap()
}

/// Lets the process live for `life`, then kills it; its status if it had ended by itself.
fn kill_after(mut child: Child, life: Duration) -> Option<ExitStatus> {
    let begun = Instant::now();
    while begun.elapsed() < life {
        if let Some(status) = child.try_wait().unwrap() {
            return Some(status);
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    child.kill().unwrap();
    let status = child.wait().unwrap();
    // It may have ended in the last moment.
    status.code().map(|_| status)
}

fn torment(victim: &Victim, dice: &mut Dice) {
    let name = victim.line.split(' ').take(2).collect::<Vec<_>>().join(" ");
    let scratch = tempfile::tempdir().unwrap();
    let log = scratch.path().join("said");
    let calm = copy_of(victim.made, victim.given);
    let begun = Instant::now();
    succeed(calm.path(), &victim.line);
    let mut lasts = begun.elapsed();
    let expected = files(calm.path());
    assert_eq!(hidden(&expected), Vec::<&String>::new(), "{name} leaves hidden files");

    let mut tally = Tally::default();
    for _ in 0..rounds() {
        let mut dir = copy_of(victim.made, victim.given);
        let before = files(dir.path());
        let mut kill = 0;
        while kill < KILLS {
            // The last moments, where files come to their places, are as long as all before them.
            let at = if kill % 2 == 0 { dice.roll() } else { 0.7 + 0.35 * dice.roll() };
            let line = victim.line_in(dir.path());
            let begun = Instant::now();
            let ended = kill_after(start(dir.path(), &line, &log), lasts.mul_f64(at));
            kill += 1;
            if let Some(status) = ended {
                let refused = fs::read_to_string(&log).unwrap();
                assert!(status.success() || is_there_already(&refused), "`{line}` after {kill} kills: {refused}");
                tally.late += 1;
                // The undisturbed run may have been slowed down by others.
                lasts = lasts.min(begun.elapsed());
                check_same(&line, &files(dir.path()), &expected);
                dir = copy_of(victim.made, victim.given);
                continue;
            }
            tally.kills += 1;
            check_left(victim, dir.path(), &before, &expected);
        }
        let line = victim.line_in(dir.path());
        let output = run(dir.path(), &line);
        let refused = said(&output);
        assert!(output.status.success() || is_there_already(&refused), "`{line}` after kills: {refused}");
        check_same(&line, &files(dir.path()), &expected);
    }
    eprintln!("| `{}` | {} | {} | {:.2} |", victim.line, tally.kills, tally.late, lasts.as_secs_f64());
}

/// Whether a command refused to write over what is there: a kill after its result came to its place leaves that. The
/// callers compare the files with the undisturbed run's, so that only a whole result counts.
fn is_there_already(refused: &str) -> bool {
    refused.contains("already exists")
}

/// Checks that two runs left the same files, and nothing else.
pub(crate) fn check_same(line: &str, found: &BTreeMap<String, Vec<u8>>, expected: &BTreeMap<String, Vec<u8>>) {
    let names = |files: &BTreeMap<String, Vec<u8>>| files.keys().cloned().collect::<Vec<_>>();
    assert_eq!(names(found), names(expected), "what `{line}` left");
    for (file, bytes) in expected {
        let at = bytes.iter().zip(&found[file]).position(|(a, b)| a != b);
        let text = |bytes: &[u8]| {
            let from = at.unwrap_or(0).saturating_sub(60);
            String::from_utf8_lossy(&bytes[from..bytes.len().min(from + 120)]).into_owned()
        };
        assert!(
            found[file] == *bytes,
            "{file} of `{line}` differs at {at:?}: {} | {}",
            text(&found[file]),
            text(bytes)
        );
    }
}

/// What lies there after a kill: files as they were before or of the undisturbed run and, hidden, what is not whole.
fn check_left(victim: &Victim, dir: &Path, before: &BTreeMap<String, Vec<u8>>, expected: &BTreeMap<String, Vec<u8>>) {
    let found = files_but_hidden(dir);
    for (name, bytes) in &found {
        // A folder that was made for a lock or for files to come.
        if name.ends_with('/') {
            continue;
        }
        if victim.grows(name) {
            // A line of metrics may be cut: the next run takes it back.
            if Path::new(name).extension().is_none_or(|e| e != "jsonl") {
                check_whole(dir, name);
            }
            continue;
        }
        let is_whole = [before, expected].iter().any(|files| files.get(name) == Some(bytes));
        assert!(is_whole, "a killed `{}` left {name}, {} bytes", victim.line, bytes.len());
    }
}

/// As [`files`], without what is hidden or a table that grows.
fn files_but_hidden(dir: &Path) -> BTreeMap<String, Vec<u8>> {
    // Parsing files that are not whole would end the test: they are moved out of its sight.
    let seen = tempfile::tempdir().unwrap();
    copy_visible(dir, seen.path());
    files(seen.path())
}

fn copy_visible(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        let name = entry.file_name();
        let text = name.to_str().unwrap();
        let ending = Path::new(text).extension().and_then(|e| e.to_str());
        if text.starts_with('.') || ending == Some("jsonl") {
            continue;
        }
        if entry.path().is_dir() {
            copy_visible(&entry.path(), &to.join(name));
        } else {
            fs::copy(entry.path(), to.join(name)).unwrap();
        }
    }
}

/// The commands up to a dataset.
pub(crate) fn of_datasets() -> Vec<Victim> {
    vec![
        Victim::new(Made::Dataset, &["capture"], "capture -q record --input capture/video.mp4 --out take"),
        Victim::new(
            Made::Dataset,
            &["capture", "take"],
            "capture -q record --input capture/video.mp4 --out take --force",
        ),
        Victim::new(Made::Dataset, &["capture", "take"], "tracker -q import take --openface capture/openface.csv"),
        Victim::new(Made::Dataset, &["capture", "take"], "tracker -q poses take --colmap-model capture/truth_colmap"),
        Victim::new(Made::Dataset, &["take"], "dataset -q build take --balance --frames 24 --scale 2 --out dataset"),
        // One that is there is replaced, and there is a whole one at each moment.
        Victim::new(
            Made::Dataset,
            &["take", "dataset"],
            "dataset -q build take --balance --frames 24 --scale 2 --out dataset",
        ),
        Victim::new(Made::Dataset, &["dataset"], "dataset -q export dataset --to transforms --out there"),
        Victim::new(Made::Dataset, &["dataset"], "dataset -q import dataset --out again"),
    ]
}

/// The commands from a dataset on.
pub(crate) fn of_avatars() -> Vec<Victim> {
    const FIT: &[&str] = &["new/"];
    let fit = |line: &str| Victim::new(Made::Run, &["dataset"], line).going_on("new/settings.toml", "--resume", FIT);
    let made_of_it = |line: &str| Victim::new(Made::Run, &["run", "dataset", "driver"], line);
    vec![
        fit("trainer -q fit dataset --out new --steps 60 --checkpoint-every 30 --set splat.gaussians=2000"),
        fit("trainer -q fit dataset --out new --field confies --preset tiny --steps 60 --checkpoint-every 30"),
        made_of_it("trainer -q render run --orbit 12 --out pictures").going_on(
            "pictures/render.json",
            "--resume",
            &["pictures/render.json"],
        ),
        made_of_it("trainer -q render run --orbit 6 --video orbit.mp4"),
        made_of_it("trainer -q eval run --lpips none --out judged"),
        made_of_it("trainer -q transfer run --from driver --fps 6 --out driven --video driven.mp4"),
        made_of_it("trainer -q export run --out avatar.glb --columns 24"),
    ]
}

#[test]
fn takes_tracks_cameras_and_datasets_survive() {
    world(Made::Dataset);
    let mut dice = Dice(1);
    eprintln!("| command | kills | ended before its kill | undisturbed s |\n|---|---|---|---|");
    let mut victims = of_datasets();
    if models().is_some() {
        victims.push(Victim::new(Made::Dataset, &["take"], "tracker -q run take --threads 1"));
    }
    if rounds() > 1 {
        for to in ["nerfies", "colmap", "parquet"] {
            let line = format!("dataset -q export dataset --to {to} --out there");
            victims.push(Victim::new(Made::Dataset, &["dataset"], &line));
        }
    }
    for victim in &victims {
        torment(victim, &mut dice);
    }
}

#[test]
fn avatars_and_what_is_made_of_them_survive() {
    world(Made::Run);
    let mut dice = Dice(2);
    eprintln!("| command | kills | ended before its kill | undisturbed s |\n|---|---|---|---|");
    let victims = of_avatars();
    for victim in &victims {
        torment(victim, &mut dice);
    }
}

/// Times are the synthetic camera's: what is recorded differs from run to run, so it is only asked to be whole.
#[test]
fn a_killed_recording_becomes_a_take() {
    let dir = tempfile::tempdir().unwrap();
    let mut dice = Dice(3);
    let log = dir.path().join("said");
    let (mut kills, mut before_it_began) = (0, 0);
    for round in 0..2 + rounds() {
        let line = "capture -q record --device synthetic:160x120@60 --warm-up 0ms --duration 3s --out take";
        let life = Duration::from_secs_f64(if round == 0 { 0.2 } else { 1.2 + 1.5 * dice.roll() });
        let ended = kill_after(start(dir.path(), line, &log), life);
        assert!(ended.is_none(), "{}", fs::read_to_string(&log).unwrap());
        kills += 1;
        let take = dir.path().join("take");
        let rows = fs::read_to_string(take.join("recording.csv")).map_or(0, |t| t.lines().count().saturating_sub(1));
        let output = run(dir.path(), "capture -q recover take");
        if rows == 0 {
            // Nothing was on the disk yet: that is said, and the place is free again after asking for it.
            before_it_began += 1;
            assert!(!output.status.success() || take.join("take.toml").is_file(), "{}", said(&output));
            if take.exists() {
                fs::remove_dir_all(&take).unwrap();
            }
            continue;
        }
        assert!(output.status.success(), "{}", said(&output));
        succeed(dir.path(), "capture -q check take --json");
        let frames = fs::read_to_string(take.join("frames.csv")).unwrap().lines().count() - 1;
        assert!(frames >= rows, "{frames} frames of {rows} that were written down");
        let found = files(&take);
        assert!(hidden(&found).is_empty(), "{:?}", found.keys());
        fs::remove_dir_all(&take).unwrap();
    }
    eprintln!("| `capture record --device` | {kills} | {before_it_began} before a frame was on the disk | |");
    fs::remove_file(&log).unwrap();
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0, "nothing beside the take");
}

/// Five starts that are killed leave no more than one does: the lock of the result, and what is not whole.
#[test]
fn what_killed_processes_leave_does_not_add_up() {
    world(Made::Take);
    let dir = copy_of(Made::Take, &["take"]);
    let line = "dataset -q build take --balance --frames 24 --scale 2 --out dataset";
    let log = dir.path().join("said");
    let parts = || -> Vec<String> {
        files_now(dir.path()).into_keys().filter(|n| n.starts_with('.') && n.contains(".part")).collect()
    };
    for round in 0..5 {
        // Killed as soon as something of its own lies there.
        let before = parts();
        let mut child = start(dir.path(), line, &log);
        while child.try_wait().unwrap().is_none() && parts().iter().all(|part| before.contains(part)) {
            std::thread::sleep(Duration::from_millis(1));
        }
        child.kill().unwrap();
        child.wait().unwrap();
        let left: Vec<String> = files_now(dir.path()).into_keys().filter(|n| n.starts_with('.')).collect();
        let others = left.iter().filter(|n| *n != ".dataset.lock").count();
        assert!(others <= 1, "after {} kills there are {left:?}", round + 1);
    }
    succeed(dir.path(), line);
    fs::remove_file(&log).unwrap();
    assert!(hidden(&files(dir.path())).is_empty());
}

/// The entries of `dir` itself by name, however they change.
fn files_now(dir: &Path) -> BTreeMap<String, Vec<u8>> {
    let entries = fs::read_dir(dir).into_iter().flatten().flatten();
    entries.map(|e| (e.file_name().to_string_lossy().into_owned(), Vec::new())).collect()
}
