//! What can be wrong with a file, and where: path, line and column first, then what was expected and found.

use std::borrow::Cow;
use std::path::{Path, PathBuf};
use std::{fmt, io};

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
    ///
    /// A path that is missing or in the way means something else where a file is to be read than where one is to be
    /// made: verbs other than `read`, `open …` and `list …` are about outputs.
    pub fn io(path: impl AsRef<Path>, doing: &str, source: &io::Error) -> Self {
        let is_input = ["read", "open", "list", "copy"].iter().any(|verb| doing.starts_with(verb));
        let (message, hint) = if is_input { unreadable(doing, source) } else { unwritable(doing, source) };
        let hint = hint.map(str::to_owned);
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

    /// Replaces the line.
    #[must_use]
    pub(crate) fn moved_to_line(mut self, line: u64) -> Self {
        self.line = Some(line);
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

    /// Adds the hint unless there is one.
    #[must_use]
    pub fn or_hint(mut self, hint: impl Into<String>) -> Self {
        self.hint.get_or_insert_with(|| hint.into());
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

/// What is said about an input that the system does not give.
fn unreadable(doing: &str, source: &io::Error) -> (String, Option<&'static str>) {
    let (message, hint) = match source.kind() {
        io::ErrorKind::NotFound => ("does not exist", "check the path; relative paths start at the current folder"),
        io::ErrorKind::IsADirectory => ("is a folder, not a file", "name the file itself"),
        io::ErrorKind::NotADirectory => ("does not exist: a part of the path is a file", "check the path"),
        io::ErrorKind::PermissionDenied => ("may not be read", "the file or folder belongs to another user"),
        // What `read_to_string` says about bytes that are no UTF-8.
        io::ErrorKind::InvalidData => ("is not a text file", "it is damaged, of another kind, or not saved as UTF-8"),
        _ => return (format!("cannot {doing}: {source}"), None),
    };
    (message.to_owned(), Some(hint))
}

/// What is said about an output that the system does not take.
fn unwritable(doing: &str, source: &io::Error) -> (String, Option<&'static str>) {
    let (reason, hint) = match source.kind() {
        io::ErrorKind::NotFound => ("nothing can be made there", "choose a folder that you may write to"),
        io::ErrorKind::AlreadyExists => ("a file is in its place", "choose another path, or remove the file"),
        io::ErrorKind::NotADirectory => ("a part of the path is a file", "choose another path"),
        io::ErrorKind::IsADirectory => ("a folder is in its place", "choose another path, or remove the folder"),
        io::ErrorKind::PermissionDenied | io::ErrorKind::ReadOnlyFilesystem => {
            ("no permission", "choose a folder that you may write to")
        }
        io::ErrorKind::DirectoryNotEmpty => {
            ("something was put there meanwhile", "another command may be at work on the same; look at what is there")
        }
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
            ("no space left on the disk", "free some disk space and run the command again")
        }
        _ => return (format!("cannot {doing}: {source}"), None),
    };
    (format!("cannot {doing}: {reason}"), Some(hint))
}

/// Some bytes of a file for a message, in backticks and short; what is no clean text is described instead.
pub(crate) fn shown(bytes: &[u8]) -> String {
    const LONGEST: usize = 40;
    match std::str::from_utf8(bytes) {
        Ok(text) if text.chars().any(char::is_control) => "bytes that are not text".to_owned(),
        Ok(text) if text.chars().count() > LONGEST => {
            format!("`{}…`", text.chars().take(LONGEST).collect::<String>())
        }
        Ok(text) => format!("`{text}`"),
        Err(_) => "bytes that are not text".to_owned(),
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
            write!(f, "column `{}`: ", printable(column))?;
        }
        f.write_str(&printable(&self.message))
    }
}

/// A text without the control characters that a file may have brought into it: they could move a terminal's cursor.
fn printable(text: &str) -> Cow<'_, str> {
    if !text.contains(char::is_control) {
        return Cow::Borrowed(text);
    }
    let shown = |c: char| if c.is_control() { c.escape_default().to_string() } else { c.to_string() };
    Cow::Owned(text.chars().map(shown).collect())
}

impl std::error::Error for FormatError {}

impl Hint for FormatError {
    fn hint(&self) -> Option<Cow<'_, str>> {
        self.hint.as_deref().map(Cow::Borrowed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn inputs_and_outputs_are_told_apart() {
        let text = |doing: &str, kind: io::ErrorKind| {
            let error = FormatError::io("x", doing, &kind.into());
            (error.to_string(), error.hint().map(Cow::into_owned).unwrap_or_default())
        };
        assert_eq!(text("read", io::ErrorKind::NotFound).0, "x: does not exist");
        assert_eq!(text("read", io::ErrorKind::IsADirectory).0, "x: is a folder, not a file");
        let (message, hint) = text("create the folder", io::ErrorKind::NotFound);
        assert_eq!(message, "x: cannot create the folder: nothing can be made there");
        assert_eq!(hint, "choose a folder that you may write to");
        assert_eq!(text("write", io::ErrorKind::StorageFull).0, "x: cannot write: no space left on the disk");
        assert_eq!(text("create", io::ErrorKind::AlreadyExists).0, "x: cannot create: a file is in its place");
    }

    #[test]
    fn only_clean_text_is_shown() {
        assert_eq!(shown(b"abc"), "`abc`");
        assert_eq!(shown("é".repeat(50).as_bytes()), format!("`{}…`", "é".repeat(40)));
        for bytes in [&b"\x7fELF\0"[..], b"\xff\xfe", b"\x1b[31m"] {
            assert_eq!(shown(bytes), "bytes that are not text");
        }
    }
}
