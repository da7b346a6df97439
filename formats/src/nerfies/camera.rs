//! `camera/<id>.json`: one camera of the Nerfies family (fact sheet §3.5).
//!
//! The family holds every number as a 32-bit float, so what is written here is rounded to one first: a file that is
//! read and written again keeps its bits. Both spellings of the tangential coefficients are read, the newer is written.

use std::path::Path;

use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};

use crate::camera::Distortion;
use crate::pose_report::{json_error, write_json};
use crate::{Camera, ErrorKind, FormatError, Intrinsics, Isometry, Result};

/// Above this deviation of `RᵀR` from the identity a rotation is repaired (fact sheet §8.16); below, its bits are kept.
const REPAIR_ABOVE: f64 = 1e-4;
/// Above this deviation it is no rotation with rounding errors but something else.
const REFUSE_ABOVE: f64 = 0.1;
/// Numbers beyond this, and their inverses, come from damage, whatever the unit.
const LARGEST: f64 = 1e12;
/// No camera has more pixels along a side.
const MAX_SIDE_PX: f64 = 1e6;

#[derive(Serialize, Deserialize)]
struct CameraFile {
    orientation: [[f64; 3]; 3],
    position: [f64; 3],
    focal_length: f64,
    principal_point: [f64; 2],
    #[serde(default)]
    skew: f64,
    #[serde(default = "one")]
    pixel_aspect_ratio: f64,
    #[serde(default)]
    radial_distortion: Vec<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    tangential_distortion: Option<Vec<f64>>,
    #[serde(default, skip_serializing)]
    tangential: Option<Vec<f64>>,
    image_size: [f64; 2],
}

/// What is written: the sizes are whole numbers.
#[derive(Serialize)]
struct Written {
    orientation: [[f64; 3]; 3],
    position: [f64; 3],
    focal_length: f64,
    principal_point: [f64; 2],
    skew: f64,
    pixel_aspect_ratio: f64,
    radial_distortion: [f64; 3],
    tangential_distortion: [f64; 2],
    image_size: [u32; 2],
}

fn one() -> f64 {
    1.0
}

fn coefficients<const N: usize>(values: &[f64], key: &str) -> Result<[f64; N]> {
    if values.len() > N {
        return Err(inconsistent(format!("`{key}` has {} numbers, at most {N} are known", values.len())));
    }
    let mut result = [0.0; N];
    result[..values.len()].copy_from_slice(values);
    Ok(result)
}

fn inconsistent(message: String) -> FormatError {
    FormatError::new(ErrorKind::Inconsistent, message)
}

fn side(value: f64) -> Result<u32> {
    if value.fract() != 0.0 || !(1.0..=MAX_SIDE_PX).contains(&value) {
        return Err(inconsistent(format!("`image_size` holds `{value}`, which is no number of pixels")));
    }
    Ok(value as u32)
}

/// The nearest rotation, by Newton's iteration for the polar factor; `None` when there is none nearby.
fn nearest_rotation(matrix: DMat3) -> Option<DMat3> {
    let mut r = matrix;
    for _ in 0..30 {
        if !(r.determinant() > 1e-3 && r.is_finite()) {
            return None;
        }
        r = (r + r.inverse().transpose()) * 0.5;
    }
    Some(r)
}

