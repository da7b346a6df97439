//! `capture devices`.

use std::path::Path;

use clap::Args;
use risorius_console::Console;
use serde::Serialize;

use crate::devices::{Camera, SYSFS, ask, cameras};
use crate::negotiate::number;
use crate::source::{Control, Mode, Rates, backends};

/// Options of `capture devices`.
#[derive(Args, Debug)]
#[command(after_help = "Examples:\n  capture devices\n  capture devices --device synthetic:1280x720@120 --json")]
pub(super) struct DevicesArgs {
    /// Ask only this camera, which need not be in the system's list.
    #[arg(long, value_name = "ID")]
    device: Option<String>,
}

#[derive(Serialize)]
struct Document<'a> {
    devices: &'a [Camera],
    backends: Vec<&'static str>,
}

pub(super) fn run(args: &DevicesArgs, console: &Console) {
    let found = match &args.device {
        Some(device) => vec![ask(device.clone(), String::new())],
        None => cameras(Path::new(SYSFS)),
    };
    let mut lines: Vec<String> = found.iter().flat_map(describe).collect();
    if lines.is_empty() {
        lines.push("no cameras found".to_owned());
        lines.push("`--device synthetic:1280x720@120` stands in for one".to_owned());
    }
    console.finish(&Document { devices: &found, backends: backends() }, &lines.join("\n"));
}

fn describe(camera: &Camera) -> Vec<String> {
    let mut lines = vec![format!("{}  {}", camera.id, camera.name)];
    lines.extend(camera.error.as_ref().map(|e| format!("  cannot be asked: {e}")));
    lines.extend(camera.modes.iter().map(|m| format!("  {}", mode(m))));
    lines.extend(camera.controls.iter().map(|c| format!("  {}", control(c))));
    lines
}

fn mode(mode: &Mode) -> String {
    let rates = match &mode.rates {
        Rates::Exactly(list) => list.iter().map(|r| number(r.fps())).collect::<Vec<_>>().join(", "),
        Rates::Between { lowest, highest } => format!("{} to {}", number(*lowest), number(*highest)),
        Rates::Unknown => "unknown".to_owned(),
    };
    format!("{:<5}  {:>4}x{:<4}  {rates} frames/s", mode.format.name(), mode.width, mode.height)
}

fn control(c: &Control) -> String {
    let set = if c.settable { "" } else { ", cannot be set now" };
    format!("{} = {} ({} to {}, usually {}{set})", c.name, c.value, c.lowest, c.highest, c.default)
}
