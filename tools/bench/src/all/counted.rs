//! Instructions of a command, as valgrind counts them: the same on a busy machine as on a quiet one.

use std::path::Path;
use std::process::{Command, Stdio};

use risorius_console::Failure;
use risorius_formats::FormatError;

/// Runs `program` on one thread under callgrind; `None` where there is no valgrind.
pub(crate) fn instructions(program: &str, args: &[&str], scratch: &Path) -> Result<Option<u64>, Failure> {
    if Command::new("valgrind").arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status().is_err() {
        return Ok(None);
    }
    let here = std::env::current_exe().map_err(|e| FormatError::io("/proc/self/exe", "find", &e))?;
    let log = scratch.join("callgrind.log");
    let output = Command::new("valgrind")
        .args(["--tool=callgrind", "--callgrind-out-file=/dev/null"])
        .arg(format!("--log-file={}", log.display()))
        .arg(here.with_file_name(program))
        .args(args)
        .arg("-q")
        .env("RAYON_NUM_THREADS", "1")
        .env("POLARS_MAX_THREADS", "1")
        .output()
        .map_err(|e| FormatError::io("valgrind", "start", &e))?;
    if !output.status.success() {
        return Err(Failure::input(format!("`{program} {}` failed under valgrind", args.join(" ")))
            .with_hint(String::from_utf8_lossy(&output.stderr).trim().to_owned()));
    }
    let text = std::fs::read_to_string(&log).map_err(|e| FormatError::io(&log, "read", &e))?;
    Ok(text.lines().rev().find_map(|line| line.split_once("Collected :")?.1.trim().parse().ok()))
}
