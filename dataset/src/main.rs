//! The `dataset` command.

fn main() -> std::process::ExitCode {
    risorius_console::run(risorius_dataset::cli::run)
}
