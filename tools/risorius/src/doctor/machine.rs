//! Cameras, vector instructions, cores, memory, disk space, GPUs.

use std::path::Path;

use super::{Finding, State};

/// A fit of the default size takes about 0.7 GB; tracking and COLMAP stay below.
const LEAST_MEMORY: f64 = 2e9;
/// An avatar's folder takes 0.3 GB for 20 s of 540×960 at 120 frames/s.
const LEAST_DISK: f64 = 2e9;

pub(super) fn look() -> Vec<Finding> {
    let mut findings = vec![cameras(), instructions(), cores()];
    findings.extend(memory());
    findings.extend(disk());
    findings.extend(gpus());
    findings
}

fn cameras() -> Finding {
    let all = risorius_capture::devices::cameras(Path::new(risorius_capture::devices::SYSFS));
    let finding = |text: String| Finding::ok("cameras", "cameras", text);
    let (open, shut): (Vec<_>, Vec<_>) = all.iter().partition(|c| c.error.is_none());
    let names: Vec<String> = open.iter().map(|c| format!("{} ({})", c.id, c.name)).collect();
    match (names.is_empty(), shut.first()) {
        (false, _) => finding(names.join(", ")),
        (true, Some(camera)) => {
            let error = camera.error.clone().unwrap_or_default();
            finding(format!("{} cannot be opened: {error}", camera.id)).lacking(
                State::Optional,
                "recording (`risorius capture record --device`)",
                "on Linux: add yourself to the group `video`, then log in again",
            )
        }
        (true, None) => finding("none".to_owned()).lacking(
            State::Optional,
            "recording; videos from a phone do as well",
            "plug one in; `risorius capture devices` lists it",
        ),
    }
}

fn instructions() -> Finding {
    #[cfg(target_arch = "x86_64")]
    let (found, fast) = {
        let all = [
            ("AVX2", is_x86_feature_detected!("avx2")),
            ("FMA", is_x86_feature_detected!("fma")),
            ("AVX-512", is_x86_feature_detected!("avx512f")),
        ];
        let there: Vec<&str> = all.iter().filter(|(_, has)| *has).map(|(name, _)| *name).collect();
        (if there.is_empty() { "SSE2 only".to_owned() } else { there.join(", ") }, all[0].1 && all[1].1)
    };
    #[cfg(not(target_arch = "x86_64"))]
    let (found, fast) = (std::env::consts::ARCH.to_owned(), true);
    let finding = Finding::ok("instructions", "CPU instructions", found);
    if fast {
        finding
    } else {
        finding.lacking(State::Optional, "fitting and rendering at full speed", "a CPU of 2014 or later")
    }
}

fn cores() -> Finding {
    let count = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    Finding::ok("cores", "CPU cores", count.to_string())
}

/// `MemTotal` and `MemAvailable`, where the system tells.
fn memory() -> Option<Finding> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let read = |name: &str| {
        let line = text.lines().find_map(|l| l.strip_prefix(name))?;
        Some(line.split_whitespace().nth(1)?.parse::<f64>().ok()? * 1024.0)
    };
    let (total, free) = (read("MemTotal")?, read("MemAvailable")?);
    let finding = Finding::ok("memory", "memory", format!("{} free of {}", gigabytes(free), gigabytes(total)));
    let close = "close other programs";
    Some(if free < LEAST_MEMORY {
        finding.lacking(State::Optional, "a fit, which takes about 0.7 GB", close)
    } else {
        finding
    })
}

/// Free space where the command was typed.
fn disk() -> Option<Finding> {
    let stat = rustix::fs::statvfs(".").ok()?;
    let free = stat.f_bavail as f64 * stat.f_frsize as f64;
    let finding = Finding::ok("disk", "disk space", format!("{} free here", gigabytes(free)));
    let what = "an avatar's folder, some hundred MB";
    Some(if free < LEAST_DISK {
        finding.lacking(State::Optional, what, "`du -sh *` shows what takes space")
    } else {
        finding
    })
}

fn gpus() -> Vec<Finding> {
    let kinds = risorius_trainer::devices::list().into_iter().filter(|k| k.name != "cpu");
    let of = |k: risorius_trainer::devices::DeviceKind| {
        let (name, title) = (k.name, if k.name == "cuda" { "GPU by CUDA" } else { "GPU by wgpu" });
        let what = "`--field confies`, the paper's networks; the default field computes on the CPU";
        if !k.compiled_in {
            let build = format!("`cargo build --release --features risorius-trainer/{name}`");
            return Finding::ok(name, title, "not in this build").lacking(State::Optional, what, build);
        }
        if k.present.is_empty() {
            return Finding::ok(name, title, "in this build, none here").lacking(State::Optional, what, k.note);
        }
        Finding::ok(name, title, k.present.join(", "))
    };
    kinds.map(of).collect()
}

fn gigabytes(bytes: f64) -> String {
    format!("{:.1} GB", bytes * 1e-9)
}
