//! The `dataset` command: options in, documents out.

mod build;
mod corpus;
mod exchange;
mod look;

use clap::{Parser, Subcommand};
use risorius_console::{Common, CommonArgs, Console, Failure};

/// Tracked takes to a balanced, packaged dataset.
#[derive(Debug, Parser)]
#[command(
    name = "dataset",
    version,
    about,
    after_help = "Example:\n  dataset build takes/ada --balance --frames 750 --scale 4 --out datasets/ada"
)]
pub struct Args {
    #[command(flatten)]
    common: CommonArgs,
    #[command(subcommand)]
    command: Command,
}

impl Common for Args {
    fn common(&self) -> &CommonArgs {
        &self.common
    }
}

#[derive(Debug, Subcommand)]
enum Command {
    Build(build::Args),
    Stats(look::StatsArgs),
    Verify(look::VerifyArgs),
    Export(exchange::ExportArgs),
    Import(exchange::ImportArgs),
    Redact(exchange::RedactArgs),
    Collect(corpus::CollectArgs),
}

/// Runs the command that was asked for.
pub fn run(args: &Args, console: &Console) -> Result<(), Failure> {
    match &args.command {
        Command::Build(args) => build::run(args, console),
        Command::Stats(args) => look::stats(args, console),
        Command::Verify(args) => look::verify(args, console),
        Command::Export(args) => exchange::export(args, console),
        Command::Import(args) => exchange::import(args, console),
        Command::Redact(args) => exchange::redact(args, console),
        Command::Collect(args) => corpus::collect(args, console),
    }
}
