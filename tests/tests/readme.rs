//! Every command that the README shows is run, on a small capture, in the README's order: one that no longer works as it
//! is written there fails. What needs a camera, COLMAP or the network is only parsed, and says so.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]
#![allow(clippy::print_stderr, reason = "a test that is skipped has to say so")]
#![allow(dead_code, reason = "the world is shared with the tests of faults")]

#[path = "faults/world.rs"]
mod world;

use std::fs;
use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::Stdio;

use world::{Made, command, copy, models, run, said, succeed};

/// The commands of the README's fenced blocks, without prompts and comments, alternatives written out.
fn commands(readme: &str) -> Vec<String> {
    let mut found = Vec::new();
    let mut inside = false;
    for line in readme.lines() {
        if let Some(kind) = line.strip_prefix("```") {
            inside = !inside && matches!(kind, "sh" | "bash" | "console");
            continue;
        }
        let line = line.split(" #").next().unwrap_or_default().trim();
        if !inside || line.is_empty() || line.starts_with('#') {
            continue;
        }
        let words: Vec<&str> = line.split_whitespace().collect();
        // What is joined by a pipe is run one by one.
        if words.contains(&"|") {
            found.extend(words.split(|w| *w == "|").map(|part| part.join(" ")));
            continue;
        }
        // `a|b|c` stands for any of them.
        match words.iter().position(|w| w.contains('|') && w.len() > 1) {
            Some(at) => found.extend(words[at].split('|').map(|choice| {
                let mut words = words.clone();
                words[at] = choice;
                words.join(" ")
            })),
            None => found.push(words.join(" ")),
        }
    }
    found
}

/// How a command is run here.
enum How {
    /// As it stands, or with something smaller.
    Run(String),
    /// Only its words are looked at, for this reason.
    Parse(&'static str),
    /// It serves until it is stopped.
    Serve,
    /// A script of the repository, which has to be there.
    Script,
}

fn how(line: &str, has_models: bool) -> How {
    let has = |word: &str| line.split(' ').any(|w| w == word);
    if line.starts_with("tools/") {
        How::Script
    } else if (has("--device") && line.contains("/dev/")) || line == "tracker live" {
        How::Parse("it needs a camera")
    } else if line.starts_with("tracker poses") && !has("--colmap-model") {
        How::Parse("it needs COLMAP")
    } else if line.starts_with("tracker run") && !has_models {
        How::Parse("it needs the networks of `tools/models`")
    } else if line.starts_with("risorius models") {
        How::Parse("it needs the network")
    } else if line.starts_with("risorius avatar") {
        How::Parse("`one_command` runs it")
    } else if line.starts_with("trainer view") {
        How::Serve
    } else if line.starts_with("trainer fit") {
        How::Run(line.replace("--budget 1m", "--steps 60").replace("--preset paper", "--preset tiny"))
    } else if line.starts_with("trainer eval") {
        // The tracker reads AUs from faces that it finds, of which this avatar has none yet.
        let small = line.replace(" --control", "");
        How::Run(if has("--lpips") { small } else { small + " --lpips none" })
    } else {
        How::Run(line.replace("--frames 750", "--frames 24").replace("--orbit 60", "--orbit 6"))
    }
}

#[test]
fn every_command_of_the_readme_works() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let readme = fs::read_to_string(root.join("README.md")).unwrap();
    let lines = commands(&readme);
    let of_programs = lines.iter().filter(|l| !l.starts_with("tools/")).count();
    assert!(of_programs >= 15, "the README shows too few commands to be read right: {lines:?}");

    // The names that the README uses, of a small capture.
    let made = world::world(Made::Run);
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    copy(&made.join("capture/video.mp4"), &at("face.mp4"));
    copy(&made.join("capture/openface.csv"), &at("face.csv"));
    fs::create_dir_all(at("sparse")).unwrap();
    copy(&made.join("capture/truth_colmap"), &at("sparse/0"));
    copy(&made.join("capture/test"), &at("test"));
    fs::create_dir_all(at("takes")).unwrap();
    copy(&made.join("driver"), &at("takes/bob"));

    let has_models = models().is_some();
    for line in &lines {
        match how(line, has_models) {
            How::Script => {
                let script = root.join(line.split(' ').next().unwrap());
                assert!(script.is_file(), "the README shows `{line}`, which is not there");
            }
            How::Parse(why) => {
                eprintln!("SKIPPED but parsed: `{line}`: {why}");
                // Clap looks at each word before it comes to the last one.
                let output = run(dir.path(), &format!("{line} --help"));
                assert!(output.status.success(), "`{line}`: {}", said(&output));
            }
            How::Serve => {
                let mut child = command(dir.path(), line).stderr(Stdio::piped()).spawn().unwrap();
                let mut words = String::new();
                BufReader::new(child.stderr.take().unwrap()).read_line(&mut words).unwrap();
                child.kill().unwrap();
                child.wait().unwrap();
                assert!(words.contains("http://127.0.0.1:"), "`{line}`: {words}");
            }
            How::Run(line) => {
                // A take is made twice in the README, of a file and of a camera, and tracked twice.
                let output = succeed(dir.path(), &line);
                drop(output);
            }
        }
    }
    // What they leave is what the README says.
    for file in
        ["takes/ada/take.toml", "datasets/ada/dataset.json", "runs/ada/model.json", "orbit.mp4", "ada.glb", "ada.html"]
    {
        assert!(at(file).is_file(), "no command of the README makes {file}");
    }
}

#[test]
fn commands_are_found_in_fenced_blocks() {
    let text = "a\n```sh\nx here | y there\ntools/demo\n\n# words\nx one --to a|b --out c   # more | words\n        # still more\n```\ny not\n```toml\nz = 1\n```\n";
    assert_eq!(commands(text), ["x here", "y there", "tools/demo", "x one --to a --out c", "x one --to b --out c"]);
}
