//! `synth`: a capture with known answers.

fn main() -> std::process::ExitCode {
    risorius_console::run(risorius_synth::cli::run)
}
