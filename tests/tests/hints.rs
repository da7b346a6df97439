//! What errors advise can be done: every command and option in a message exists, and every install command was tried.
//!
//! The sources are searched for commands in backticks inside of string literals, the documentation for install commands. A
//! command of ours is asked for its `--help`; an option has to stand there. Anything else has to be listed below, where it
//! says how it was tried: a new one cannot go untried.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

use risorius_tests::binary;

/// Commands of others that messages name, and what each is known to do on Debian 12.
const TRIED: [(&str, &str); 15] = [
    ("apt-get update && apt-get install colmap", "installs COLMAP 3.8"),
    ("apt-get update && apt-get install python3-pip", "`tools/models` runs then"),
    ("apt-get install python3-venv", "`python3 -m venv` runs then"),
    ("python3 -m venv venv", "after `apt-get install python3-venv`"),
    ("venv/bin/pip install pycolmap", "`tracker poses --colmap venv/bin/python` runs then"),
    ("venv/bin/python", "a path, not a command"),
    ("LC_ALL=C FeatureExtraction …", "OpenFace's program by its name"),
    ("colmap image_undistorter", "a command of COLMAP 3.8"),
    ("colmap {step}", "the step that failed, not advice"),
    ("colmap model_converter --input_path DIR --output_path DIR --output_type TXT", "run with COLMAP 3.8"),
    ("cargo build --release", "builds the programs"),
    ("cargo build --release --workspace", "builds the programs"),
    ("cargo build --release --features risorius-trainer/{name}", "type-checked with `wgpu` and `cuda`"),
    ("--features nokhwa", "of `cargo build`; compiled"),
    ("--features risorius-trainer/{name}", "of `cargo build`; type-checked with `wgpu` and `cuda`"),
];
/// Options of other programs.
const FOREIGN_OPTIONS: [&str; 1] = ["--ImageReader.camera_model"];
/// Packages of Debian 12 and Ubuntu 24.04 that texts ask to install.
const PACKAGES: [&str; 15] = [
    "colmap",
    "python3-pip",
    "python3-venv",
    "python3",
    "g++",
    "mesa-vulkan-drivers",
    "libavcodec-dev",
    "libavformat-dev",
    "libavutil-dev",
    "libswscale-dev",
    "clang",
    "libclang-dev",
    "pkg-config",
    "ffmpeg",
    "valgrind",
];
const BINARIES: [&str; 5] = ["capture", "tracker", "dataset", "trainer", "risorius"];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// All files below `dir` with one of the endings; test code is left out.
fn files(dir: &Path, endings: &[&str], found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(dir).into_iter().flatten().flatten() {
        let (path, name) = (entry.path(), entry.file_name().to_string_lossy().into_owned());
        if path.is_dir() {
            if !["target", "tests", "fuzz", "golden", "examples", "model-fetch"].contains(&name.as_str()) {
                files(&path, endings, found);
            }
        } else if endings.iter().any(|e| name.ends_with(e)) && !name.contains("test") {
            found.push(path);
        }
    }
}

/// The string literals of Rust source, without its comments and its unit tests.
fn literals(source: &str) -> Vec<String> {
    let source = source.split("#[cfg(test)]\nmod ").next().unwrap_or_default();
    let chars: Vec<char> = source.chars().collect();
    let (mut found, mut at) = (Vec::new(), 0);
    while at < chars.len() {
        let next = chars.get(at + 1).copied();
        match chars[at] {
            '/' if next == Some('/') => at += chars[at..].iter().take_while(|c| **c != '\n').count(),
            // A character such as '"'; a lifetime has no closing quote.
            '\'' if next == Some('\\') => at += 2 + chars[at + 2..].iter().take_while(|c| **c != '\'').count() + 1,
            '\'' if chars.get(at + 2) == Some(&'\'') => at += 3,
            '"' => {
                let mut text = String::new();
                at += 1;
                while at < chars.len() && chars[at] != '"' {
                    if chars[at] == '\\' && at + 1 < chars.len() {
                        at += 1;
                        // The end of a line and the indentation of the next one are no part of the text.
                        if chars.get(at) == Some(&'\n') {
                            at += chars[at..].iter().take_while(|c| c.is_whitespace()).count();
                            continue;
                        }
                    }
                    let escaped = at > 0 && chars[at - 1] == '\\' && chars[at] == 'n';
                    text.push(if escaped { '\n' } else { chars[at] });
                    at += 1;
                }
                found.push(text);
                at += 1;
            }
            _ => at += 1,
        }
    }
    found
}

