//! A corpus: the tables of many takes in one folder, partitioned by subject and take, that polars, DuckDB and Spark read
//! as they read any Hive-partitioned Parquet.
//!
//! ```text
//! CORPUS/tables/TABLE/subject_dir=subject-NAME/take_dir=take-NAME/TABLE.parquet
//!   frames, aus, poses   a row per frame, as in the dataset's own tables (see `tables`)
//!   datasets, fits       a row per take: what was chosen; how the fit went
//!   metrics              a row per number that `trainer eval` found: kind of view, part, AU, metric, value
//! ```
//!
//! Every table has the columns `subject` and `take`, as text (see [`tables`](crate::tables)).
//!
//! [`collect()`] files one dataset, [`summarise`] reads the whole, one file in memory at a time.

mod collect;
mod numbers;
mod summary;

use std::path::{Path, PathBuf};

pub use collect::{Collected, Entry, collect};
pub use summary::{Agreement, AuCount, CorpusSummary, SubjectCount, TakeScore, summarise};

use crate::tables::partition;

/// The tables of a corpus.
pub const CORPUS_TABLES: [&str; 6] = ["frames", "aus", "poses", "datasets", "fits", "metrics"];

/// The file of `table` for a take of a subject.
pub fn table_path(corpus: &Path, table: &str, subject: &str, take: &str) -> PathBuf {
    let folder = corpus.join("tables").join(table);
    folder.join(partition("subject", subject)).join(partition("take", take)).join(format!("{table}.parquet"))
}

/// Whether a folder holds a corpus.
pub fn is_corpus(dir: &Path) -> bool {
    partitions(&dir.join("tables").join("datasets"), "subject").next().is_some()
}

/// The folders of partitions in `dir` with their names, by name.
fn partitions(dir: &Path, kind: &str) -> impl Iterator<Item = (String, PathBuf)> + use<> {
    let start = partition(kind, "");
    let entries = std::fs::read_dir(dir).into_iter().flatten().flatten();
    let mut found: Vec<(String, PathBuf)> = entries
        .filter_map(|entry| {
            let name = entry.file_name().to_string_lossy().into_owned();
            let value = name.strip_prefix(&start)?;
            Some((decoded(value), entry.path()))
        })
        .collect();
    found.sort();
    found.into_iter()
}

/// The name that [`encoded`] made a folder of; what is no `%XX` stays as it is.
fn decoded(name: &str) -> String {
    let bytes = name.as_bytes();
    let mut plain = Vec::with_capacity(bytes.len());
    let mut at = 0;
    while at < bytes.len() {
        let code = (bytes[at] == b'%')
            .then(|| name.get(at + 1..at + 3).and_then(|hex| u8::from_str_radix(hex, 16).ok()))
            .flatten();
        plain.push(code.unwrap_or(bytes[at]));
        at += if code.is_some() { 3 } else { 1 };
    }
    String::from_utf8_lossy(&plain).into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tables::encoded;

    #[test]
    fn names_survive_as_folders() {
        for name in ["ada", "Ada Lovelace", "a=b/c", "50 %", "ä 1"] {
            assert_eq!(decoded(&encoded(name)), name);
        }
        assert_eq!(decoded("50%"), "50%");
        assert_eq!(decoded("%zz%4"), "%zz%4");
        let path = table_path(Path::new("c"), "aus", "a b", "1");
        assert_eq!(path, Path::new("c/tables/aus/subject_dir=subject-a%20b/take_dir=take-1/aus.parquet"));
    }
}
