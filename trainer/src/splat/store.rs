//! The Gaussian field on disk, in safetensors files that any tool reads. What is not finite is neither written nor read.
//!
//! `model.safetensors` (n Gaussians, unused slots with an opacity of −30; g groups of 16 of them that carry deltas; b bases:
//! AUs, then numbers of a latent code):
//!
//! | array | type, shape | |
//! |---|---|---|
//! | `mean` | f32 `[n, 3]` | metres, origin in the head's middle |
//! | `log_scale`, `quaternion` | f16 `[n, 3]`, `[n, 4]` | metres; w, x, y, z, not normalised |
//! | `opacity` | f16 `[n]` | before the logistic function |
//! | `color`, `sh1` | f16 `[n, 3]`, `[n, 9]` | 0–1; degree 1 in the order y, z, x, each red, green, blue |
//! | `membership` | f16 `[n, 3]` | logit of belonging to each region |
//! | `head_weight` | f16 `[n]` | how much of the head's motion it follows |
//! | `deltas`, `delta_scales` | i8 `[g, b, 6, 16]`, f16 `[g, b, 2]` | see [`super::quantise`] |
//! | `gates` | f16 `[g, 3, 16]` | how far the AUs of each region reach it |
//! | `plate` | u8 `[height, width, 3]` | what is behind a head before a still camera |

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::Path;

use risorius_formats::{FormatError, atomic};
use risorius_splat::model::{DELTAS, LANES, REGIONS, channel};
use risorius_splat::{Gaussians, Layout};
use safetensors::tensor::{Dtype, SafeTensors};
use serde::{Deserialize, Serialize};

use super::plate::Plate;
use super::quantise::{from_bytes, from_half, to_bytes, to_half};
use super::space::MetricSpace;
use crate::bounds;
use crate::error::Result;
use crate::saved::damaged;

/// The Gaussian field without its numbers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SavedSplat {
    /// AUs, regions, latent code.
    pub layout: Layout,
    /// Groups of 16 Gaussians.
    pub groups: usize,
    /// Of these, the groups that carry deltas; they come first.
    pub deformable: usize,
    /// The Gaussians' space.
    pub space: MetricSpace,
    /// Whether intensities were fitted, rather than attributes, which end at 80 % of the strongest.
    pub intensities: bool,
    /// Size of the picture behind everything, if it is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plate: Option<[u32; 2]>,
}

/// Arrays with a name for each of their parts: a stretch of base channels.
const BASE: [(&str, usize, usize); 5] = [
    ("log_scale", channel::LOG_SCALE, 3),
    ("quaternion", channel::QUATERNION, 4),
    ("opacity", channel::OPACITY, 1),
    ("color", channel::COLOR, 3),
    ("sh1", channel::SH1, 9),
];

type Problem<T> = std::result::Result<T, String>;

/// An array on its way to a file.
pub(super) struct Stored<'a> {
    pub(super) dtype: Dtype,
    pub(super) shape: Vec<usize>,
    pub(super) bytes: Cow<'a, [u8]>,
}

impl<'a> Stored<'a> {
    /// f32 numbers as they lie in memory.
    pub(super) fn floats(values: &'a [f32], shape: Vec<usize>) -> Self {
        // The file is little-endian: there, what lies in memory is what goes to the disk, without a copy.
        let bytes = if cfg!(target_endian = "little") {
            Cow::Borrowed(bytemuck::cast_slice(values))
        } else {
            values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>().into()
        };
        Self { dtype: Dtype::F32, shape, bytes }
    }

    fn owned(dtype: Dtype, shape: Vec<usize>, bytes: Vec<u8>) -> Self {
        Self { dtype, shape, bytes: bytes.into() }
    }
}

impl safetensors::View for Stored<'_> {
    fn dtype(&self) -> Dtype {
        self.dtype
    }

    fn shape(&self) -> &[usize] {
        &self.shape
    }

    fn data(&self) -> Cow<'_, [u8]> {
        Cow::Borrowed(&self.bytes)
    }

    fn data_len(&self) -> usize {
        self.bytes.len()
    }
}

