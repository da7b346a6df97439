//! The options that every command has.

/// The options that every command has; flatten it into the parser and implement [`Common`].
#[derive(clap::Args, Clone, Debug, Default)]
pub struct CommonArgs {
    /// Write one JSON document to standard output, and nothing else there.
    #[arg(long, global = true, help_heading = "Output")]
    pub json: bool,
    /// Say less: no progress and notes; twice: no warnings either.
    #[arg(short, long, global = true, action = clap::ArgAction::Count, conflicts_with = "verbose", help_heading = "Output")]
    pub quiet: u8,
    /// Say more, and show every warning.
    #[arg(short, long, global = true, action = clap::ArgAction::Count, help_heading = "Output")]
    pub verbose: u8,
    /// Show no progress.
    #[arg(long, global = true, help_heading = "Output")]
    pub no_progress: bool,
}

/// A command line that carries [`CommonArgs`].
pub trait Common {
    /// The options that every command has.
    fn common(&self) -> &CommonArgs;
}
