//! The commands of the four programs, run in this process.

use std::ffi::OsString;
use std::path::Path;

use clap::Parser as _;
use risorius_console::{Console, Failure};

/// A command of one of the four programs, such as `tracker run TAKE`.
#[derive(Clone, Debug)]
pub(super) struct ProgramCommand(Vec<OsString>);

impl ProgramCommand {
    pub(super) fn new(program: &str, command: &str) -> Self {
        Self(vec![program.into(), command.into()])
    }

    /// Adds words as they are.
    pub(super) fn words<'a>(mut self, words: impl IntoIterator<Item = &'a str>) -> Self {
        self.0.extend(words.into_iter().map(OsString::from));
        self
    }

    /// Adds a path; one that begins with a dash is no option.
    pub(super) fn path(mut self, path: &Path) -> Self {
        let is_like_option = path.to_string_lossy().starts_with('-');
        self.0.push(if is_like_option { Path::new(".").join(path).into() } else { path.into() });
        self
    }

    /// Adds an option with a path.
    pub(super) fn option(self, name: &str, path: &Path) -> Self {
        self.words([name]).path(path)
    }

    /// Adds an option with a number, if there is one.
    pub(super) fn number(self, name: &str, value: Option<u32>) -> Self {
        match value {
            Some(value) => self.words([name, &value.to_string()]),
            None => self,
        }
    }

    /// Runs it; `console` hears what it says.
    pub(super) fn run(&self, console: &Console) -> Result<(), Failure> {
        let bug = |e: clap::Error| Failure::bug(format!("a stage was called with wrong options: {e}"));
        match self.0[0].to_str() {
            Some("capture") => {
                risorius_capture::cli::run(&risorius_capture::cli::Cli::try_parse_from(&self.0).map_err(bug)?, console)
            }
            Some("tracker") => {
                risorius_tracker::cli::run(&risorius_tracker::cli::Cli::try_parse_from(&self.0).map_err(bug)?, console)
            }
            Some("dataset") => {
                risorius_dataset::cli::run(&risorius_dataset::cli::Args::try_parse_from(&self.0).map_err(bug)?, console)
            }
            _ => {
                risorius_trainer::cli::run(&risorius_trainer::cli::Cli::try_parse_from(&self.0).map_err(bug)?, console)
            }
        }
    }
}
