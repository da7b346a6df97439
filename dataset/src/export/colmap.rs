//! A COLMAP model and pictures: for COLMAP itself and the many programs that read its models.

use std::path::Path;

use risorius_formats::colmap::{self, Model, ModelCamera, ModelImage};
use risorius_formats::nerfies::{self, Dataset};
use risorius_formats::{ErrorKind, FormatError, Reporter};

use super::copy_images;
use crate::error::Result;

/// Where the pictures lie.
pub const IMAGES_DIR: &str = "images";
/// Where the model lies.
pub const SPARSE_DIR: &str = "sparse/0";

/// Writes the layout into `out`: cameras at the pictures' size, no 3-D points.
pub(super) fn write(dataset: &Dataset, dir: &Path, out: &Path, reporter: &dyn Reporter) -> Result<()> {
    let scale = copy_images(dataset, dir, out, reporter)?;
    let mut model = Model::default();
    let mut lenses: Vec<ModelCamera> = Vec::new();
    for (number, id) in (1..).zip(&dataset.ids) {
        let camera = dataset.cameras[id].reduced(scale);
        if camera.intrinsics.skew != 0.0 {
            return Err(FormatError::new(ErrorKind::Unsupported, "COLMAP has no lens with skew")
                .in_file(nerfies::camera_path(dir, id))
                .with_hint("export to another layout")
                .into());
        }
        let lens = ModelCamera::from_intrinsics(&camera.intrinsics);
        let place = lenses.iter().position(|l| *l == lens).unwrap_or_else(|| {
            lenses.push(lens);
            lenses.len() - 1
        });
        let image = ModelImage {
            camera_from_world: camera.camera_from_world,
            camera_id: place as u32 + 1,
            name: format!("{id}.png"),
            points: Vec::new(),
        };
        model.images.insert(number, image);
    }
    model.cameras = (1..).zip(lenses).collect();
    Ok(colmap::write_text(out.join(SPARSE_DIR), &model)?)
}
