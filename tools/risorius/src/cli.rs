//! The command line of `risorius`.

use clap::{Parser, Subcommand};
use risorius_console::{Common, CommonArgs, Console, Failure};

/// The command line.
#[derive(Debug, Parser)]
#[command(name = "risorius", version, about = ABOUT, propagate_version = true, max_term_width = 110, after_help = EXAMPLES)]
pub(crate) struct Cli {
    #[command(flatten)]
    common: CommonArgs,
    #[command(subcommand)]
    command: Command,
}

const ABOUT: &str = "A video of a face becomes an avatar that is steered by action units (AUs)";
const EXAMPLES: &str = "Example:
  risorius models                              once: the networks that find the face
  risorius avatar face.mp4 --out ada           the whole way, in about two minutes
  risorius trainer view ada/run                turn and steer it in a browser";

impl Common for Cli {
    fn common(&self) -> &CommonArgs {
        &self.common
    }
}

#[derive(Debug, Subcommand)]
enum Command {
    Avatar(crate::avatar::AvatarArgs),
    Doctor(crate::doctor::DoctorArgs),
    Models(crate::models::ModelsArgs),
    /// Cameras and video files to takes
    Capture(Box<risorius_capture::cli::Cli>),
    /// Landmarks, action units, head and camera poses of a take
    Tracker(Box<risorius_tracker::cli::Cli>),
    /// Tracked takes to a balanced, packaged dataset
    Dataset(Box<risorius_dataset::cli::Args>),
    /// A dataset becomes an avatar that renders any expression from any view
    Trainer(Box<risorius_trainer::cli::Cli>),
    Completions(crate::completions::CompletionsArgs),
    ManPages(crate::completions::ManPagesArgs),
}

/// Runs what was typed.
pub(crate) fn run(cli: &Cli, console: &Console) -> Result<(), Failure> {
    let outcome = match &cli.command {
        Command::Avatar(args) => crate::avatar::run(args, &cli.common, console),
        Command::Doctor(args) => crate::doctor::run(args, console),
        Command::Models(args) => crate::models::run(args, console),
        Command::Capture(args) => risorius_capture::cli::run(args, console),
        Command::Tracker(args) => risorius_tracker::cli::run(args, console),
        Command::Dataset(args) => risorius_dataset::cli::run(args, console),
        Command::Trainer(args) => risorius_trainer::cli::run(args, console),
        Command::Completions(args) => {
            crate::completions::completions(args, console);
            Ok(())
        }
        Command::ManPages(args) => crate::completions::man_pages(args, console),
    };
    outcome.map_err(crate::words::of_failure)
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    #[test]
    fn the_command_line_is_consistent() {
        crate::words::with_our_examples(super::Cli::command()).debug_assert();
    }
}
