//! The binary `trainer`.

use std::process::ExitCode;

// A third of the CPU time of a fit went into page faults of fresh buffers with the system's allocator.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    risorius_console::run(risorius_trainer::cli::run)
}
