//! TensorBoard's event files: scalars only.
//!
//! A file is a run of records: length (u64), masked CRC-32C of the length, the record, masked CRC-32C of it, all
//! little-endian. A record is a protocol-buffer message `Event`, of which four fields are written.

use std::fs::{File, OpenOptions};
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use risorius_formats::FormatError;

use crate::error::Result;

/// The folder of a run's event files.
pub const FOLDER: &str = "tensorboard";

/// An open event file.
#[derive(Debug)]
pub struct EventFile {
    path: PathBuf,
    file: File,
}

impl EventFile {
    /// Opens a new file in `RUN/tensorboard`; each call of a resumed fit has one of its own, which TensorBoard joins.
    pub fn create(run: &Path) -> Result<Self> {
        let folder = run.join(FOLDER);
        std::fs::create_dir_all(&folder).map_err(|e| FormatError::io(&folder, "create the folder", &e))?;
        let seconds = now();
        // Two fits may begin in one second.
        for attempt in 0.. {
            let path = folder.join(format!("events.out.tfevents.{:010}.risorius.{attempt}", seconds as u64));
            match OpenOptions::new().write(true).create_new(true).open(&path) {
                Ok(file) => {
                    let mut events = Self { path, file };
                    events.write(&event(seconds, 0, &field_bytes(3, b"brain.Event:2")))?;
                    return Ok(events);
                }
                Err(e) if e.kind() == std::io::ErrorKind::AlreadyExists => {}
                Err(e) => return Err(FormatError::io(&path, "create", &e).into()),
            }
        }
        unreachable!("the loop ends by returning")
    }

    /// Writes numbers of one step, each under its tag.
    pub fn scalars(&mut self, step: u64, values: &[(String, f64)]) -> Result<()> {
        let mut summary = Vec::new();
        for (tag, value) in values {
            let mut one = field_bytes(1, tag.as_bytes());
            one.push((2 << 3) | 5);
            one.extend((*value as f32).to_le_bytes());
            summary.extend(field_bytes(1, &one));
        }
        self.write(&event(now(), step, &field_bytes(5, &summary)))
    }

    fn write(&mut self, record: &[u8]) -> Result<()> {
        let length = (record.len() as u64).to_le_bytes();
        let mut bytes = Vec::with_capacity(record.len() + 16);
        bytes.extend(length);
        bytes.extend(masked_crc(&length).to_le_bytes());
        bytes.extend(record);
        bytes.extend(masked_crc(record).to_le_bytes());
        // In one call: a killed fit leaves whole records.
        Ok(self.file.write_all(&bytes).map_err(|e| FormatError::io(&self.path, "write", &e))?)
    }
}

fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |t| t.as_secs_f64())
}

/// Field 1 the time, field 2 the step, then `what`.
fn event(seconds: f64, step: u64, what: &[u8]) -> Vec<u8> {
    let mut out = vec![(1 << 3) | 1];
    out.extend(seconds.to_le_bytes());
    out.push(2 << 3);
    varint(step, &mut out);
    out.extend(what);
    out
}

fn field_bytes(field: u8, bytes: &[u8]) -> Vec<u8> {
    let mut out = vec![(field << 3) | 2];
    varint(bytes.len() as u64, &mut out);
    out.extend(bytes);
    out
}

fn varint(mut value: u64, out: &mut Vec<u8>) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

fn masked_crc(bytes: &[u8]) -> u32 {
    crc32c::crc32c(bytes).rotate_right(15).wrapping_add(0xa282_ead8)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The records of a file, with their checksums checked.
    fn records(mut bytes: &[u8]) -> Vec<Vec<u8>> {
        let mut all = Vec::new();
        while !bytes.is_empty() {
            let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
            assert_eq!(bytes[8..12], masked_crc(&bytes[..8]).to_le_bytes());
            let record = &bytes[12..12 + length];
            assert_eq!(bytes[12 + length..][..4], masked_crc(record).to_le_bytes());
            all.push(record.to_vec());
            bytes = &bytes[length + 16..];
        }
        all
    }

    #[test]
    fn records_have_the_published_layout() {
        // RFC 3720, B.4: 32 bytes of zeros.
        assert_eq!(crc32c::crc32c(&[0; 32]), 0x8a91_36aa);
        let dir = tempfile::tempdir().unwrap();
        let mut events = EventFile::create(dir.path()).unwrap();
        events.scalars(300, &[("a".to_owned(), 1.0), ("b/c".to_owned(), -2.5)]).unwrap();
        let other = EventFile::create(dir.path()).unwrap();
        assert_ne!(other.path, events.path);
        let records = records(&std::fs::read(&events.path).unwrap());
        assert_eq!(records.len(), 2);
        assert_eq!(records[0][9..], [&[0x10, 0, 0x1a, 13][..], b"brain.Event:2"].concat());
        let first = [0x0a, 8, 0x0a, 1, b'a', 0x15, 0, 0, 0x80, 0x3f];
        let second = [0x0a, 10, 0x0a, 3, b'b', b'/', b'c', 0x15, 0, 0, 0x20, 0xc0];
        let expected = [&[0x10, 0xac, 2, 0x2a, 22][..], &first, &second].concat();
        assert_eq!(records[1][9..], expected);
    }
}
