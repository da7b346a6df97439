//! `capture devices`.

use std::path::Path;

use clap::Args;
use risorius_console::Console;
use serde::Serialize;

use crate::devices::{Device, SYSFS, devices};

/// Options of `capture devices`.
#[derive(Args, Debug)]
#[command(
    after_help = "Example:\n  capture devices --json\n\nRecording from a camera is not built yet; import a video file with `capture record --input`."
)]
pub(super) struct DevicesArgs {}

#[derive(Serialize)]
struct Document<'a> {
    devices: &'a [Device],
}

pub(super) fn run(console: &Console) {
    let found = devices(Path::new(SYSFS));
    let mut lines: Vec<String> = found.iter().map(|d| format!("{}  {}", d.id.display(), d.name)).collect();
    if lines.is_empty() {
        lines.push("no cameras found".to_owned());
    }
    console.finish(&Document { devices: &found }, &lines.join("\n"));
}
