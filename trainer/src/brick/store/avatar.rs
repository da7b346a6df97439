//! An avatar's arrays in safetensors.

use std::borrow::Cow;
use std::path::Path;

use risorius_brick::Brick;
use risorius_formats::{FormatError, atomic};
use safetensors::tensor::{Dtype, SafeTensors};

use super::{Content, Numbers, SavedBrick, arrays, check_finite, fill, ready, untrained};
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

/// Reads what [`write()`] wrote.
pub fn read(path: &Path, saved: &SavedBrick) -> Result<(Brick, Option<Plate>)> {
    let bytes = std::fs::read(path).map_err(|e| FormatError::io(path, "read", &e))?;
    let tensors = SafeTensors::deserialize(&bytes).map_err(|e| damaged(path, &e))?;
    from_tensors(&tensors, saved, bytes.len()).map_err(|problem| damaged(path, &problem))
}

fn from_tensors(
    tensors: &SafeTensors<'_>,
    saved: &SavedBrick,
    file_bytes: usize,
) -> std::result::Result<(Brick, Option<Plate>), String> {
    let mut model = untrained(saved, file_bytes)?;
    let take = |name: &str, dtype: Dtype| match tensors.tensor(name) {
        Ok(t) if t.dtype() == dtype => Ok(t.data()),
        Ok(t) => Err(format!("`{name}` holds {:?}, expected {dtype:?}", t.dtype())),
        Err(e) => Err(format!("`{name}`: {e}")),
    };
    for mut array in arrays(&mut model, Content::Avatar) {
        let dtype = match array.numbers {
            Numbers::Floats(_) => Dtype::F32,
            Numbers::Counts(_) => Dtype::U32,
            Numbers::Bytes(_) => Dtype::U8,
        };
        let bytes = take(&array.name, dtype)?;
        fill(&mut array, bytes)?;
    }
    let plate = match saved.plate {
        Some([width, height]) => {
            let rgb = take("plate", Dtype::U8)?.to_vec();
            (rgb.len() == width as usize * height as usize * 3).then_some(Plate { width, height, rgb })
        }
        None => None,
    };
    Ok((ready(model, saved, Content::Avatar)?, plate))
}
