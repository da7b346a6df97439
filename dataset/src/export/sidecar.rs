//! The folder `risorius/` of an export: what its layout cannot express.

use std::path::Path;

use risorius_formats::intensities;
use risorius_formats::nerfies::{self, Dataset};

use super::{copy, copy_cameras, make};
use crate::error::Result;
use crate::provenance::TAKES_FILE;

/// The folder's name.
pub const SIDECAR_DIR: &str = "risorius";

/// Writes ids, splits, scene, attributes, outlines and masks of `scales` beside the export in `out`.
pub(super) fn write(dataset: &Dataset, dir: &Path, scales: &[u32], out: &Path) -> Result<()> {
    let out = out.join(SIDECAR_DIR);
    dataset.write(&out)?;
    copy_cameras(dataset, dir, &out)?;
    make(&out.join("report"))?;
    for name in ["attributes.toml", intensities::FILE, TAKES_FILE, "report/settings.toml"] {
        if dir.join(name).is_file() {
            copy(&dir.join(name), &out.join(name))?;
        }
    }
    for id in &dataset.ids {
        let mut pairs = vec![(nerfies::polygons_path(dir, id), nerfies::polygons_path(&out, id))];
        for &s in scales {
            pairs.push((nerfies::region_path(dir, s, id), nerfies::region_path(&out, s, id)));
            pairs.push((nerfies::valid_path(dir, s, id), nerfies::valid_path(&out, s, id)));
            pairs.push((nerfies::head_path(dir, s, id), nerfies::head_path(&out, s, id)));
        }
        for (from, to) in pairs.into_iter().filter(|(from, _)| from.is_file()) {
            to.parent().map_or(Ok(()), make)?;
            copy(&from, &to)?;
        }
    }
    Ok(())
}
