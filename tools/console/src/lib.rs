//! What the four binaries share at the command line: printing, progress, warnings, errors and exit codes.
//!
//! * stdout carries data, stderr carries talk; with `--json` stdout is exactly one JSON document;
//! * exit 0: done; 1: the input cannot be processed, or the user stopped the work; 2: wrong usage, or a bug;
//! * a result is made by one process at a time, and knows what it was made of ([`Stage`]);
//! * an error is `error: …`, a blank line, `hint: …`;
//! * the first Ctrl-C asks the libraries to leave whole files and return, the second one ends the process.
//!
//! A binary's `main` is one line: `risorius_console::run(cli::run)`.

mod args;
mod failure;
mod printer;
mod progress;
mod run;
mod settings;
mod stage;

pub use args::{Common, CommonArgs};
pub use failure::Failure;
pub use printer::{Console, Listener};
pub use progress::seconds;
pub use run::{run, run_as};
pub use settings::{SETTINGS_FILE, settings, settings_from};
pub use stage::{AgainArgs, Inputs, Running, Stage, hold};
