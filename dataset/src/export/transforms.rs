//! `transforms.json` and pictures: nerfstudio's and instant-ngp's layout.

use std::collections::BTreeMap;
use std::path::Path;

use glam::{DMat3, DVec3};
use risorius_formats::camera::Distortion;
use risorius_formats::nerfies::Dataset;
use risorius_formats::pose_report::write_json;
use risorius_formats::{Camera, Intrinsics, Isometry, Reporter};
use serde::{Deserialize, Serialize};

use super::{attributes_of, copy_images, image_name};
use crate::error::Result;

/// The file that makes a folder of this layout.
pub const TRANSFORMS_FILE: &str = "transforms.json";

/// The whole file, as far as it concerns us.
#[derive(Serialize, Deserialize)]
pub(crate) struct TransformsFile {
    pub(crate) camera_model: String,
    pub(crate) frames: Vec<TransformsFrame>,
    #[serde(default)]
    pub(crate) train_filenames: Vec<String>,
    #[serde(default)]
    pub(crate) val_filenames: Vec<String>,
    #[serde(default)]
    pub(crate) test_filenames: Vec<String>,
}

/// One picture.
#[derive(Serialize, Deserialize)]
pub(crate) struct TransformsFrame {
    pub(crate) file_path: String,
    w: u32,
    h: u32,
    fl_x: f64,
    fl_y: f64,
    cx: f64,
    cy: f64,
    #[serde(default)]
    k1: f64,
    #[serde(default)]
    k2: f64,
    #[serde(default)]
    k3: f64,
    #[serde(default)]
    p1: f64,
    #[serde(default)]
    p2: f64,
    transform_matrix: [[f64; 4]; 4],
    #[serde(default, skip_serializing_if = "Option::is_none")]
    time_id: Option<u32>,
    /// Attribute −1..1 by name; other programs pass it by.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    attributes: BTreeMap<String, f32>,
}

impl TransformsFrame {
    /// The camera of the picture; `None` where the numbers are none.
    pub(crate) fn camera(&self) -> Option<Camera> {
        let m = &self.transform_matrix;
        let numbers = [self.fl_x, self.fl_y, self.cx, self.cy, self.k1, self.k2, self.k3, self.p1, self.p2];
        let finite = m.iter().flatten().chain(&numbers).all(|v| v.is_finite());
        if !finite || self.fl_x <= 0.0 || self.fl_y <= 0.0 || self.w == 0 || self.h == 0 {
            return None;
        }
        let row = |i: usize| DVec3::new(m[i][0], m[i][1], m[i][2]);
        // Rows of the rotation are rows of world_from_camera; the camera's y and z are turned back.
        let world_from_gl = DMat3::from_cols(row(0), row(1), row(2)).transpose();
        let camera_from_world = (world_from_gl * FLIP).transpose();
        let center = DVec3::new(m[0][3], m[1][3], m[2][3]);
        let intrinsics = Intrinsics {
            width: self.w,
            height: self.h,
            fx: self.fl_x,
            fy: self.fl_y,
            cx: self.cx,
            cy: self.cy,
            skew: 0.0,
            distortion: Distortion {
                radial: [self.k1, self.k2, self.k3],
                radial_denominator: [0.0; 3],
                tangential: [self.p1, self.p2],
            },
        };
        Some(Camera { intrinsics, camera_from_world: Isometry::new(camera_from_world, -(camera_from_world * center)) })
    }
}

/// OpenCV's camera axes to OpenGL's and back: y and z turn round.
const FLIP: DMat3 = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));

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
        // And back.
        let text = format!(
            r#"{{"file_path": "x", "w": 64, "h": 48, "fl_x": 50.0, "fl_y": 50.0, "cx": 32.0, "cy": 24.0, "transform_matrix": {m:?}}}"#
        );
        let back = serde_json::from_str::<TransformsFrame>(&text).unwrap().camera().unwrap();
        assert!((back.center() - camera.center()).length() < 1e-12 && back.intrinsics == camera.intrinsics);
        assert!((back.project(above) - camera.project(above)).length() < 1e-9);
    }
}
