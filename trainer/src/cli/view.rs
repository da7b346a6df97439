//! `trainer view`.

use std::path::PathBuf;

use risorius_console::{Console, Failure};
use serde::Serialize;

use super::{DeviceArgs, need};
use crate::avatar::Avatar;
use crate::jobs::transfer::Range;
use crate::view::{ViewSettings, Viewer};

/// Options of `trainer view`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  trainer view runs/ada\n  trainer view runs/ada --curves takes/bob/track/openface.csv --port 8080\n  tracker live | trainer view runs/ada --live -\n\nThe page is served to this machine only. To see it from another one, forward the port: ssh -L 8080:127.0.0.1:8080 HOST"
)]
pub(super) struct ViewArgs {
    /// The run's folder
    run: PathBuf,
    /// The port [default: a free one]
    #[arg(long, value_name = "N")]
    port: Option<u16>,
    /// AU curves for the page's player: an OpenFace, Live Link Face or plain table
    #[arg(long, value_name = "FILE.csv")]
    curves: Option<PathBuf>,
    /// Rows of such a table that come while the page is open, as `tracker live` writes them; `-` is standard input
    #[arg(long, value_name = "FILE|-")]
    live: Option<PathBuf>,
    /// Whose range is the live face's: the driver's strongest so far is the avatar's strongest, or intensities as they
    /// are [default: avatar]
    #[arg(long, value_name = "WHOSE", requires = "live")]
    range: Option<Range>,
    #[command(flatten)]
    device: DeviceArgs,
}

#[derive(Serialize)]
struct Served {
    url: String,
    pictures: u64,
}

pub(super) fn run(args: &ViewArgs, console: &Console) -> Result<(), Failure> {
    need(&args.run, "a run made by `trainer fit`")?;
    let avatar = Avatar::open(&args.run, &args.device.device()?)?;
    let settings = ViewSettings {
        run: args.run.clone(),
        port: args.port.unwrap_or(0),
        curves: args.curves.clone(),
        live: args.live.clone(),
        live_range: args.range.unwrap_or(Range::Avatar),
    };
    let viewer = Viewer::bind(&avatar, &settings, console)?;
    let url = viewer.url();
    // Also with `-q`: without the address the page cannot be opened.
    console.address(&url);
    let pictures = viewer.serve(console)?;
    console.finish(&Served { url, pictures }, &format!("{pictures} pictures shown"));
    Ok(())
}
