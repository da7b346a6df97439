//! `bench-confies`: the paper's networks against each other and against the Gaussian field.

mod against;
mod rows;
mod table2;

use std::path::Path;

use clap::{Parser, Subcommand};
use risorius_console::{Common, CommonArgs, Console, Failure};
use risorius_formats::FormatError;

/// The paper's networks: its Table 2 again on any dataset, and beside the Gaussian field
#[derive(Debug, Parser)]
#[command(name = "bench-confies", version, about)]
pub struct Cli {
    #[command(flatten)]
    common: CommonArgs,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Fit every model of the paper's Table 2 alike and score it on held-out frames, with codes between neighbours
    Table2(table2::Args),
    /// Compare the paper's networks with the Gaussian field at equal time and at equal error
    AgainstSplat(against::Args),
}

impl Common for Cli {
    fn common(&self) -> &CommonArgs {
        &self.common
    }
}

/// Measures and writes everything.
pub fn run(cli: &Cli, console: &Console) -> Result<(), Failure> {
    match &cli.command {
        Command::Table2(args) => table2::run(args, console),
        Command::AgainstSplat(args) => against::run(args, console),
    }
}

fn create(work: &Path) -> Result<(), Failure> {
    Ok(std::fs::create_dir_all(work).map_err(|e| FormatError::io(work, "create", &e))?)
}

fn text(path: &Path) -> String {
    path.to_string_lossy().into_owned()
}
