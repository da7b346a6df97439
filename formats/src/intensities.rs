//! `DATASET/intensities.csv`: the smoothed AU intensities behind a dataset's attributes, 0–5, one row per frame.
//!
//! Eq. 1 caps attributes at 1, which 80 % of the largest intensity reach already; whoever wants to tell the strongest
//! expressions apart needs the intensities themselves. Folders of other tools do not have the file.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use crate::{ActionUnit, ErrorKind, FormatError, Result, atomic};

/// The file's name.
pub const FILE: &str = "intensities.csv";

/// Intensities of all frames of a dataset.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Intensities {
    /// The action units, in the order of the columns.
    pub units: Vec<ActionUnit>,
    /// Per frame id, one value per unit.
    pub rows: BTreeMap<String, Vec<f32>>,
}

/// Where the file lies.
pub fn path(dataset: impl AsRef<Path>) -> PathBuf {
    dataset.as_ref().join(FILE)
}

impl Intensities {
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
        let header = reader.headers().map_err(|e| syntax(&e))?.clone();
        if header.get(0) != Some("id") {
            return Err(FormatError::new(ErrorKind::Missing, "has no column `id`").at_line(1));
        }
        let units = header.iter().skip(1).map(|h| h.parse().map_err(|e: FormatError| e.at_line(1)));
        let mut table = Self { units: units.collect::<Result<_>>()?, rows: BTreeMap::new() };
        for record in reader.records() {
            let record = record.map_err(|e| syntax(&e))?;
            let line = record.position().map_or(0, csv::Position::line);
            let id = record.get(0).unwrap_or_default().to_owned();
            let mut values = Vec::with_capacity(table.units.len());
            for (text, unit) in record.iter().skip(1).zip(&table.units) {
                match text.trim().parse::<f32>() {
                    Ok(v) if v.is_finite() => values.push(v),
                    _ => {
                        return Err(FormatError::syntax(format!("column `{unit}` holds `{text}`, expected a number"))
                            .at_line(line));
                    }
                }
            }
            if table.rows.insert(id.clone(), values).is_some() {
                return Err(
                    FormatError::new(ErrorKind::Inconsistent, format!("`{id}` stands there twice")).at_line(line)
                );
            }
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

    /// Writes the file, whole or not at all.
    pub fn write(&self, dataset: impl AsRef<Path>) -> Result<()> {
        let line = |first: &str, rest: Vec<String>| {
            std::iter::once(first.to_owned()).chain(rest).collect::<Vec<_>>().join(",")
        };
        let head = line("id", self.units.iter().map(ToString::to_string).collect());
        let rows = self.rows.iter().map(|(id, values)| line(id, values.iter().map(ToString::to_string).collect()));
        let text = std::iter::once(head).chain(rows).collect::<Vec<_>>().join("\n") + "\n";
        atomic::write_file(path(dataset), text.as_bytes())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_reads_back_equal() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(Intensities::read(folder.path()).unwrap(), None);
        let table = Intensities {
            units: vec![ActionUnit(1), ActionUnit(12)],
            rows: [("000003".to_owned(), vec![0.1, 4.700_001]), ("000010".to_owned(), vec![0.0, 5.0])].into(),
        };
        table.write(folder.path()).unwrap();
        assert_eq!(Intensities::read(folder.path()).unwrap(), Some(table));
    }

    #[test]
    fn bad_values_are_named_with_their_line() {
        for (text, line, words) in [
            ("id,AU01\na,1\nb,nan\n", 3, "`nan`"),
            ("id,AU01\na,1\na,2\n", 3, "twice"),
            ("id,AU01\na,1\nb\n", 3, ""),
            ("frame,AU01\n", 1, "`id`"),
            ("id,XX\n", 1, "XX"),
        ] {
            let error = Intensities::parse(text.as_bytes()).unwrap_err().to_string();
            assert!(error.contains(words) && error.contains(&line.to_string()), "{text:?}: {error}");
        }
    }
}
