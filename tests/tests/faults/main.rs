//! What no test of right input shows: processes killed at any moment, full and read-only disks, files that change or
//! vanish while they are read, two processes at once, clocks that jump, COLMAP and ONNX Runtime missing, crashing or
//! hanging, and a viewer that is asked a thousand things.
//!
//! A short round of each runs with all other tests. More rounds, and an hour of the viewer:
//!
//! ```text
//! RISORIUS_FAULTS=20 cargo nextest run --release --workspace -E 'binary(faults)' --no-capture
//! RISORIUS_SOAK_SECS=3600 cargo nextest run --release --workspace -E 'test(a_thousand_requests)' --no-capture
//! ```

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]
#![allow(clippy::print_stderr, reason = "a test that is skipped has to say so")]

mod around;
mod disk;
mod kill;
mod programs;
mod viewer;
mod world;
