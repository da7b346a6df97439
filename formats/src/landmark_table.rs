//! `DATASET/landmarks.csv`: the tracked 68 landmarks of a dataset's frames, pixels of the full-size (1x) picture, the
//! centre of the first pixel at (0.5, 0.5). One row per frame that has them: `id,x_0,…,x_67,y_0,…,y_67`.
//!
//! The Gaussian field initialises its AU deltas from them. Folders of other tools do not have the file.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use crate::{ErrorKind, FormatError, Landmarks68, Result, atomic};

/// The file's name.
pub const FILE: &str = "landmarks.csv";

/// Landmarks of all frames of a dataset.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LandmarkTable {
    /// Per frame id.
    pub rows: BTreeMap<String, Landmarks68>,
}

/// Where the file lies.
pub fn path(dataset: impl AsRef<Path>) -> PathBuf {
    dataset.as_ref().join(FILE)
}

fn header() -> String {
    ["x", "y"].iter().flat_map(|axis| (0..68).map(move |i| format!(",{axis}_{i}"))).fold("id".to_owned(), |a, b| a + &b)
}

impl LandmarkTable {
    /// Parses the file: every value must be a finite number, every id stand there once.
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        let mut reader = csv::Reader::from_reader(bytes);
        let syntax = |e: &csv::Error| {
            let error = FormatError::syntax(e.to_string());
            match e.position() {
                Some(p) => error.at_line(p.line()),
                None => error,
            }
        };
        let found = reader.headers().map_err(|e| syntax(&e))?.iter().collect::<Vec<_>>().join(",");
        if found != header() {
            let message = "the header must be `id`, then `x_0` to `x_67`, then `y_0` to `y_67`";
            return Err(FormatError::new(ErrorKind::Missing, message).at_line(1));
        }
        let mut table = Self::default();
        for record in reader.records() {
            let record = record.map_err(|e| syntax(&e))?;
            let line = record.position().map_or(0, csv::Position::line);
            let mut points_px = [[0.0f32; 2]; 68];
            for (k, text) in record.iter().skip(1).enumerate() {
                match text.trim().parse::<f32>() {
                    Ok(v) if v.is_finite() => points_px[k % 68][k / 68] = v,
                    _ => {
                        let axis = if k < 68 { 'x' } else { 'y' };
                        let message = format!("column `{axis}_{}` holds `{text}`, expected a number", k % 68);
                        return Err(FormatError::syntax(message).at_line(line));
                    }
                }
            }
            let id = record.get(0).unwrap_or_default().to_owned();
            if table.rows.contains_key(&id) {
                let message = format!("`{id}` stands there twice");
                return Err(FormatError::new(ErrorKind::Inconsistent, message).at_line(line));
            }
            table.rows.insert(id, Landmarks68 { points_px });
        }
        Ok(table)
    }

    /// Reads the file of a dataset; `None` where there is none.
    pub fn read(dataset: impl AsRef<Path>) -> Result<Option<Self>> {
        let path = path(dataset);
        if !path.is_file() {
            return Ok(None);
        }
        let bytes = std::fs::read(&path).map_err(|e| FormatError::io(&path, "read", &e))?;
        Self::parse(&bytes)
            .map(Some)
            .map_err(|e| e.in_file(&path).or_hint("the file is written by `dataset build`; build the dataset again"))
    }

    /// Writes the file, whole or not at all. Rows with a coordinate that is not finite are left out, and a table
    /// without rows leaves no file.
    pub fn write(&self, dataset: impl AsRef<Path>) -> Result<()> {
        let mut text = header() + "\n";
        let mut rows = 0;
        for (id, landmarks) in self.rows.iter().filter(|(_, l)| l.is_finite()) {
            text += id;
            for axis in 0..2 {
                for point in &landmarks.points_px {
                    // Writing to a string cannot fail.
                    let _ = write!(text, ",{}", point[axis]);
                }
            }
            text.push('\n');
            rows += 1;
        }
        if rows == 0 { Ok(()) } else { atomic::write_file(path(dataset), text.as_bytes()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn landmarks(shift: f32) -> Landmarks68 {
        Landmarks68 { points_px: std::array::from_fn(|i| [i as f32 * 1.25 + shift, 500.3 - i as f32 / 3.0]) }
    }

    #[test]
    fn what_is_written_reads_back_equal() {
        let folder = tempfile::tempdir().unwrap();
        LandmarkTable::default().write(folder.path()).unwrap();
        assert_eq!(LandmarkTable::read(folder.path()).unwrap(), None);
        let mut table =
            LandmarkTable { rows: [("000003".into(), landmarks(0.1)), ("000010".into(), landmarks(-7.3))].into() };
        let sound = table.clone();
        table.rows.insert("000011".into(), landmarks(f32::NAN));
        table.write(folder.path()).unwrap();
        assert_eq!(LandmarkTable::read(folder.path()).unwrap(), Some(sound));
    }

    #[test]
    fn bad_values_are_named_with_their_line() {
        let row = |id: &str, last: &str| format!("{id}{},{last}\n", ",1.5".repeat(135));
        for (text, line, words) in [
            (format!("{}\n{}{}", header(), row("a", "2"), row("b", "inf")), 3, "`inf`"),
            (format!("{}\n{}{}", header(), row("a", "2"), row("b", "")), 3, "`y_67`"),
            (format!("{}\n{}{}", header(), row("a", "2"), row("a", "2")), 3, "twice"),
            (format!("{}\n{}b,1\n", header(), row("a", "2")), 3, ""),
            (format!("{}\n", header().replace("x_5,", "")), 1, "`x_67`"),
        ] {
            let error = LandmarkTable::parse(text.as_bytes()).unwrap_err().to_string();
            assert!(error.contains(words) && error.contains(&line.to_string()), "{text:?}: {error}");
        }
    }
}
