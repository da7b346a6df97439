//! `risorius completions` and `risorius man-pages`, for shells and packages.

use std::path::PathBuf;

use clap::{Args, CommandFactory as _};
use clap_complete::Shell;
use risorius_console::{Console, Failure};
use risorius_formats::FormatError;
use serde_json::json;

/// Write a script that completes commands and options in a shell
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  risorius completions bash > ~/.local/share/bash-completion/completions/risorius
  risorius completions zsh > ~/.zfunc/_risorius
  risorius completions fish > ~/.config/fish/completions/risorius.fish")]
pub(crate) struct CompletionsArgs {
    /// The shell
    #[arg(value_enum)]
    shell: Shell,
}

/// Write a man page for each command into a folder
#[derive(Args, Debug)]
#[command(after_help = "Example:\n  risorius man-pages man1 && man ./man1/risorius-avatar.1")]
pub(crate) struct ManPagesArgs {
    /// The folder; it is made where it is not there
    #[arg(value_name = "DIR")]
    out: PathBuf,
}

fn command() -> clap::Command {
    crate::words::with_our_examples(crate::cli::Cli::command())
}

pub(crate) fn completions(args: &CompletionsArgs, console: &Console) {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut command(), "risorius", &mut script);
    let text = String::from_utf8_lossy(&script).into_owned();
    console.finish(&json!({ "shell": args.shell.to_string(), "script": text }), &text);
}

pub(crate) fn man_pages(args: &ManPagesArgs, console: &Console) -> Result<(), Failure> {
    let fail = |e: &std::io::Error| FormatError::io(&args.out, "write", e);
    std::fs::create_dir_all(&args.out).map_err(|e| fail(&e))?;
    clap_mangen::generate_to(command(), &args.out).map_err(|e| fail(&e))?;
    console.finish(&json!({ "folder": args.out }), &format!("{}: written", args.out.display()));
    Ok(())
}
