//! The programs beside this one, run as a user runs them and measured from outside.

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Instant;

use risorius_console::Failure;
use risorius_formats::FormatError;
use serde_json::Value;
use wait4::Wait4 as _;

/// What a program printed and used.
#[derive(Clone, Debug)]
pub struct Run {
    /// Its JSON document.
    pub document: Value,
    /// Seconds on the wall.
    pub wall_secs: f64,
    /// Seconds of all cores.
    pub cpu_secs: f64,
    /// Most memory it held, MiB.
    pub peak_mib: f64,
}

/// Runs `program` with `--json -q`; `scratch` takes what it prints.
pub fn run(program: &str, args: &[&str], scratch: &Path) -> Result<Run, Failure> {
    let here = std::env::current_exe().map_err(|e| FormatError::io("/proc/self/exe", "find", &e))?;
    let started = Instant::now();
    // A file, not a pipe: the child must never wait for this program to read.
    let path = scratch.join("last.json");
    let file = std::fs::File::create(&path).map_err(|e| FormatError::io(&path, "create", &e))?;
    let mut child = Command::new(here.with_file_name(program))
        .args(args)
        .args(["--json", "-q"])
        .stdout(Stdio::from(file))
        .spawn()
        .map_err(|e| {
            FormatError::io(program, "start", &e).with_hint("build everything with `cargo build --release --workspace`")
        })?;
    let used = child.wait4().map_err(|e| FormatError::io(program, "wait for", &e))?;
    let wall_secs = started.elapsed().as_secs_f64();
    let text = std::fs::read(&path).map_err(|e| FormatError::io(&path, "read", &e))?;
    if !used.status.success() {
        return Err(Failure::input(format!("`{program} {}` failed", args.join(" ")))
            .with_hint(String::from_utf8_lossy(&text).trim().to_owned()));
    }
    Ok(Run {
        document: serde_json::from_slice(&text).unwrap_or(Value::Null),
        wall_secs,
        cpu_secs: used.rusage.utime.as_secs_f64() + used.rusage.stime.as_secs_f64(),
        peak_mib: used.rusage.maxrss as f64 / (1024.0 * 1024.0),
    })
}
