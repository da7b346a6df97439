//! The paper's networks: Table 2 again on any dataset, and beside the Gaussian field at equal time and equal error.

use std::process::ExitCode;

fn main() -> ExitCode {
    risorius_console::run(risorius_bench::confies::run)
}
