//! An avatar's arrays in safetensors.

use std::borrow::Cow;
use std::fs::File;
use std::io::{Read as _, Seek as _, SeekFrom};
use std::path::Path;

use risorius_brick::Brick;
use risorius_formats::{FormatError, atomic};
use safetensors::tensor::{Dtype, Metadata};

use super::{Content, Numbers, SavedBrick, arrays, check_finite, fill, read_numbers, ready, unfilled};
use crate::brick::plate::Plate;
use crate::error::Result;
use crate::saved::damaged;

/// An array on its way to a file.
enum Kept<'m> {
    Floats(&'m [f32], [usize; 1]),
    Counts(&'m [u32], [usize; 1]),
    Bytes(&'m [u8], [usize; 1]),
}

impl safetensors::View for Kept<'_> {
    fn dtype(&self) -> Dtype {
        match self {
            Self::Floats(..) => Dtype::F32,
            Self::Counts(..) => Dtype::U32,
            Self::Bytes(..) => Dtype::U8,
        }
    }

    fn shape(&self) -> &[usize] {
        let (Self::Floats(_, shape) | Self::Counts(_, shape) | Self::Bytes(_, shape)) = self;
        shape
    }

    fn data(&self) -> Cow<'_, [u8]> {
        match self {
            // The file is little-endian: there, what lies in memory is what goes to the disk, without a copy.
            Self::Floats(values, _) if cfg!(target_endian = "little") => Cow::Borrowed(bytemuck::cast_slice(values)),
            Self::Counts(values, _) if cfg!(target_endian = "little") => Cow::Borrowed(bytemuck::cast_slice(values)),
            Self::Floats(values, _) => values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>().into(),
            Self::Counts(values, _) => values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>().into(),
            Self::Bytes(values, _) => Cow::Borrowed(values),
        }
    }

    fn data_len(&self) -> usize {
        self.shape()[0] * if matches!(self, Self::Bytes(..)) { 1 } else { 4 }
    }
}

/// Writes what rendering needs of a model, with the plate if there is one; one array after the other, so that no copy of the
/// whole is made. The model is only read.
pub fn write(path: &Path, model: &mut Brick, plate: Option<&Plate>) -> Result<()> {
    let all = arrays(model, Content::Avatar);
    check_finite(path, &all)?;
    let mut kept: Vec<(String, Kept<'_>)> = all
        .into_iter()
        .map(|array| {
            let kept = match array.numbers {
                Numbers::Floats(values) => Kept::Floats(values, [values.len()]),
                Numbers::Counts(values) => Kept::Counts(values, [values.len()]),
                Numbers::Bytes(values) => Kept::Bytes(values, [values.len()]),
            };
            (array.name, kept)
        })
        .collect();
    if let Some(plate) = plate {
        kept.push(("plate".to_owned(), Kept::Bytes(&plate.rgb, [plate.rgb.len()])));
    }
    let io = |e: std::io::Error| FormatError::io(path, "write", &e);
    // The crate writes a private file of its own beside ours first, which would stay behind a killed process.
    atomic::write_file_by(path, |staged| {
        safetensors::serialize_to_file(kept, None, staged).map_err(|e| match e {
            safetensors::SafeTensorError::IoError(e) => io(e).into(),
            other => damaged(path, &other),
        })?;
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt as _;
            std::fs::set_permissions(staged, std::fs::Permissions::from_mode(0o644)).map_err(io)?;
        }
        Ok(())
    })
}

/// Reads what [`write()`] wrote, each array to where it stays.
pub fn read(path: &Path, saved: &SavedBrick) -> Result<(Brick, Option<Plate>)> {
    let io = |e: std::io::Error| FormatError::io(path, "read", &e);
    let file = File::open(path).map_err(io)?;
    let length = file.metadata().map_err(io)?.len();
    let arrays = Arrays::of(file, length);
    arrays.and_then(|arrays| from_arrays(arrays, saved)).map_err(|problem| damaged(path, &problem))
}

/// The arrays of a file, of which only the header was read.
struct Arrays {
    file: File,
    length: u64,
    /// Where the arrays' bytes begin.
    start: u64,
    header: Metadata,
}

impl Arrays {
    /// The header is checked against the file's length before memory is taken.
    fn of(mut file: File, length: u64) -> std::result::Result<Self, String> {
        /// Bytes of a header that are read; some sixty arrays take six thousand.
        const MAX_HEADER: u64 = 1 << 20;
        let mut size = [0; 8];
        file.read_exact(&mut size).map_err(|e| format!("its header: {e}"))?;
        let size = u64::from_le_bytes(size);
        if size > MAX_HEADER || 8 + size > length {
            return Err(format!("a header of {size} bytes in a file of {length}"));
        }
        let mut text = vec![0; size as usize];
        file.read_exact(&mut text).map_err(|e| format!("its header: {e}"))?;
        let header: Metadata = serde_json::from_slice(&text).map_err(|e| format!("its header: {e}"))?;
        let start = 8 + size;
        let held = length - start;
        if header.data_len() as u64 != held {
            return Err(format!("its header tells {} bytes, and {held} follow", header.data_len()));
        }
        Ok(Self { file, length, start, header })
    }

    /// Goes to an array, and gives the number of its bytes.
    fn go_to(&mut self, name: &str, dtype: Dtype) -> std::result::Result<usize, String> {
        let info = self.header.info(name).ok_or_else(|| format!("`{name}` is missing"))?;
        if info.dtype != dtype {
            return Err(format!("`{name}` holds {:?}, expected {dtype:?}", info.dtype));
        }
        let (from, to) = info.data_offsets;
        let count = info.shape.iter().try_fold(dtype.bitsize() / 8, |bytes, &n| bytes.checked_mul(n));
        // Whatever the header says, no array is longer than the file.
        if to.checked_sub(from) != count || to as u64 > self.length - self.start {
            return Err(format!("`{name}` of shape {:?} stands at bytes {from} to {to}", info.shape));
        }
        let at = SeekFrom::Start(self.start + from as u64);
        self.file.seek(at).map_err(|e| format!("`{name}`: {e}"))?;
        Ok(to - from)
    }
}

fn from_arrays(mut file: Arrays, saved: &SavedBrick) -> std::result::Result<(Brick, Option<Plate>), String> {
    let mut model = unfilled(saved, usize::try_from(file.length).unwrap_or(usize::MAX))?;
    for mut array in arrays(&mut model, Content::Avatar) {
        let dtype = match array.numbers {
            Numbers::Floats(_) => Dtype::F32,
            Numbers::Counts(_) => Dtype::U32,
            Numbers::Bytes(_) => Dtype::U8,
        };
        let bytes = file.go_to(&array.name, dtype)?;
        fill(&mut array, bytes, &mut file.file)?;
    }
    let plate = match saved.plate {
        Some([width, height]) => {
            let bytes = file.go_to("plate", Dtype::U8)?;
            let rgb = read_numbers(bytes, &mut file.file).map_err(|e| format!("`plate`: {e}"))?;
            (bytes == width as usize * height as usize * 3).then_some(Plate { width, height, rgb })
        }
        None => None,
    };
    Ok((ready(model, saved, Content::Avatar)?, plate))
}
