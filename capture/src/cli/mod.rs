//! The `capture` command line: glue between options, the library and the printer.

mod check;
mod devices;
mod live;
mod record;
mod recover;

use clap::{Parser, Subcommand};
use risorius_console::{Common, CommonArgs, Console, Failure};

/// Cameras and video files to takes.
#[derive(Debug, Parser)]
#[command(name = "capture", version, about, propagate_version = true)]
#[command(after_help = "Example:\n  capture record --input face.mp4 --out takes/face && capture check takes/face")]
pub struct Cli {
    #[command(flatten)]
    common: CommonArgs,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// List the cameras with their modes, frame rates and controls.
    Devices(devices::DevicesArgs),
    /// Make a take from a camera, a video file or a folder of images.
    Record(Box<record::RecordArgs>),
    /// Say what a take is worth: times, sharpness, exposure.
    Check(check::CheckArgs),
    /// Make a take of a recording that was cut off.
    Recover(recover::RecoverArgs),
}

impl Common for Cli {
    fn common(&self) -> &CommonArgs {
        &self.common
    }
}

/// Runs the command.
pub fn run(cli: &Cli, console: &Console) -> Result<(), Failure> {
    match &cli.command {
        Command::Devices(args) => {
            devices::run(args, console);
            Ok(())
        }
        Command::Record(args) => record::run(args, console),
        Command::Check(args) => check::run(args, console),
        Command::Recover(args) => recover::run(args, console),
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_command_line_is_consistent() {
        <super::Cli as clap::CommandFactory>::command().debug_assert();
    }
}
