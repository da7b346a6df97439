//! The fit of the paper's networks on a small scene made in memory.
#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod devices;
mod draws;
mod fits;
mod golden;
mod models;
mod parts;
mod scene;