/// What stands between backticks.
fn quoted(text: &str) -> impl Iterator<Item = &str> {
    text.split('`').skip(1).step_by(2)
}

/// Whether a text in backticks is something to type.
fn is_command(text: &str) -> bool {
    let ours = BINARIES.iter().any(|b| text.strip_prefix(b).is_some_and(|rest| rest.starts_with(' ')));
    let starts = ["--", "tools/", "apt", "pip", "python", "venv/", "colmap ", "LC_ALL", "cargo ", "sudo ", "risorius "];
    // A block of code in a text, and an option whose name is filled in.
    if text.contains('\n') || text.starts_with("--{") {
        return false;
    }
    ours || starts.iter().any(|s| text.starts_with(s) && text.len() > s.len())
}

/// The help of each command of the programs, by program and command.
fn helps() -> BTreeMap<(String, String), String> {
    let help = |name: &str, args: &[&str]| {
        let output = Command::new(binary(name)).args(args).arg("--help").output();
        let output = output.unwrap_or_else(|e| panic!("{name} cannot be started: {e}; build the workspace first"));
        String::from_utf8_lossy(&output.stdout).into_owned()
    };
    let mut found = BTreeMap::new();
    for name in BINARIES {
        let whole = help(name, &[]);
        let commands = whole.lines().skip_while(|l| !l.starts_with("Commands:")).skip(1);
        for line in
            commands.take_while(|l| !l.trim().is_empty()).filter(|l| l.starts_with("  ") && !l.starts_with("   "))
        {
            let command = line.split_whitespace().next().unwrap_or_default();
            found.insert((name.to_owned(), command.to_owned()), help(name, &[command]));
        }
        found.insert((name.to_owned(), String::new()), whole);
    }
    found
}

/// The options in a command, without values and punctuation.
fn options(words: &str) -> Vec<String> {
    let trimmed = |w: &str| w.split('=').next().unwrap_or_default().trim_end_matches([',', '.', ')', ';']).to_owned();
    words.split_whitespace().filter(|w| w.starts_with("--") && w.len() > 2).map(trimmed).collect()
}

fn has_option(help: &str, option: &str) -> bool {
    help.match_indices(option)
        .any(|(at, _)| !help[at + option.len()..].starts_with(|c: char| c.is_ascii_alphanumeric() || c == '-'))
}

/// What is wrong with a command of a message in the crate `krate`; `None` for nothing.
fn fault(command: &str, krate: &str, helps: &BTreeMap<(String, String), String>) -> Option<String> {
    if TRIED.iter().any(|(tried, _)| *tried == command) {
        return None;
    }
    let mut words = command.split_whitespace();
    let first = words.next()?;
    if let Some(name) = BINARIES.iter().find(|b| **b == first) {
        let sub = words.next().filter(|w| !w.starts_with('-')).unwrap_or_default();
        // `risorius tracker run` is `tracker run`.
        if first == "risorius" && BINARIES.contains(&sub) {
            return fault(command.trim_start_matches("risorius").trim_start(), krate, helps);
        }
        let Some(help) = helps.get(&((*name).to_owned(), sub.to_owned())) else {
            return Some(format!("`{name}` has no command `{sub}`"));
        };
        let unknown = options(command).into_iter().find(|o| !has_option(help, o));
        return unknown.map(|o| format!("`{name} {sub}` has no option `{o}`"));
    }
    if first.starts_with("--") {
        let own = BINARIES.contains(&krate);
        let known = |option: &String| {
            FOREIGN_OPTIONS.contains(&option.as_str())
                || helps.iter().any(|((b, _), help)| (!own || b == krate) && has_option(help, option))
        };
        return options(command).into_iter().find(|o| !known(o)).map(|o| format!("there is no option `{o}`"));
    }
    if first.starts_with("tools/") {
        let Ok(text) = std::fs::read_to_string(root().join(first)) else {
            return root().join(first).is_dir().then_some(()).map_or(Some(format!("there is no `{first}`")), |()| None);
        };
        let unknown = options(command).into_iter().find(|o| !text.contains(o.as_str()));
        return unknown.map(|o| format!("`{first}` has no option `{o}`"));
    }
    Some("was not tried: try it on a bare Debian 12 and list it in this test".to_owned())
}

