//! An avatar's Gaussians at one expression as files that other programs open: `.ply`, `.splat`, `.spz`.
//!
//! None of the three formats has a place for AU deltas. Viewers add their own low-pass: 3D Gaussian splatting's adds
//! 0.3 px² without compensation, the fit 0.1 px² with compensated opacity, so thin Gaussians look a little broader and
//! brighter there (`docs/sharing.md` has the figure). `.spz` has a flag for it, `.ply` a comment.

use std::path::{Path, PathBuf};

use risorius_formats::{FormatError, atomic};
use serde::Serialize;

use super::{cloud, dot_splat, ply, spz};
use crate::avatar::Avatar;
use crate::error::{Result, TrainerError};
use crate::expression::Expression;

/// The layout of a file of Gaussians.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum SplatFormat {
    /// 3D Gaussian splatting's `.ply`.
    Ply,
    /// 32-byte rows without spherical harmonics.
    Splat,
    /// Niantic's `.spz`, version 2.
    Spz,
}

/// What was written.
#[derive(Clone, Debug, Serialize)]
pub struct SplatSummary {
    /// The file.
    pub file: PathBuf,
    /// Its layout.
    pub format: SplatFormat,
    /// Gaussians.
    pub gaussians: usize,
    /// Bytes.
    pub bytes: usize,
}

/// Writes the Gaussians of `expression` to `file`; with `head_only`, those that do not follow the head are left out.
pub fn export_gaussians(
    avatar: &Avatar,
    format: SplatFormat,
    expression: &Expression,
    head_only: bool,
    file: &Path,
) -> Result<SplatSummary> {
    let field = cloud::gaussians_of(avatar)?;
    let rows = cloud::rows(field, expression, head_only);
    if rows.is_empty() {
        return Err(TrainerError::Setting {
            message: "no Gaussian is left to write".to_owned(),
            hint: if head_only { "leave `--head-only` out" } else { "look at the avatar with `trainer view`" }
                .to_owned(),
        });
    }
    let bytes = match format {
        SplatFormat::Ply => ply::encode(&rows),
        SplatFormat::Splat => dot_splat::encode(&rows, cloud::own_eye(field, &avatar.saved)),
        SplatFormat::Spz => spz::encode(&rows).map_err(|e| FormatError::io(file, "compress", &e))?,
    };
    atomic::write_file(file, &bytes)?;
    Ok(SplatSummary { file: file.to_owned(), format, gaussians: rows.len(), bytes: bytes.len() })
}