/// Parses `camera/<id>.json`.
pub fn parse_camera(bytes: &[u8]) -> Result<Camera> {
    let raw: CameraFile = serde_json::from_slice(bytes).map_err(|e| json_error(&e))?;
    let rows = raw.orientation.map(DVec3::from);
    let mut rotation = DMat3::from_cols(rows[0], rows[1], rows[2]).transpose();
    let error = Isometry::new(rotation, DVec3::ZERO).orthonormality_error();
    // Written so that a NaN, too, is refused.
    if !(error <= REFUSE_ABOVE && rotation.determinant() > 0.0) {
        return Err(inconsistent(format!("`orientation` is not a rotation: it deviates by {error:.3}"))
            .with_hint("rows are the camera's right, down and forward axes in the world"));
    }
    if error > REPAIR_ABOVE {
        rotation =
            nearest_rotation(rotation).ok_or_else(|| inconsistent("`orientation` is not a rotation".to_owned()))?;
    }
    let positive = raw.focal_length > 0.0 && raw.pixel_aspect_ratio > 0.0;
    if !positive {
        return Err(inconsistent("`focal_length` and `pixel_aspect_ratio` must be above 0".to_owned()));
    }
    let tangential = raw.tangential.or(raw.tangential_distortion).unwrap_or_default();
    let intrinsics = Intrinsics {
        width: side(raw.image_size[0])?,
        height: side(raw.image_size[1])?,
        fx: raw.focal_length,
        fy: raw.focal_length * raw.pixel_aspect_ratio,
        cx: raw.principal_point[0],
        cy: raw.principal_point[1],
        skew: raw.skew,
        distortion: Distortion {
            radial: coefficients(&raw.radial_distortion, "radial_distortion")?,
            radial_denominator: [0.0; 3],
            tangential: coefficients(&tangential, "tangential_distortion")?,
        },
    };
    let position = DVec3::from(raw.position);
    let camera = Camera { intrinsics, camera_from_world: Isometry::new(rotation, -(rotation * position)) };
    let k = &camera.intrinsics;
    let lens = [k.fx, k.fy, 1.0 / k.fx, 1.0 / k.fy, k.cx, k.cy, k.skew];
    let all = lens.into_iter().chain(camera.camera_from_world.translation.to_array());
    if let Some(bad) = all.into_iter().find(|v| !(0.0..=LARGEST).contains(&v.abs())) {
        return Err(inconsistent(format!("a focal length, position or principal point comes to {bad}")));
    }
    Ok(camera)
}

/// Reads `camera/<id>.json`.
pub fn read_camera(path: impl AsRef<Path>) -> Result<Camera> {
    let path = path.as_ref();
    let bytes = std::fs::read(path).map_err(|e| FormatError::io(path, "read", &e))?;
    parse_camera(&bytes).map_err(|e| e.in_file(path))
}

/// Writes `camera/<id>.json`, whole or not at all. An error for lenses that the format cannot express.
pub fn write_camera(path: impl AsRef<Path>, camera: &Camera) -> Result<()> {
    let path = path.as_ref();
    write_json(path, &encode(camera).map_err(|e| e.in_file(path))?)
}

fn encode(camera: &Camera) -> Result<Written> {
    let Camera { intrinsics: k, camera_from_world: pose } = camera;
    if k.distortion.radial_denominator != [0.0; 3] {
        return Err(FormatError::new(ErrorKind::Unsupported, "this format has no rational lens model (k4 to k6)")
            .with_hint("find the cameras with the OPENCV or RADIAL lens model"));
    }
    let rotation = pose.rotation;
    // The true inverse, not the transpose: a rotation of rounded numbers is orthonormal to 1e-7 only, and the position
    // that was read has to come back with all its bits.
    let position = -(rotation.inverse() * pose.translation);
    let single = |v: f64| f64::from(v as f32);
    let written = Written {
        orientation: std::array::from_fn(|i| rotation.row(i).to_array().map(single)),
        position: position.to_array().map(single),
        focal_length: single(k.fx),
        principal_point: [k.cx, k.cy].map(single),
        skew: single(k.skew),
        pixel_aspect_ratio: single(k.fy / k.fx),
        radial_distortion: k.distortion.radial.map(single),
        tangential_distortion: k.distortion.tangential.map(single),
        image_size: [k.width, k.height],
    };
    let singles = [written.focal_length, written.skew, written.pixel_aspect_ratio];
    let all = written.orientation.iter().flatten().chain(&written.position).chain(&written.principal_point);
    let all = all.chain(&written.radial_distortion).chain(&written.tangential_distortion).chain(&singles);
    if all.copied().any(|v| !v.is_finite()) {
        return Err(inconsistent("the camera has a value that is not a number".to_owned()));
    }
    Ok(written)
}

#[cfg(test)]
#[path = "camera_tests.rs"]
mod tests;
