//! `risorius doctor`: what this machine has for each stage, and the one command that fixes each gap.

mod machine;
mod software;

use std::fmt::Write as _;

use clap::Args;
use risorius_console::{Console, Failure};
use serde::Serialize;

/// Say what this machine has, and how to get what it lacks
///
/// Looks for networks, ONNX Runtime, COLMAP, video decoders, cameras, vector instructions, memory, disk space and GPUs.
/// Exit code 1 if something is missing that `risorius avatar` cannot do without.
#[derive(Args, Debug)]
#[command(after_help = "Examples:\n  risorius doctor\n  risorius doctor --json")]
pub(crate) struct DoctorArgs {}

/// How a finding is to be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
enum State {
    /// It is there.
    Ok,
    /// It is not there; something does without it, or slower.
    Optional,
    /// It is not there, and `risorius avatar` needs it.
    Missing,
}

/// One thing that was looked at.
#[derive(Clone, Debug, Serialize)]
struct Finding {
    /// A stable name, such as `colmap`.
    name: &'static str,
    title: &'static str,
    state: State,
    /// What was found.
    found: String,
    /// What it is for, where it is not there.
    #[serde(skip_serializing_if = "Option::is_none")]
    needed_for: Option<&'static str>,
    /// The command that gets it.
    #[serde(skip_serializing_if = "Option::is_none")]
    fix: Option<String>,
}

impl Finding {
    fn ok(name: &'static str, title: &'static str, found: impl Into<String>) -> Self {
        Self { name, title, state: State::Ok, found: found.into(), needed_for: None, fix: None }
    }

    fn lacking(self, state: State, needed_for: &'static str, fix: impl Into<String>) -> Self {
        Self { state, needed_for: Some(needed_for), fix: Some(fix.into()), ..self }
    }
}

/// The document of `--json`.
#[derive(Serialize)]
struct Document<'a> {
    version: &'static str,
    /// Whether nothing is missing that `risorius avatar` needs.
    ready: bool,
    findings: &'a [Finding],
}

pub(crate) fn run(_: &DoctorArgs, console: &Console) -> Result<(), Failure> {
    let findings = [software::look(), machine::look()].concat();
    let missing: Vec<&Finding> = findings.iter().filter(|f| f.state == State::Missing).collect();
    let ready = missing.is_empty();
    let document = Document { version: env!("CARGO_PKG_VERSION"), ready, findings: &findings };
    console.finish(&document, &text(&findings));
    match missing.first().and_then(|f| f.fix.clone()) {
        None => Ok(()),
        Some(fix) => {
            let names: Vec<&str> = missing.iter().map(|f| f.title).collect();
            Err(Failure::input(format!("missing: {}", names.join(", "))).of_installation().with_hint(fix))
        }
    }
}

fn text(findings: &[Finding]) -> String {
    let mut text = String::new();
    for f in findings {
        let sign = match f.state {
            State::Ok => "ok",
            State::Optional => "–",
            State::Missing => "missing",
        };
        let _ = writeln!(text, "{sign:>7}  {:<18} {}", f.title, f.found);
        if let Some(what) = f.needed_for {
            let _ = writeln!(text, "{:>28}for {what}", "");
        }
        if let Some(fix) = &f.fix {
            let _ = writeln!(text, "{:>28}get it: {fix}", "");
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gap_says_what_it_is_for_and_how_to_close_it() {
        let findings = [
            Finding::ok("cores", "CPU cores", "2"),
            Finding::ok("colmap", "COLMAP", "not found").lacking(State::Optional, "moving cameras", "`x`"),
        ];
        let text = text(&findings);
        assert!(text.contains("     ok  CPU cores          2\n"), "{text}");
        assert!(text.contains("for moving cameras\n") && text.contains("get it: `x`"), "{text}");
    }
}
