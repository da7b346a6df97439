//! A checkpoint's arrays as records of Burn (`.bpk`).
//!
//! - `weights.bpk` is the record of a [`BrickParameters`](crate::brick::tensors::BrickParameters).
//! - `optimizer.bpk` holds Adam's moments at the same paths behind `first.` and `second.`, and the updates of each block
//!   behind `steps.`: the record of a [`BrickMoments`](crate::brick::tensors::BrickMoments).
//! - `space.bpk` says which bricks there are and which parts of space are occupied.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use burn::tensor::{AllocationProperty, Bytes, DType};
use burn_pack::{Reader, Writer};
use risorius_brick::Brick;
use risorius_formats::{FormatError, atomic};

use super::{Array, Content, Numbers, Role, SavedBrick, arrays, check_finite, fill, read_numbers, ready, unfilled};
use crate::error::Result;
use crate::saved::damaged;

/// The files, and the roles of what they hold.
const FILES: [(&str, &[Role]); 3] = [
    ("weights.bpk", &[Role::Value]),
    ("optimizer.bpk", &[Role::First, Role::Second, Role::Steps]),
    ("space.bpk", &[Role::Space]),
];

/// Where the array stands in its record.
fn place(array: &Array<'_>) -> String {
    let path = &array.path;
    match array.role {
        Role::Value | Role::Space => path.clone(),
        Role::First => format!("first.{path}"),
        Role::Second => format!("second.{path}"),
        Role::Steps => format!("steps.{path}"),
    }
}

fn dtype(numbers: &Numbers<'_>) -> DType {
    match numbers {
        Numbers::Floats(_) => DType::F32,
        Numbers::Counts(_) => DType::U32,
        Numbers::Bytes(_) => DType::U8,
    }
}

/// A vector that a writer reads while its owner waits: records want bytes that live on their own, and a copy of all arrays
/// would cost as much memory as the fit.
struct Lent<T>(Arc<Vec<T>>);

impl<T: bytemuck::NoUninit> AsRef<[u8]> for Lent<T> {
    fn as_ref(&self) -> &[u8] {
        bytemuck::cast_slice(&self.0)
    }
}

impl<T: bytemuck::NoUninit + Send + Sync> Lent<T> {
    fn of(values: &mut Vec<T>) -> Self {
        Self(Arc::new(std::mem::take(values)))
    }

    fn bytes(&self) -> Bytes {
        let owner = bytes::Bytes::from_owner(Self(Arc::clone(&self.0)));
        Bytes::from_shared(owner, AllocationProperty::Native)
    }

    fn back(self, values: &mut Vec<T>) {
        *values = Arc::try_unwrap(self.0).unwrap_or_else(|shared| shared.to_vec());
    }
}

enum Loan {
    Floats(Lent<f32>),
    Counts(Lent<u32>),
    Bytes(Lent<u8>),
}

/// Writes all that resuming needs of a model into the folder `dir`, and `more` floats of the fit. The model is as it was when
/// this ends, well or not.
pub fn write(dir: &Path, model: &mut Brick, more: &[(&str, &[f32])]) -> Result<()> {
    let mut all = arrays(model, Content::Checkpoint);
    check_finite(dir, &all)?;
    let loans: Vec<Loan> = all
        .iter_mut()
        .map(|array| match &mut array.numbers {
            Numbers::Floats(values) => Loan::Floats(Lent::of(values)),
            Numbers::Counts(values) => Loan::Counts(Lent::of(values)),
            Numbers::Bytes(values) => Loan::Bytes(Lent::of(values)),
        })
        .collect();
    let written = write_files(dir, &all, &loans, more);
    for (array, loan) in all.iter_mut().zip(loans) {
        match (&mut array.numbers, loan) {
            (Numbers::Floats(values), Loan::Floats(loan)) => loan.back(values),
            (Numbers::Counts(values), Loan::Counts(loan)) => loan.back(values),
            (Numbers::Bytes(values), Loan::Bytes(loan)) => loan.back(values),
            _ => unreachable!("loans are made of the arrays"),
        }
    }
    written
}

