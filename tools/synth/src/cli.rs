//! The command line of `synth`.

use std::fmt::Write;
use std::path::PathBuf;

use clap::{Parser, ValueEnum};
use risorius_console::{Common, CommonArgs, Console, Failure};

use crate::generate::generate;
use crate::settings::Settings;

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Switch {
    On,
    Off,
}

/// Makes a capture with known answers: video, OpenFace table, cameras, masks and held-out stills.
#[derive(Parser, Debug)]
#[command(name = "synth", version, after_help = "Example: synth --out captures/demo --frames 360 --driver")]
pub struct Args {
    /// The folder to make; an older one there is replaced.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Frames of the video [default: 360].
    #[arg(long, value_name = "N")]
    frames: Option<u32>,
    /// Frames per second [default: 60].
    #[arg(long, value_name = "FPS")]
    fps: Option<f64>,
    /// Size of the pictures [default: 270x480].
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    size: Option<(u32, u32)>,
    /// Drives everything that is random [default: 1].
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Also make a second person and the truth of the transfer.
    #[arg(long)]
    driver: bool,
    /// Leave the camera where it is.
    #[arg(long)]
    static_camera: bool,
    /// Noise in the tables [default: on].
    #[arg(long, value_name = "on|off")]
    noise: Option<Switch>,
    #[command(flatten)]
    common: CommonArgs,
}

impl Common for Args {
    fn common(&self) -> &CommonArgs {
        &self.common
    }
}

fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let parsed = text.split_once(['x', 'X']).and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    parsed.ok_or_else(|| "write it like 270x480".to_owned())
}

impl Args {
    /// Command line over `risorius.toml` over defaults.
    fn settings(&self, mut settings: Settings) -> Settings {
        settings.frames = self.frames.unwrap_or(settings.frames);
        settings.fps = self.fps.unwrap_or(settings.fps);
        (settings.width, settings.height) = self.size.unwrap_or((settings.width, settings.height));
        settings.seed = self.seed.unwrap_or(settings.seed);
        settings.driver |= self.driver;
        settings.static_camera |= self.static_camera;
        settings.noise = self.noise.map_or(settings.noise, |switch| matches!(switch, Switch::On));
        settings
    }
}

/// Runs the command.
pub fn run(args: &Args, console: &Console) -> Result<(), Failure> {
    let settings = args.settings(risorius_console::settings("synth")?);
    let summary = generate(&settings, &args.out, console)?;
    let mut human = format!(
        "{}: {} frames, {} held-out stills, {} label images, {} points",
        args.out.display(),
        summary.frames,
        summary.stills,
        summary.masks,
        summary.points
    );
    if summary.driver_frames > 0 {
        let _ =
            write!(human, ", a driver of {} frames, {} transfer stills", summary.driver_frames, summary.transfer_views);
    }
    console.finish(&summary, &human);
    Ok(())
}
