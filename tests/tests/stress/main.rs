//! The numerical stress suite: poison values through every public numeric entry, mutated and hostile files through every
//! parser, extreme scenes through the real binaries, determinism, and (only when asked for) long runs.
//!
//! The quick part is ordinary tests. The long part: `cargo nextest run --release --workspace -E 'binary(stress)'
//! --run-ignored all`; `RISORIUS_STRESS=20` makes the fuzzing twenty times longer, `RISORIUS_STEPS` sets the long run's
//! length. What it found and what it covers: `docs/reliability.md`.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]
#![allow(clippy::print_stderr, reason = "what was tried is worth telling, and a test that is skipped has to say so")]

mod determinism;
mod extreme_scenes;
mod fuzz_files;
mod fuzz_folders;
mod fuzz_found;
mod hazards;
mod long_run;
mod mutate;
mod packages;
mod poison_dataset;
mod poison_formats;
mod poison_tracker;
mod poison_trainer;
mod support;

/// Counts what is allocated, so that a small hostile file that asks for much memory is caught.
#[global_allocator]
static MEMORY: peak_alloc::PeakAlloc = peak_alloc::PeakAlloc;
