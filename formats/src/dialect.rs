//! Separators and decimal marks: spreadsheets and locales write tables with semicolons, tabs and decimal commas.
//!
//! Where the separator is not a comma, decimal commas are no riddle: both are converted, byte by byte, so that lines keep
//! their numbers. Commas for both are a riddle, and refused by whoever knows how many cells a line should have.

use std::borrow::Cow;

use crate::FormatError;

/// The bytes of a table with commas between cells and points in numbers, and what had to be converted for that.
pub(crate) fn with_commas(bytes: &[u8]) -> (Cow<'_, [u8]>, Option<&'static str>) {
    let header = bytes.split(|&b| b == b'\n').find(|line| !line.trim_ascii().is_empty()).unwrap_or_default();
    let count = |wanted: u8| header.split(|&b| b == wanted).count() - 1;
    let separator = [b';', b'\t'].into_iter().find(|&s| count(s) > count(b','));
    match separator {
        Some(separator) => {
            let has_commas = bytes.contains(&b',');
            let convert = |b: &u8| match *b {
                b if b == separator => b',',
                b',' => b'.',
                b => b,
            };
            let what = match (separator, has_commas) {
                (b';', true) => "the columns are separated by semicolons and the numbers have decimal commas",
                (b';', false) => "the columns are separated by semicolons",
                (_, true) => "the columns are separated by tabs and the numbers have decimal commas",
                (_, false) => "the columns are separated by tabs",
            };
            (bytes.iter().map(convert).collect::<Vec<u8>>().into(), Some(what))
        }
        None => match quoted_decimals(bytes) {
            Some(converted) => (converted.into(), Some("the numbers have decimal commas in quotes")),
            None => (bytes.into(), None),
        },
    }
}

/// The bytes with points in cells such as `"0,93"`; `None` where there are none.
fn quoted_decimals(bytes: &[u8]) -> Option<Vec<u8>> {
    let mut converted: Option<Vec<u8>> = None;
    let mut open: Option<usize> = None;
    for (at, &byte) in bytes.iter().enumerate() {
        match (byte, open) {
            (b'"', None) => open = Some(at),
            (b'"', Some(from)) => {
                let cell = &bytes[from + 1..at];
                let number = |b: &u8| b.is_ascii_digit() || matches!(b, b',' | b'-' | b'+' | b'e' | b'E' | b' ');
                let parts = cell.split(|&b| b == b',').count();
                if parts == 2 && cell.iter().all(number) && cell.iter().any(u8::is_ascii_digit) {
                    let copy = converted.get_or_insert_with(|| bytes.to_vec());
                    for b in &mut copy[from + 1..at] {
                        if *b == b',' {
                            *b = b'.';
                        }
                    }
                }
                open = None;
            }
            // A stray quote must not reach beyond its line.
            (b'\n', _) => open = None,
            _ => {}
        }
    }
    converted
}

/// The error for a line with more cells than the header, where the cause is decimal commas between comma-separated cells.
pub(crate) fn decimal_commas<'a>(
    expected: usize,
    found: usize,
    mut cells: impl Iterator<Item = &'a [u8]>,
) -> Option<FormatError> {
    let whole = |cell: &[u8]| !cell.contains(&b'.');
    (found > expected && found <= 2 * expected && cells.all(whole)).then(|| {
        FormatError::syntax(format!(
            "expected {expected} columns, found {found}: the numbers have decimal commas, as commas separate the columns"
        ))
        .with_hint("run the program that wrote the table with LC_ALL=C, as in `LC_ALL=C FeatureExtraction …`")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn converted(text: &str) -> (String, Option<&'static str>) {
        let (bytes, note) = with_commas(text.as_bytes());
        (String::from_utf8(bytes.into_owned()).unwrap(), note)
    }

    #[test]
    fn semicolons_and_tabs_become_commas() {
        assert_eq!(converted("a;b\n0,5;1\n").0, "a,b\n0.5,1\n");
        assert_eq!(converted("\na\tb\n0.5\t1\n"), ("\na,b\n0.5,1\n".into(), Some("the columns are separated by tabs")));
        assert_eq!(converted("a,b\n\"0,5\",1\n").0, "a,b\n\"0.5\",1\n");
        for text in ["a,b\n0.5,1\n", "a,b\n\"x,y\",1\n", "", "a\n1\n", "a,b\n\"5,\n1,2\n"] {
            assert_eq!(converted(text), (text.into(), None));
        }
    }

    #[test]
    fn decimal_commas_are_named() {
        let cells = |line: &'static str| line.split(',').map(str::as_bytes);
        assert!(decimal_commas(3, 5, cells("1,0,033,0,93")).is_some());
        assert!(decimal_commas(3, 5, cells("1,0.033,0.93,4,5")).is_none());
        assert!(decimal_commas(3, 7, cells("1,2,3,4,5,6,7")).is_none());
        assert!(decimal_commas(3, 3, cells("1,2,3")).is_none());
    }
}
