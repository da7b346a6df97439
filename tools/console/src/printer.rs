//! The one place that prints.

use std::collections::BTreeMap;
use std::io::{self, IsTerminal, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use risorius_formats::{Reporter, Warning};
use serde::Serialize;

use crate::progress::Progress;
use crate::{CommonArgs, Failure};

/// How many warnings of one kind are shown in full.
const SHOWN_PER_KIND: u64 = 3;

/// Set by the first Ctrl-C.
pub(crate) static CANCELLED: AtomicBool = AtomicBool::new(false);

/// Hears what a command says, in place of the terminal: for a program that runs commands as stages of its own work.
pub trait Listener: Reporter + Send + std::fmt::Debug {
    /// The result of the command: its document and its text for people.
    fn result(&self, document: serde_json::Value, text: &str);
}

/// The printer: data to stdout, talk to stderr; the [`Reporter`] of the binaries.
#[derive(Debug)]
pub struct Console {
    listener: Option<Arc<dyn Listener>>,
    json: bool,
    quiet: u8,
    verbose: u8,
    colour: bool,
    progress: Progress,
    warnings: Mutex<BTreeMap<&'static str, u64>>,
    stdout_failure: Mutex<Option<Failure>>,
    /// Whether the result is on stdout: there is only one document.
    finished: AtomicBool,
}

impl Console {
    /// A printer with the options of a command line.
    pub fn new(args: &CommonArgs) -> Self {
        let terminal = io::stderr().is_terminal();
        let hidden = args.no_progress || args.quiet > 0;
        Self {
            listener: None,
            json: args.json,
            quiet: args.quiet,
            verbose: args.verbose,
            colour: terminal && colour_is_welcome(),
            progress: Progress::new(hidden, terminal),
            warnings: Mutex::default(),
            stdout_failure: Mutex::default(),
            finished: AtomicBool::new(false),
        }
    }

    /// A printer that prints nothing: all that is said goes to `listener`.
    pub fn heard_by(listener: Arc<dyn Listener>) -> Self {
        let silent = CommonArgs { quiet: 2, no_progress: true, ..CommonArgs::default() };
        Self { listener: Some(listener), ..Self::new(&silent) }
    }

    /// Whether stdout has to be one JSON document.
    pub fn is_json(&self) -> bool {
        self.json
    }

    /// Writes the result to stdout: `document` as JSON with `--json`, else `human` with a final line break.
    ///
    /// A command may still fail after it, as one does that lists problems: then this is the document, and none is added.
    pub fn finish<T: Serialize>(&self, document: &T, human: &str) {
        self.progress.end();
        if let Some(listener) = &self.listener {
            let document = serde_json::to_value(document).unwrap_or_default();
            return listener.result(document, human.trim_end_matches('\n'));
        }
        let text = if self.json {
            match serde_json::to_string_pretty(document) {
                Ok(text) => text,
                Err(e) => return self.fail_later(Failure::bug(format!("the result cannot be written as JSON: {e}"))),
            }
        } else {
            human.trim_end_matches('\n').to_owned()
        };
        if !text.is_empty() {
            self.write_stdout(&text);
            self.finished.store(true, Ordering::Relaxed);
        }
    }

    /// A line for people on stderr; silent with `-q`.
    pub fn say(&self, text: &str) {
        if let Some(listener) = &self.listener {
            listener.note(text);
        } else if self.quiet == 0 {
            self.progress.print(text);
        }
    }

    /// Where a program that goes on running can be reached: on stderr, whatever was asked for otherwise.
    pub fn address(&self, url: &str) {
        self.progress.print(&format!("open {url}   (Ctrl-C ends it)"));
    }

    /// A line for people on stderr, with `-v` only.
    pub fn verbose(&self, text: &str) {
        if self.verbose > 0 {
            self.progress.print(text);
        }
    }

    /// Prints the failure and its hint; with `--json` also as a document on stdout, unless one stands there.
    pub(crate) fn fail(&self, failure: &Failure) {
        self.progress.end();
        print_failure(failure, self.colour);
        if self.json && !self.finished.load(Ordering::Relaxed) {
            self.write_stdout(&format!("{:#}", failure.to_json()));
        }
    }

    /// Ends the progress and sums up the warnings; gives what went wrong with stdout.
    pub(crate) fn close(&self) -> Option<Failure> {
        self.progress.end();
        let warnings = self.warnings.lock().unwrap_or_else(PoisonError::into_inner);
        if self.quiet < 2 && warnings.values().sum::<u64>() > 1 {
            let list: Vec<String> = warnings.iter().map(|(kind, count)| format!("{kind} ×{count}")).collect();
            let advice = if self.shows_all(&warnings) { "" } else { " (-v shows each one)" };
            self.progress.print(&format!("{} {}{advice}", self.paint("33", "warnings:"), list.join(", ")));
        }
        self.stdout_failure.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    fn shows_all(&self, warnings: &BTreeMap<&'static str, u64>) -> bool {
        self.verbose > 0 || (self.quiet < 2 && warnings.values().all(|&n| n <= SHOWN_PER_KIND))
    }

    fn paint(&self, code: &str, text: &str) -> String {
        paint(self.colour, code, text)
    }

    fn fail_later(&self, failure: Failure) {
        self.stdout_failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(failure);
    }

    fn write_stdout(&self, text: &str) {
        let mut out = io::stdout().lock();
        match writeln!(out, "{text}").and_then(|()| out.flush()) {
            // The reader, such as `head`, has had enough: that is its right.
            Err(e) if e.kind() != io::ErrorKind::BrokenPipe => {
                self.fail_later(Failure::input(format!("cannot write to standard output: {e}")));
            }
            _ => {}
        }
    }
}

impl Reporter for Console {
    fn stage(&self, name: &str, total: Option<u64>) {
        match &self.listener {
            Some(listener) => listener.stage(name, total),
            None => self.progress.begin(name, total),
        }
    }

    fn advance(&self, steps: u64) {
        match &self.listener {
            Some(listener) => listener.advance(steps),
            None => self.progress.advance(steps),
        }
    }

    fn note(&self, text: &str) {
        if let Some(listener) = &self.listener {
            listener.note(text);
        } else if self.quiet == 0 {
            self.progress.note(text, self.verbose > 0);
        }
    }

    fn warn(&self, warning: Warning) {
        if let Some(listener) = &self.listener {
            return listener.warn(warning);
        }
        let mut warnings = self.warnings.lock().unwrap_or_else(PoisonError::into_inner);
        let count = warnings.entry(warning.kind).or_insert(0);
        *count += 1;
        let shown = self.verbose > 0 || (self.quiet < 2 && *count <= SHOWN_PER_KIND);
        drop(warnings);
        if shown {
            self.progress.print(&format!("{} {}", self.paint("33", "warning:"), warning.message));
        }
    }

    fn cancelled(&self) -> bool {
        CANCELLED.load(Ordering::Relaxed)
    }
}

/// `error: …`, a blank line, `hint: …`, on stderr.
pub(crate) fn print_failure(failure: &Failure, colour: bool) {
    let hint = failure.hint().map_or_else(String::new, |hint| format!("\n{} {hint}\n", paint(colour, "36", "hint:")));
    let text = format!("{} {}\n{hint}", paint(colour, "1;31", "error:"), failure.message());
    // Nobody is left to tell when stderr is closed.
    let _ = io::stderr().lock().write_all(text.as_bytes());
}

/// <https://no-color.org>: any value but an empty one.
fn colour_is_welcome() -> bool {
    std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty()) && std::env::var_os("TERM").is_none_or(|v| v != "dumb")
}

fn paint(colour: bool, code: &str, text: &str) -> String {
    if colour { format!("\x1b[{code}m{text}\x1b[0m") } else { text.to_owned() }
}
