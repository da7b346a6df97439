//! Matrices of OpenFace's files.
//!
//! Text: rows, columns, type, then the values by rows, with lines that begin with `#` between. Binary, little-endian: i32
//! rows, columns, type (4 is i32, 5 is f32, 6 is f64), then the values by rows.

use std::path::Path;

use risorius_formats::FormatError;

use crate::error::Result;

/// More values than any of these files holds.
const MOST: usize = 1 << 24;
const DAMAGED: &str = "is it whole? copy the model files of OpenFace again";

/// A matrix by rows.
#[derive(Clone, Debug, PartialEq)]
pub struct Matrix {
    /// Rows.
    pub rows: usize,
    /// Columns.
    pub columns: usize,
    /// rows × columns values.
    pub values: Vec<f64>,
}

/// Something wrong with a model file.
pub fn damaged(path: &Path, what: impl Into<String>) -> FormatError {
    FormatError::syntax(what).in_file(path).with_hint(DAMAGED)
}

/// Reads a file of bytes.
pub fn read(path: &Path) -> Result<Vec<u8>> {
    Ok(std::fs::read(path).map_err(|e| FormatError::io(path, "read", &e))?)
}

/// All matrices of a text file.
pub fn read_text(path: &Path) -> Result<Vec<Matrix>> {
    let bytes = read(path)?;
    let text = String::from_utf8_lossy(&bytes);
    let lines = text.lines().enumerate().filter(|(_, line)| !line.trim_start().starts_with('#'));
    let mut words = lines.flat_map(|(i, line)| line.split_whitespace().map(move |word| (i as u64 + 1, word)));
    let mut matrices = Vec::new();
    while let Some(first) = words.next() {
        let number = |what: &str, word: Option<(u64, &str)>| -> Result<f64> {
            let (line, word) = word.ok_or_else(|| damaged(path, format!("ends before {what}")))?;
            let parsed = word.parse::<f64>().ok().filter(|v| v.is_finite());
            Ok(parsed.ok_or_else(|| damaged(path, format!("`{word}` is not {what}")).at_line(line))?)
        };
        let rows = number("a number of rows", Some(first))?;
        let columns = number("a number of columns", words.next())?;
        number("a type", words.next())?;
        let (rows, columns) = size(path, rows, columns)?;
        let mut values = Vec::with_capacity(rows * columns);
        for _ in 0..rows * columns {
            values.push(number("a value of a matrix", words.next())?);
        }
        matrices.push(Matrix { rows, columns, values });
    }
    Ok(matrices)
}

fn size(path: &Path, rows: f64, columns: f64) -> Result<(usize, usize)> {
    let is_size = |v: f64| v >= 1.0 && v.fract() == 0.0;
    if is_size(rows) && is_size(columns) && rows * columns <= MOST as f64 {
        Ok((rows as usize, columns as usize))
    } else {
        Err(damaged(path, format!("has a matrix of {rows} × {columns} values")).into())
    }
}

/// Reads a binary file from its beginning.
#[derive(Debug)]
pub struct Binary<'a> {
    path: &'a Path,
    rest: &'a [u8],
}

impl<'a> Binary<'a> {
    /// The bytes of the file `path`.
    pub fn new(path: &'a Path, bytes: &'a [u8]) -> Self {
        Self { path, rest: bytes }
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N]> {
        let (first, rest) = self.rest.split_first_chunk::<N>().ok_or_else(|| damaged(self.path, "ends early"))?;
        self.rest = rest;
        Ok(*first)
    }

    /// A whole number.
    pub fn i32(&mut self) -> Result<i32> {
        Ok(i32::from_le_bytes(self.take()?))
    }

    /// A number.
    pub fn f64(&mut self) -> Result<f64> {
        let value = f64::from_le_bytes(self.take()?);
        if value.is_finite() { Ok(value) } else { Err(damaged(self.path, "holds a number that is not finite").into()) }
    }

    /// A matrix.
    pub fn matrix(&mut self) -> Result<Matrix> {
        let [rows, columns, kind] = [self.i32()?, self.i32()?, self.i32()?];
        let (rows, columns) = size(self.path, f64::from(rows), f64::from(columns))?;
        let one = |this: &mut Self| match kind {
            4 => this.i32().map(f64::from),
            5 => Ok(f64::from(f32::from_le_bytes(this.take()?))),
            6 => this.f64(),
            _ => Err(damaged(this.path, format!("has a matrix of the type {kind}; 4, 5 and 6 are known")).into()),
        };
        let mut values = Vec::new();
        for _ in 0..rows * columns {
            values.push(one(self)?);
        }
        if values.iter().all(|v| v.is_finite()) {
            Ok(Matrix { rows, columns, values })
        } else {
            Err(damaged(self.path, "holds a number that is not finite").into())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(dir: &Path, bytes: &[u8]) -> std::path::PathBuf {
        let path = dir.join("m.txt");
        std::fs::write(&path, bytes).unwrap();
        path
    }

    #[test]
    fn text_matrices_are_read_and_errors_name_the_line() {
        let dir = tempfile::tempdir().unwrap();
        let path = file(dir.path(), b"# mean\r\n2\n1\n6\n1.5\n-2e1\n\n# modes\n1 2 6\n3 4\n");
        let found = read_text(&path).unwrap();
        assert_eq!(found[0], Matrix { rows: 2, columns: 1, values: vec![1.5, -20.0] });
        assert_eq!(found[1], Matrix { rows: 1, columns: 2, values: vec![3.0, 4.0] });
        for (bytes, expected) in
            [(&b"2\n1\n6\n1.5\n"[..], "ends before"), (b"1\n1\n6\nx\n", "`x` is not"), (b"0 9 6", "0 × 9")]
        {
            let said = read_text(&file(dir.path(), bytes)).unwrap_err().to_string();
            assert!(said.contains(expected) && said.contains("m.txt"), "{said}");
        }
    }

    #[test]
    fn binary_matrices_of_each_type() {
        let mut bytes: Vec<u8> = [1i32, 2, 5].iter().flat_map(|v| v.to_le_bytes()).collect();
        bytes.extend([0.5f32, 2.0].iter().flat_map(|v| v.to_le_bytes()));
        let path = Path::new("m.dat");
        let read = |bytes: &[u8]| Binary::new(path, bytes).matrix();
        assert_eq!(read(&bytes).unwrap().values, [0.5, 2.0]);
        assert!(read(&bytes[..bytes.len() - 1]).unwrap_err().to_string().contains("ends early"));
        bytes[8] = 9;
        assert!(read(&bytes).unwrap_err().to_string().contains("type 9"));
        bytes[0..4].copy_from_slice(&i32::MAX.to_le_bytes());
        assert!(read(&bytes).is_err(), "no memory is taken for what cannot be there");
    }
}
