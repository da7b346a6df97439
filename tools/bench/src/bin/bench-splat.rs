//! Run time against error of the Gaussian field: fits by their time, pictures, edits, and every skip on and off.

use std::process::ExitCode;

fn main() -> ExitCode {
    risorius_console::run(risorius_bench::splat::run)
}
