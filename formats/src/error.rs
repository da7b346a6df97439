//! What can be wrong with a file, and where: path, line and column first, then what was expected and found.

use std::borrow::Cow;
use std::fmt;
use std::path::{Path, PathBuf};

/// An error that may know what the user can do about it.
///
/// The console prints the hint under the message, after a blank line.
pub trait Hint {
    /// One sentence of advice, without a final full stop.
    fn hint(&self) -> Option<Cow<'_, str>> {
        None
    }
}

/// Whose fault it is and of which sort.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum ErrorKind {
    /// The operating system refused: not found, no permission, disk full.
    Io,
    /// The bytes do not follow the format.
    Syntax,
    /// A file, column or field that has to be there is not.
    Missing,
    /// Two statements contradict each other.
    Inconsistent,
    /// Legal, but not something this program handles.
    Unsupported,
    /// Larger than any sane file of its kind.
    Limits,
    /// There is nothing in it.
    Empty,
}

/// A problem in a file or in the bytes of one.
#[derive(Debug)]
pub struct FormatError {
    kind: ErrorKind,
    path: Option<PathBuf>,
    line: Option<u64>,
    column: Option<String>,
    message: String,
    hint: Option<String>,
}

impl FormatError {
    /// An error of `kind` with a message: lower-case start, no final full stop, values in backticks.
    pub fn new(kind: ErrorKind, message: impl Into<String>) -> Self {
        Self { kind, path: None, line: None, column: None, message: message.into(), hint: None }
    }

    /// An operating-system error at `path`; `doing` is the verb, such as `read` or `create`.
    pub fn io(path: impl AsRef<Path>, doing: &str, source: &std::io::Error) -> Self {
        let hint = match source.kind() {
            std::io::ErrorKind::NotFound => {
                Some("check the path; relative paths start at the current folder".to_owned())
            }
            std::io::ErrorKind::StorageFull => Some("free some disk space and run the command again".to_owned()),
            std::io::ErrorKind::PermissionDenied => Some("the file or folder belongs to another user".to_owned()),
            _ => None,
        };
        let message = match source.kind() {
            std::io::ErrorKind::NotFound => "does not exist".to_owned(),
            std::io::ErrorKind::StorageFull => format!("cannot {doing}: no space left on the disk"),
            _ => format!("cannot {doing}: {source}"),
        };
        Self { kind: ErrorKind::Io, path: Some(path.as_ref().to_owned()), line: None, column: None, message, hint }
    }

    /// A syntax error without a place yet.
    pub fn syntax(message: impl Into<String>) -> Self {
        Self::new(ErrorKind::Syntax, message)
    }

    /// Adds the 1-based line (or record, or byte offset for binary files).
    #[must_use]
    pub fn at_line(mut self, line: u64) -> Self {
        self.line.get_or_insert(line);
        self
    }

    /// Adds the column's name or number.
    #[must_use]
    pub fn in_column(mut self, column: impl Into<String>) -> Self {
        self.column.get_or_insert_with(|| column.into());
        self
    }

    /// Adds the file's path unless there is one.
    #[must_use]
    pub fn in_file(mut self, path: impl AsRef<Path>) -> Self {
        self.path.get_or_insert_with(|| path.as_ref().to_owned());
        self
    }

    /// Adds or replaces the hint.
    #[must_use]
    pub fn with_hint(mut self, hint: impl Into<String>) -> Self {
        self.hint = Some(hint.into());
        self
    }

    /// Of which sort the error is.
    pub fn kind(&self) -> ErrorKind {
        self.kind
    }

    /// The file, where known.
    pub fn path(&self) -> Option<&Path> {
        self.path.as_deref()
    }

    /// The 1-based line, where known.
    pub fn line(&self) -> Option<u64> {
        self.line
    }

    /// The column's name, where known.
    pub fn column(&self) -> Option<&str> {
        self.column.as_deref()
    }
}

impl fmt::Display for FormatError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(path) = &self.path {
            write!(f, "{}", path.display())?;
            if let Some(line) = self.line {
                write!(f, ":{line}")?;
            }
            write!(f, ": ")?;
        } else if let Some(line) = self.line {
            write!(f, "line {line}: ")?;
        }
        if let Some(column) = &self.column {
            write!(f, "column `{column}`: ")?;
        }
        f.write_str(&self.message)
    }
}

impl std::error::Error for FormatError {}

impl Hint for FormatError {
    fn hint(&self) -> Option<Cow<'_, str>> {
        self.hint.as_deref().map(Cow::Borrowed)
    }
}