fn write_files(dir: &Path, all: &[Array<'_>], loans: &[Loan], more: &[(&str, &[f32])]) -> Result<()> {
    for (file, roles) in FILES {
        let mut tensors: Vec<burn_pack::Tensor> = all
            .iter()
            .zip(loans)
            .filter(|(array, _)| roles.contains(&array.role))
            .map(|(array, loan)| {
                let (bytes, count) = match loan {
                    Loan::Floats(loan) => (loan.bytes(), loan.0.len()),
                    Loan::Counts(loan) => (loan.bytes(), loan.0.len()),
                    Loan::Bytes(loan) => (loan.bytes(), loan.0.len()),
                };
                let rows = count.checked_div(array.width);
                let shape = rows.map_or_else(|| vec![count], |rows| vec![rows, array.width]);
                burn_pack::Tensor::new(place(array), dtype(&array.numbers), shape, None, bytes)
            })
            .collect();
        if roles.contains(&Role::Space) {
            tensors.extend(more.iter().map(|(name, values)| {
                let bytes = Bytes::from_elems(values.to_vec());
                burn_pack::Tensor::new((*name).to_owned(), DType::F32, vec![values.len()], None, bytes)
            }));
        }
        let path = dir.join(file);
        atomic::write_file_by(&path, |staged| {
            Writer::new(tensors).auto_extension(false).write_to_file_in_place(staged).map_err(|e| match e {
                burn_pack::Error::IoError(said) => FormatError::io(&path, "write", &io_error(said)).into(),
                other => damaged(&path, &other),
            })
        })?;
    }
    Ok(())
}

/// The system's error behind what the records' writer says, which is a sentence: what to do about a full disk hangs on it.
fn io_error(said: String) -> std::io::Error {
    let number = said.rsplit_once("(os error ").and_then(|(_, rest)| rest.split_once(')')?.0.parse().ok());
    number.map_or_else(|| std::io::Error::other(said), std::io::Error::from_raw_os_error)
}

/// Reads what [`write()`] wrote, and the floats named `more`.
pub fn read(dir: &Path, saved: &SavedBrick, more: &[&str]) -> Result<(Brick, Vec<Vec<f32>>)> {
    let mut file_bytes = 0;
    for (file, _) in FILES {
        let path = dir.join(file);
        let length = std::fs::metadata(&path).map_err(|e| FormatError::io(&path, "read", &e))?.len();
        file_bytes += usize::try_from(length).unwrap_or(usize::MAX);
    }
    let mut model = unfilled(saved, file_bytes).map_err(|problem| damaged(dir, &problem))?;
    let mut all = arrays(&mut model, Content::Checkpoint);
    let mut others = Vec::new();
    for (file, roles) in FILES {
        let path = dir.join(file);
        // Whole, here: what a reader fetches later it can only panic about.
        let bytes = std::fs::read(&path).map_err(|e| FormatError::io(&path, "read", &e))?;
        let reader = Reader::from_bytes(Bytes::from_bytes_vec(bytes));
        let tensors = reader.and_then(Reader::into_tensors).map_err(|e| damaged(&path, &e))?;
        let mut tensors: BTreeMap<String, burn_pack::Tensor> =
            tensors.into_iter().map(|t| (t.name.clone(), t)).collect();
        let mut take = |name: &str, expected: DType| {
            let tensor = tensors.remove(name).ok_or_else(|| format!("`{name}` is missing"))?;
            if tensor.dtype != expected {
                return Err(format!("`{name}` holds {:?}, expected {expected:?}", tensor.dtype));
            }
            tensor.into_bytes().map_err(|e| format!("`{name}`: {e}"))
        };
        let mut read = || {
            for array in all.iter_mut().filter(|array| roles.contains(&array.role)) {
                let bytes = take(&place(array), dtype(&array.numbers))?;
                fill(array, bytes.len(), &mut &bytes[..])?;
            }
            if roles.contains(&Role::Space) {
                for name in more {
                    let bytes = take(name, DType::F32)?;
                    let values = read_numbers(bytes.len() / 4, &mut &bytes[..]);
                    others.push(values.map_err(|e| format!("`{name}`: {e}"))?);
                }
            }
            Ok(())
        };
        read().map_err(|problem: String| damaged(&path, &problem))?;
    }
    match ready(model, saved, Content::Checkpoint) {
        Ok(model) => Ok((model, others)),
        Err(problem) => Err(damaged(dir, &problem)),
    }
}
