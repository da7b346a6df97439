//! The binary `tracker`.

fn main() -> std::process::ExitCode {
    risorius_console::run(risorius_tracker::cli::run)
}