#[test]
fn every_command_in_a_message_can_be_typed() {
    let helps = helps();
    let (mut sources, mut seen) = (Vec::new(), 0);
    // The programs in `tools/bench` and `tools/synth` are for those who work on the project.
    for krate in
        ["formats", "capture", "tracker", "dataset", "trainer", "tools/console", "tools/video", "tools/risorius"]
    {
        files(&root().join(krate), &[".rs"], &mut sources);
    }
    let mut faults = BTreeSet::new();
    for path in sources {
        let relative = path.strip_prefix(root()).unwrap_or(&path).to_owned();
        let krate = relative.iter().next().unwrap_or_default().to_string_lossy().into_owned();
        let text = std::fs::read_to_string(&path).unwrap();
        for literal in literals(&text) {
            for command in quoted(&literal).filter(|c| is_command(c)) {
                seen += 1;
                if let Some(fault) = fault(command, &krate, &helps) {
                    faults.insert(format!("{}: `{command}`: {fault}", relative.display()));
                }
            }
        }
    }
    assert!(seen > 60, "only {seen} commands were found: the search is broken");
    assert!(faults.is_empty(), "{}", faults.into_iter().collect::<Vec<_>>().join("\n"));
}

#[test]
fn install_commands_work_where_python_is_managed_by_the_system() {
    let mut texts = Vec::new();
    for dir in ["docs", "tools", "tests", "tracker/src", "trainer/tests"] {
        files(
            &root().join(dir),
            &[".md", ".py", ".rs", ".yaml", ".txt", "setup", "models", "demo", "test"],
            &mut texts,
        );
    }
    texts.push(root().join("README.md"));
    let mut faults = Vec::new();
    for path in texts {
        let Ok(text) = std::fs::read_to_string(&path) else { continue };
        for (line, number) in text.lines().zip(1..) {
            let place = format!("{}:{number}", path.strip_prefix(root()).unwrap_or(&path).display());
            // Debian 12 and Ubuntu 24.04 refuse pip outside of a virtual environment.
            let allowed = ["bin/pip install", "bin/pip\" install", "--target"].iter().any(|w| line.contains(w));
            if line.contains("pip install") && !allowed {
                faults.push(format!("{place}: pip outside of a venv: {}", line.trim()));
            }
            for install in ["apt install ", "apt-get install "] {
                for (at, _) in line.match_indices(install) {
                    // The command ends with its backticks, or with the clause.
                    let command =
                        line[at + install.len()..].split(['`', ',', ')', ';', '&']).next().unwrap_or_default();
                    let names = command.split_whitespace().filter(|w| !w.starts_with('-'));
                    let names = names.take_while(|w| w.starts_with(|c: char| c.is_ascii_lowercase()));
                    let mut bare = names.map(|w| w.trim_end_matches(|c: char| !c.is_ascii_alphanumeric() && c != '+'));
                    let unknown = bare.find(|w| !PACKAGES.contains(w));
                    faults.extend(unknown.map(|w| format!("{place}: the package `{w}` was not tried")));
                }
            }
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}
