//! Arrays of numbers from NumPy's `.npz` files: a ZIP archive of `.npy` files, stored or deflated.

use std::collections::BTreeMap;
use std::io::Read as _;
use std::path::Path;

use risorius_formats::{ErrorKind, FormatError};

/// An array of 64- or 32-bit floats.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Array {
    pub(crate) shape: Vec<usize>,
    /// In C order.
    pub(crate) values: Vec<f64>,
}

/// All float arrays of a file, by name; others are left out.
pub(crate) fn read(path: &Path) -> Result<BTreeMap<String, Array>, FormatError> {
    let bytes = std::fs::read(path).map_err(|e| FormatError::io(path, "read", &e))?;
    parse(&bytes).map_err(|message| FormatError::new(ErrorKind::Syntax, message).in_file(path))
}

fn parse(bytes: &[u8]) -> Result<BTreeMap<String, Array>, String> {
    let u16_at = |at: usize| Some(usize::from(u16::from_le_bytes(bytes.get(at..at + 2)?.try_into().ok()?)));
    let u32_at = |at: usize| Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?) as usize);
    let cut = || "is cut off or not an .npz file".to_owned();
    // The end record stands within the last 64 KiB and points to the directory.
    let from = bytes.len().saturating_sub(66_000);
    let end = (from..bytes.len()).rev().find(|&at| bytes[at..].starts_with(b"PK\x05\x06")).ok_or_else(cut)?;
    let (count, mut at) = u16_at(end + 10).zip(u32_at(end + 16)).ok_or_else(cut)?;
    let mut arrays = BTreeMap::new();
    for _ in 0..count {
        let entry = || {
            let name = bytes.get(at + 46..at + 46 + u16_at(at + 28)?)?;
            Some((u16_at(at + 10)?, u32_at(at + 20)?, u32_at(at + 42)?, String::from_utf8_lossy(name).into_owned()))
        };
        let (method, packed, local, name) = entry().ok_or_else(cut)?;
        let next = || Some(at + 46 + u16_at(at + 28)? + u16_at(at + 30)? + u16_at(at + 32)?);
        at = next().ok_or_else(cut)?;
        let data = || {
            let start = local + 30 + u16_at(local + 26)? + u16_at(local + 28)?;
            bytes.get(start..start.checked_add(packed)?)
        };
        let data = data().ok_or_else(cut)?;
        let mut plain = Vec::new();
        match method {
            0 => plain.extend_from_slice(data),
            8 => {
                flate2::read::DeflateDecoder::new(data)
                    .read_to_end(&mut plain)
                    .map_err(|e| format!("`{name}`: {e}"))?;
            }
            other => return Err(format!("`{name}`: compression {other} is not known")),
        }
        if let Some(array) = array(&plain) {
            arrays.insert(name.trim_end_matches(".npy").to_owned(), array);
        }
    }
    Ok(arrays)
}

/// A `.npy` file of floats in C order; `None` for anything else.
fn array(bytes: &[u8]) -> Option<Array> {
    if !bytes.starts_with(b"\x93NUMPY") {
        return None;
    }
    let (start, length) = match bytes.get(6)? {
        1 => (10, usize::from(u16::from_le_bytes(bytes.get(8..10)?.try_into().ok()?))),
        _ => (12, u32::from_le_bytes(bytes.get(8..12)?.try_into().ok()?) as usize),
    };
    let header = std::str::from_utf8(bytes.get(start..start + length)?).ok()?;
    let value = |key: &str| header.split_once(key).map(|(_, rest)| rest.trim_start_matches([':', ' ', '\'']));
    if value("fortran_order'")?.starts_with("True") {
        return None;
    }
    let shape = value("shape'")?.trim_start_matches('(').split_once(')')?.0;
    let shape: Vec<usize> = shape.split(',').filter_map(|n| n.trim().parse().ok()).collect();
    let data = bytes.get(start + length..)?;
    let kind = value("descr'")?;
    let values: Vec<f64> = if kind.starts_with("<f8") {
        data.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect()
    } else if kind.starts_with("<f4") {
        data.as_chunks().0.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect()
    } else {
        return None;
    };
    (values.len() == shape.iter().product::<usize>()).then_some(Array { shape, values })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_archive_is_refused_in_one_line() {
        assert_eq!(parse(b"").unwrap_err(), "is cut off or not an .npz file");
        assert_eq!(parse(b"PK\x05\x06 and nothing").unwrap_err(), "is cut off or not an .npz file");
    }

    #[test]
    fn an_array_of_floats_is_read() {
        let header = "{'descr': '<f4', 'fortran_order': False, 'shape': (1, 2), }\n";
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());
        bytes.extend(header.as_bytes());
        bytes.extend([1.5f32, -2.0].iter().flat_map(|v| v.to_le_bytes()));
        assert_eq!(array(&bytes), Some(Array { shape: vec![1, 2], values: vec![1.5, -2.0] }));
        assert_eq!(array(&bytes[..bytes.len() - 1]), None);
    }
}
