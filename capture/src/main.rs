//! The `capture` command.

fn main() -> std::process::ExitCode {
    risorius_console::run(risorius_capture::cli::run)
}
