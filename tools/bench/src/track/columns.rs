//! Columns of a table of numbers, by name: tables of OpenFace that went through other programs lack some.

use std::collections::BTreeMap;
use std::path::Path;

use risorius_formats::{ErrorKind, FormatError};

/// A table by columns; what is no number is NaN.
#[derive(Clone, Debug, Default)]
pub(crate) struct Columns {
    pub(crate) rows: usize,
    values: BTreeMap<String, Vec<f64>>,
}

impl Columns {
    pub(crate) fn read(path: &Path) -> Result<Self, FormatError> {
        let fault = |e: &csv::Error| FormatError::new(ErrorKind::Syntax, e.to_string()).in_file(path);
        let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_path(path).map_err(|e| fault(&e))?;
        let header = reader.headers().map_err(|e| fault(&e))?.clone();
        let mut columns = vec![Vec::new(); header.len()];
        for record in reader.records() {
            let record = record.map_err(|e| fault(&e))?;
            for (column, cell) in columns.iter_mut().zip(&record) {
                column.push(cell.parse().unwrap_or(f64::NAN));
            }
        }
        let rows = columns.first().map_or(0, Vec::len);
        Ok(Self { rows, values: header.iter().map(str::to_owned).zip(columns).collect() })
    }

    /// The columns of these names, where all are there.
    pub(crate) fn get<const N: usize>(&self, names: [&str; N]) -> Option<[&[f64]; N]> {
        let found = names.map(|name| self.values.get(name).map(Vec::as_slice));
        found.iter().all(Option::is_some).then(|| found.map(Option::unwrap_or_default))
    }
}
