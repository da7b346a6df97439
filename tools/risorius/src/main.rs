//! The program `risorius`: a video to an avatar by one command, and the four programs in one.
//!
//! The stages run in this process through the command lines of their crates, so that one file is the whole installation,
//! Ctrl-C and `kill` reach everything at once, and progress comes as numbers.

mod avatar;
mod cli;
mod completions;
mod doctor;
mod models;
mod words;

use std::process::ExitCode;

use clap::CommandFactory as _;

// As in `trainer`: a third of the CPU time of a fit went into page faults with the system's allocator.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    risorius_console::run_as(words::with_our_examples(cli::Cli::command()), cli::run)
}
