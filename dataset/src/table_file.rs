//! A Parquet file that was read: columns by name and type, and errors that name the file and the column.

use std::fs::File;
use std::path::{Path, PathBuf};

use glam::DVec3;
use polars::prelude::{Column, DataFrame, ParquetReader, SerReader, Series};
use risorius_formats::camera::Distortion;
use risorius_formats::{Camera, ErrorKind, FormatError, Intrinsics, Isometry};

use crate::error::{DatasetError, Result};
use crate::tables::{CAMERA_COLUMNS, column};

fn not_parquet(path: &Path, error: &polars::error::PolarsError) -> FormatError {
    let message = error.to_string();
    let message = format!("is not a Parquet table: {}", message.lines().next().unwrap_or_default());
    FormatError::new(ErrorKind::Syntax, message).in_file(path)
}

/// A table that was read, whose columns are asked for by name and type.
pub(crate) struct TableFile {
    path: PathBuf,
    frame: DataFrame,
}

impl TableFile {
    /// Reads a Parquet file.
    pub(crate) fn open(path: &Path) -> Result<Self> {
        Self::read(path, None)
    }

    /// Reads some columns of a Parquet file; the others stay on the disk.
    pub(crate) fn open_columns(path: &Path, columns: &[&str]) -> Result<Self> {
        Self::read(path, Some(columns.iter().map(ToString::to_string).collect()))
    }

    /// The names of a Parquet file's columns, without its rows.
    pub(crate) fn column_names(path: &Path) -> Result<Vec<String>> {
        let file = File::open(path).map_err(|e| FormatError::io(path, "read", &e))?;
        let schema = ParquetReader::new(file).schema().map_err(|e| not_parquet(path, &e))?;
        Ok(schema.iter_names().map(ToString::to_string).collect())
    }

    fn read(path: &Path, columns: Option<Vec<String>>) -> Result<Self> {
        let file = File::open(path).map_err(|e| FormatError::io(path, "read", &e))?;
        let frame = ParquetReader::new(file).with_columns(columns).finish().map_err(|e| not_parquet(path, &e))?;
        Ok(Self { path: path.to_owned(), frame })
    }

    pub(crate) fn height(&self) -> usize {
        self.frame.height()
    }

    pub(crate) fn names(&self) -> Vec<String> {
        self.frame.get_column_names().iter().map(ToString::to_string).collect()
    }

    fn column<T>(&self, name: &str, read: impl FnOnce(&Series) -> polars::error::PolarsResult<T>) -> Result<T> {
        let column = self.frame.column(name).map_err(|_| {
            FormatError::new(ErrorKind::Missing, "is not among the columns").in_file(&self.path).in_column(name)
        })?;
        read(column.as_materialized_series()).map_err(|e| {
            let message = e.to_string();
            let message = format!("has another type: {}", message.lines().next().unwrap_or_default());
            FormatError::new(ErrorKind::Syntax, message).in_file(&self.path).in_column(name).into()
        })
    }

    pub(crate) fn u32s(&self, name: &str) -> Result<Vec<Option<u32>>> {
        self.column(name, |s| Ok(s.u32()?.iter().collect()))
    }

    pub(crate) fn i64s(&self, name: &str) -> Result<Vec<Option<i64>>> {
        self.column(name, |s| Ok(s.i64()?.iter().collect()))
    }

    pub(crate) fn f32s(&self, name: &str) -> Result<Vec<Option<f32>>> {
        self.column(name, |s| Ok(s.f32()?.iter().collect()))
    }

    pub(crate) fn f64s(&self, name: &str) -> Result<Vec<Option<f64>>> {
        self.column(name, |s| Ok(s.f64()?.iter().collect()))
    }

    pub(crate) fn bools(&self, name: &str) -> Result<Vec<Option<bool>>> {
        self.column(name, |s| Ok(s.bool()?.iter().collect()))
    }

    pub(crate) fn texts(&self, name: &str) -> Result<Vec<Option<String>>> {
        self.column(name, |s| Ok(s.str()?.iter().map(|t| t.map(str::to_owned)).collect()))
    }

    /// The columns of the table, with others of one text each in front; those of the same names go.
    pub(crate) fn with_texts(self, names: &[(&str, &str)]) -> Vec<Column> {
        let rows = self.height();
        let mut columns: Vec<Column> = names.iter().map(|(name, text)| column(name, vec![*text; rows])).collect();
        let own = self.frame.into_columns();
        columns.extend(own.into_iter().filter(|c| names.iter().all(|(name, _)| c.name().as_str() != *name)));
        columns
    }

    /// An error about the table.
    pub(crate) fn bad(&self, message: impl Into<String>) -> DatasetError {
        FormatError::new(ErrorKind::Inconsistent, message).in_file(&self.path).into()
    }

    /// The cameras of all rows.
    pub(crate) fn cameras(&self) -> Result<Vec<Camera>> {
        let sizes = [self.u32s("width")?, self.u32s("height")?];
        let numbers: Vec<Vec<Option<f64>>> =
            CAMERA_COLUMNS.iter().map(|(name, _)| self.f64s(name)).collect::<Result<_>>()?;
        let camera = |row: usize| -> Option<Camera> {
            let n: Vec<f64> = numbers.iter().map(|c| c[row].filter(|v| v.is_finite())).collect::<Option<_>>()?;
            let intrinsics = Intrinsics {
                width: sizes[0][row]?,
                height: sizes[1][row]?,
                fx: n[0],
                fy: n[1],
                cx: n[2],
                cy: n[3],
                skew: n[4],
                distortion: Distortion {
                    radial: [n[5], n[6], n[7]],
                    radial_denominator: [0.0; 3],
                    tangential: [n[8], n[9]],
                },
            };
            let turn = [n[10], n[11], n[12], n[13]];
            if turn.iter().map(|v| v * v).sum::<f64>() < 1e-6 || n[0] <= 0.0 || n[1] <= 0.0 {
                return None;
            }
            let camera_from_world = Isometry::from_wxyz(turn, DVec3::new(n[14], n[15], n[16]));
            Some(Camera { intrinsics, camera_from_world })
        };
        (0..self.height())
            .map(|row| camera(row).ok_or_else(|| self.bad(format!("row {}: its camera makes no sense", row + 1))))
            .collect()
    }
}
