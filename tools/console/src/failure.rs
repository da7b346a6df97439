//! Why a command failed: a message, a hint and an exit status.

use std::error::Error;

use risorius_formats::Hint;
use serde_json::json;

/// Exit status for input that cannot be processed.
const INPUT: u8 = 1;
/// Exit status for wrong usage and for bugs.
const USAGE: u8 = 2;

/// Why a command failed: a message, a hint and an exit status.
///
/// Every error that implements [`Hint`] turns into one through `?`, with exit status 1.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Failure {
    message: String,
    hint: Option<String>,
    status: u8,
    of_installation: bool,
}

impl Failure {
    fn new(message: impl Into<String>, status: u8) -> Self {
        Self { message: message.into(), hint: None, status, of_installation: false }
    }

    /// The input cannot be processed: exit status 1.
    pub fn input(message: impl Into<String>) -> Self {
        Self::new(message, INPUT)
    }

    /// The command was asked for something that makes no sense: exit status 2.
    pub fn usage(message: impl Into<String>) -> Self {
        Self::new(message, USAGE)
    }

    /// The program is at fault: exit status 2.
    pub fn bug(message: impl Into<String>) -> Self {
        Self::new(message, USAGE)
    }

    /// Not the input is at fault but what the program needs beside it, such as a missing network: every other input would
    /// fail in the same way. The document of `--json` says so, for what runs many inputs.
    #[must_use]
    pub fn of_installation(self) -> Self {
        Self { of_installation: true, ..self }
    }

    /// The user stopped the work; `left` says what there is now, such as `nothing was written`. Exit status 1.
    pub fn interrupted(left: impl AsRef<str>) -> Self {
        Self::new(format!("stopped by Ctrl-C: {}", left.as_ref()), INPUT)
    }

    /// Adds or replaces the advice: one sentence without a final full stop.
    #[must_use]
    pub fn with_hint(mut self, hint: impl Into<String>) -> Self {
        self.hint = Some(hint.into());
        self
    }

    /// What went wrong.
    pub fn message(&self) -> &str {
        &self.message
    }

    /// What the user can do about it.
    pub fn hint(&self) -> Option<&str> {
        self.hint.as_deref()
    }

    /// The exit status of the process.
    pub fn status(&self) -> u8 {
        self.status
    }

    /// The document that stands on stdout in place of the result.
    pub(crate) fn to_json(&self) -> serde_json::Value {
        let Self { message, hint, status, of_installation } = self;
        let mut error = json!({ "message": message, "hint": hint, "exit_status": status });
        if *of_installation {
            error["of_installation"] = true.into();
        }
        json!({ "error": error })
    }
}

impl<E: Error + Hint + Send + Sync + 'static> From<E> for Failure {
    fn from(error: E) -> Self {
        let mut message = error.to_string();
        let mut source = error.source();
        while let Some(cause) = source {
            let text = cause.to_string();
            // Many errors already quote their cause.
            if !message.contains(&text) {
                message = format!("{message}: {text}");
            }
            source = cause.source();
        }
        Self { message, hint: error.hint().map(std::borrow::Cow::into_owned), status: INPUT, of_installation: false }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_keeps_its_place_and_hint() {
        let error = risorius_formats::FormatError::syntax("expected a number, found `x`")
            .in_file("a.csv")
            .at_line(3)
            .with_hint("fix it");
        let failure = Failure::from(error);
        assert_eq!(failure.message(), "a.csv:3: expected a number, found `x`");
        assert_eq!(failure.hint(), Some("fix it"));
        assert_eq!(failure.status(), 1);
    }

    #[test]
    fn usage_and_bugs_exit_with_2() {
        assert_eq!(Failure::usage("no").status(), 2);
        assert_eq!(Failure::bug("no").status(), 2);
        assert_eq!(Failure::interrupted("nothing was written").message(), "stopped by Ctrl-C: nothing was written");
    }
}
