//! `transforms.json` and pictures: nerfstudio's and instant-ngp's layout.

use std::collections::BTreeMap;
use std::path::Path;

use glam::{DMat3, DVec3};
use risorius_formats::nerfies::Dataset;
use risorius_formats::pose_report::write_json;
use risorius_formats::{Camera, Isometry, Reporter};
use serde::Serialize;

use super::{attributes_of, copy_images, image_name};
use crate::error::Result;

/// The file that makes a folder of this layout.
pub const TRANSFORMS_FILE: &str = "transforms.json";

/// The whole file as it is written; what is read is wider, see `import::transforms`.
#[derive(Serialize)]
struct TransformsFile {
    camera_model: String,
    frames: Vec<TransformsFrame>,
    train_filenames: Vec<String>,
    val_filenames: Vec<String>,
    test_filenames: Vec<String>,
}

/// One picture.
#[derive(Serialize)]
struct TransformsFrame {
    file_path: String,
    w: u32,
    h: u32,
    fl_x: f64,
    fl_y: f64,
    cx: f64,
    cy: f64,
    k1: f64,
    k2: f64,
    k3: f64,
    p1: f64,
    p2: f64,
    transform_matrix: [[f64; 4]; 4],
    #[serde(skip_serializing_if = "Option::is_none")]
    time_id: Option<u32>,
    /// Attribute −1..1 by name; other programs pass it by.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    attributes: BTreeMap<String, f32>,
}

/// OpenCV's camera axes to OpenGL's and back: y and z turn round.
pub(crate) const FLIP: DMat3 = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));

/// `world_from_camera` with OpenGL's camera axes: x right, y up, z backwards.
pub fn opengl_world_from_camera(camera: &Camera) -> [[f64; 4]; 4] {
    let pose = camera.camera_from_world;
    let rotation = pose.rotation.transpose() * FLIP;
    let rows = Isometry::new(rotation, camera.center()).to_rows();
    [rows[0], rows[1], rows[2], [0.0, 0.0, 0.0, 1.0]]
}

/// Writes the layout into `out`.
pub(super) fn write(dataset: &Dataset, dir: &Path, out: &Path, reporter: &dyn Reporter) -> Result<()> {
    let scale = copy_images(dataset, dir, out, reporter)?;
    let values = attributes_of(dataset);
    let mut frames = Vec::with_capacity(dataset.ids.len());
    for id in &dataset.ids {
        let camera = dataset.cameras[id].reduced(scale);
        let k = camera.intrinsics;
        let own = id.parse().ok().and_then(|n: u32| values.get(&n));
        let attributes = own
            .into_iter()
            .flatten()
            .map(|(&c, &v)| (dataset.mapping.get(c).cloned().unwrap_or_else(|| c.to_string()), v));
        frames.push(TransformsFrame {
            file_path: image_name(id),
            w: k.width,
            h: k.height,
            fl_x: k.fx,
            fl_y: k.fy,
            cx: k.cx,
            cy: k.cy,
            k1: k.distortion.radial[0],
            k2: k.distortion.radial[1],
            k3: k.distortion.radial[2],
            p1: k.distortion.tangential[0],
            p2: k.distortion.tangential[1],
            transform_matrix: opengl_world_from_camera(&camera),
            time_id: dataset.source_frame(id),
            attributes: attributes.collect(),
        });
    }
    let names = |ids: &[String]| ids.iter().map(|id| image_name(id)).collect::<Vec<_>>();
    let file = TransformsFile {
        camera_model: "OPENCV".to_owned(),
        frames,
        train_filenames: names(&dataset.train_ids),
        val_filenames: names(&dataset.val_ids),
        test_filenames: names(&dataset.val_ids),
    };
    Ok(write_json(out.join(TRANSFORMS_FILE), &file)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use risorius_formats::Intrinsics;

    #[test]
    fn opengl_cameras_look_along_minus_z_with_y_up() {
        let pose = Isometry::from_wxyz([0.9, 0.1, -0.3, 0.2], DVec3::new(0.3, -0.2, 4.0));
        let camera = Camera { intrinsics: Intrinsics::pinhole(64, 48, 50.0), camera_from_world: pose };
        let m = opengl_world_from_camera(&camera);
        let column = |j: usize| DVec3::new(m[0][j], m[1][j], m[2][j]);
        let forward = camera.ray_direction(glam::DVec2::new(32.0, 24.0)).unwrap();
        assert!((column(2) + forward).length() < 1e-12 && (column(3) - camera.center()).length() < 1e-12);
        // A point above the optical axis (OpenGL: +y) lands in the upper half of the picture.
        let above = camera.center() + forward * 2.0 + column(1) * 0.3;
        assert!(camera.project(above).y < 24.0);
        assert!((column(0).cross(column(1)) - column(2)).length() < 1e-12 && m[3] == [0.0, 0.0, 0.0, 1.0]);
    }
}