/// Writes arrays, whole or not at all.
pub(super) fn write_arrays(path: &Path, arrays: Vec<(String, Stored<'_>)>) -> Result<()> {
    let io = |e: std::io::Error| FormatError::io(path, "write", &e);
    // The crate writes a private file of its own beside ours first, which would stay behind a killed process.
    atomic::write_file_by(path, |staged| {
        safetensors::serialize_to_file(arrays, None, staged).map_err(|e| match e {
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

/// Fails where a number is not finite.
pub(super) fn check_finite(name: &str, values: &[f32]) -> Problem<()> {
    match values.iter().find(|v| !v.is_finite()) {
        Some(bad) => Err(format!("`{name}` holds {bad}")),
        None => Ok(()),
    }
}

/// Channels of `[group][of][16]` as rows of a Gaussian each.
fn rows(values: &[f32], of: usize, first: usize, count: usize) -> impl Iterator<Item = f32> {
    let groups = values.len() / (of * LANES);
    (0..groups * LANES)
        .flat_map(move |i| (first..first + count).map(move |c| values[(i / LANES * of + c) * LANES + i % LANES]))
}

/// The inverse of [`rows`].
fn set_rows(values: &mut [f32], of: usize, first: usize, count: usize, from: &[f32]) {
    for (i, row) in from.chunks_exact(count).enumerate() {
        for (c, v) in row.iter().enumerate() {
            values[(i / LANES * of + first + c) * LANES + i % LANES] = *v;
        }
    }
}

/// Writes what rendering needs of a model, with the plate if there is one.
pub fn write(path: &Path, model: &Gaussians, plate: Option<&Plate>) -> Result<()> {
    let arrays = encoded(model, plate).map_err(|problem| damaged(path, &format!("{problem}: nothing is written")))?;
    write_arrays(path, arrays)
}

fn encoded<'a>(model: &Gaussians, plate: Option<&'a Plate>) -> Problem<Vec<(String, Stored<'a>)>> {
    let parts = [&model.base, &model.deltas, &model.gates, &model.membership, &model.head_weight];
    for (name, values) in ["base", "deltas", "gates", "membership", "head_weight"].into_iter().zip(parts) {
        check_finite(name, values)?;
    }
    let n = model.groups() * LANES;
    let shape = |count: usize| if count == 1 { vec![n] } else { vec![n, count] };
    let mean: Vec<u8> = rows(&model.base, channel::COUNT, channel::MEAN, 3).flat_map(f32::to_le_bytes).collect();
    let mut arrays = vec![("mean".to_owned(), Stored::owned(Dtype::F32, shape(3), mean))];
    let mut half = |name: &str, shape: Vec<usize>, values: &mut dyn Iterator<Item = f32>| {
        let bytes = to_half(values);
        check_finite(name, &from_half(&bytes))?;
        arrays.push((name.to_owned(), Stored::owned(Dtype::F16, shape, bytes)));
        Ok::<(), String>(())
    };
    for (name, first, count) in BASE {
        half(name, shape(count), &mut rows(&model.base, channel::COUNT, first, count))?;
    }
    half("membership", vec![n, REGIONS], &mut rows(&model.membership, REGIONS, 0, REGIONS))?;
    half("head_weight", vec![n], &mut model.head_weight.iter().copied())?;
    let (g, b) = (model.deformable, model.layout.bases());
    half("gates", vec![g, REGIONS, LANES], &mut model.gates.iter().copied())?;
    let (bytes, scales) = to_bytes(&model.deltas);
    half("delta_scales", vec![g, b, 2], &mut scales.iter().copied())?;
    arrays.push(("deltas".to_owned(), Stored::owned(Dtype::I8, vec![g, b, DELTAS, LANES], bytes)));
    if let Some(plate) = plate {
        let shape = vec![plate.height as usize, plate.width as usize, 3];
        arrays.push(("plate".to_owned(), Stored { dtype: Dtype::U8, shape, bytes: Cow::Borrowed(&plate.rgb) }));
    }
    Ok(arrays)
}

/// Reads what [`write()`] wrote.
pub fn read(path: &Path, saved: &SavedSplat) -> Result<(Gaussians, Option<Plate>)> {
    let bytes = std::fs::read(path).map_err(|e| FormatError::io(path, "read", &e))?;
    let tensors = SafeTensors::deserialize(&bytes).map_err(|e| damaged(path, &e))?;
    bounds::of_splat(saved, bytes.len())
        .and_then(|()| decoded(&tensors, saved))
        .map_err(|problem| damaged(path, &problem))
}

/// The bytes of an array of a type and shape.
fn bytes_of<'a>(tensors: &'a SafeTensors<'_>, name: &str, dtype: Dtype, shape: &[usize]) -> Problem<&'a [u8]> {
    let tensor = tensors.tensor(name).map_err(|e| format!("`{name}`: {e}"))?;
    if tensor.dtype() != dtype || tensor.shape() != shape {
        let (found, of) = (tensor.shape().to_vec(), tensor.dtype());
        return Err(format!("`{name}` has shape {found:?} of {of:?}, expected {shape:?} of {dtype:?}"));
    }
    // The tensor's own view ends with this function, its bytes with the file's.
    Ok(tensor.data())
}

fn decoded(tensors: &SafeTensors<'_>, saved: &SavedSplat) -> Problem<(Gaussians, Option<Plate>)> {
    let n = saved.groups * LANES;
    let (g, b) = (saved.deformable, saved.layout.bases());
    let half = |name: &str, shape: &[usize]| {
        let values = from_half(bytes_of(tensors, name, Dtype::F16, shape)?);
        check_finite(name, &values).map(|()| values)
    };
    let mut base = vec![0.0; n * channel::COUNT];
    let mean = floats(bytes_of(tensors, "mean", Dtype::F32, &[n, 3])?);
    check_finite("mean", &mean)?;
    set_rows(&mut base, channel::COUNT, channel::MEAN, 3, &mean);
    for (name, first, count) in BASE {
        let shape = [n, count];
        let values = half(name, if count == 1 { &shape[..1] } else { &shape })?;
        set_rows(&mut base, channel::COUNT, first, count, &values);
    }
    let mut membership = vec![0.0; n * REGIONS];
    set_rows(&mut membership, REGIONS, 0, REGIONS, &half("membership", &[n, REGIONS])?);
    let scales = half("delta_scales", &[g, b, 2])?;
    let deltas = from_bytes(bytes_of(tensors, "deltas", Dtype::I8, &[g, b, DELTAS, LANES])?, &scales);
    check_finite("deltas", &deltas)?;
    let plate = match saved.plate {
        Some([width, height]) => {
            let rgb = bytes_of(tensors, "plate", Dtype::U8, &[height as usize, width as usize, 3])?.to_vec();
            Some(Plate { width, height, rgb })
        }
        None => None,
    };
    let gates = half("gates", &[g, REGIONS, LANES])?;
    let head_weight = half("head_weight", &[n])?;
    let model = Gaussians::from_arrays(saved.layout.clone(), base, deltas, gates, membership, head_weight)?;
    Ok((model, plate))
}

/// Little-endian f32 numbers.
pub(super) fn floats(bytes: &[u8]) -> Vec<f32> {
    bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
}

/// Every array of a file of f32 numbers, by its name.
pub(super) fn read_floats(path: &Path) -> Result<BTreeMap<String, Vec<f32>>> {
    let bytes = std::fs::read(path).map_err(|e| FormatError::io(path, "read", &e))?;
    let tensors = SafeTensors::deserialize(&bytes).map_err(|e| damaged(path, &e))?;
    let read = |(name, view): (String, safetensors::tensor::TensorView<'_>)| {
        let values = match view.dtype() {
            Dtype::F32 => floats(view.data()),
            other => return Err(format!("`{name}` holds {other:?}, expected F32")),
        };
        check_finite(&name, &values).map(|()| (name, values))
    };
    tensors.tensors().into_iter().map(read).collect::<Problem<_>>().map_err(|problem| damaged(path, &problem))
}

#[cfg(test)]
#[path = "store_tests.rs"]
mod tests;
