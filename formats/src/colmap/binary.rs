//! COLMAP's binary layout (little-endian): a 64-bit count, then the records one after the other.
//!
//! ```text
//! cameras.bin   u64 n, n × { u32 id, i32 model, u64 width, u64 height, f64 params[by model] }
//! images.bin    u64 n, n × { u32 id, f64 qw qx qy qz, f64 tx ty tz, u32 camera id, name until NUL,
//!                            u64 m, m × { f64 x, f64 y, u64 point id (all ones: none) } }
//! points3D.bin  u64 n, n × { u64 id, f64 x y z, u8 r g b, f64 error, u64 m, m × { u32 image id, u32 feature } }
//! ```

use std::collections::BTreeMap;

use glam::DVec3;

use super::camera_model::{CameraModel, wrong_param_count};
use super::{ModelCamera, ModelImage, Point2d, Point3d, insert_new, pose};
use crate::{ErrorKind, FormatError, Result};

/// The point id that means none.
const NO_POINT: u64 = u64::MAX;

/// Takes values from the front and knows where it is.
struct Cursor<'a> {
    bytes: &'a [u8],
    position: usize,
}

impl<'a> Cursor<'a> {
    fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, position: 0 }
    }

    fn rest(&self) -> &'a [u8] {
        &self.bytes[self.position..]
    }

    fn fail(&self, kind: ErrorKind, message: &str) -> FormatError {
        FormatError::new(kind, format!("byte {}: {message}", self.position))
    }

    fn array<const N: usize>(&mut self, what: &str) -> Result<[u8; N]> {
        let Some(chunk) = self.rest().first_chunk::<N>() else {
            return Err(self
                .fail(ErrorKind::Syntax, &format!("the file ends within {what}"))
                .with_hint("the file is cut off; export the model again"));
        };
        self.position += N;
        Ok(*chunk)
    }

    fn u32(&mut self, what: &str) -> Result<u32> {
        self.array(what).map(u32::from_le_bytes)
    }

    fn u64(&mut self, what: &str) -> Result<u64> {
        self.array(what).map(u64::from_le_bytes)
    }

    fn any_f64(&mut self, what: &str) -> Result<f64> {
        self.array(what).map(f64::from_le_bytes)
    }

    fn f64(&mut self, what: &str) -> Result<f64> {
        let start = self.position;
        let value = self.any_f64(what)?;
        if value.is_finite() {
            Ok(value)
        } else {
            self.position = start;
            Err(self.fail(ErrorKind::Syntax, &format!("expected a finite number for {what}, found `{value}`")))
        }
    }

    fn f64s<const N: usize>(&mut self, what: &str) -> Result<[f64; N]> {
        let mut out = [0.0; N];
        for value in &mut out {
            *value = self.f64(what)?;
        }
        Ok(out)
    }

    /// A count of records of at least `size` bytes each; one that the rest of the file cannot hold is refused before
    /// anything is allocated for it.
    fn count(&mut self, what: &str, size: usize) -> Result<usize> {
        let start = self.position;
        let count = self.u64(&format!("the number of {what}"))?;
        let room = self.rest().len() / size;
        match usize::try_from(count) {
            Ok(n) if n <= room => Ok(n),
            _ => {
                self.position = start;
                let message = format!("`{count}` {what} do not fit into the rest of the file");
                Err(self
                    .fail(ErrorKind::Limits, &message)
                    .with_hint("the file is cut off or not a COLMAP model; export the model again"))
            }
        }
    }

    fn name(&mut self) -> Result<String> {
        let Some(length) = self.rest().iter().position(|&b| b == 0) else {
            return Err(self
                .fail(ErrorKind::Syntax, "the file ends within an image name")
                .with_hint("the file is cut off; export the model again"));
        };
        let name = std::str::from_utf8(&self.rest()[..length])
            .map_err(|_| self.fail(ErrorKind::Syntax, "the image name is not UTF-8 text"))?;
        self.position += length + 1;
        Ok(name.to_owned())
    }

    fn finish(&self) -> Result<()> {
        match self.rest().len() {
            0 => Ok(()),
            n => Err(self.fail(ErrorKind::Syntax, &format!("{n} bytes follow the last record"))),
        }
    }
}

/// Adds `byte N` to an error that knows no place.
fn at<T>(start: usize, result: Result<T>) -> Result<T> {
    result.map_err(|e| {
        let located = FormatError::new(e.kind(), format!("byte {start}: {e}"));
        match crate::Hint::hint(&e) {
            Some(hint) => located.with_hint(hint.into_owned()),
            None => located,
        }
    })
}

/// Parses `cameras.bin`. A camera model without a known id is an error: its length is unknown.
pub fn parse_cameras_binary(bytes: &[u8]) -> Result<BTreeMap<u32, ModelCamera>> {
    let mut cursor = Cursor::new(bytes);
    let mut cameras = BTreeMap::new();
    for _ in 0..cursor.count("cameras", 24)? {
        let start = cursor.position;
        let id = cursor.u32("a camera id")?;
        let model_start = cursor.position;
        let model_id = cursor.array("a camera model").map(i32::from_le_bytes)?;
        let Some(model) = CameraModel::by_id(model_id) else {
            cursor.position = model_start;
            return Err(cursor
                .fail(ErrorKind::Unsupported, &format!("`{model_id}` is no known camera model"))
                .with_hint("write the model as text with `colmap model_converter --input_path DIR --output_path DIR --output_type TXT`"));
        };
        let (width, height) = (cursor.u64("an image width")?, cursor.u64("an image height")?);
        let params = (0..model.param_count).map(|_| cursor.f64("a camera parameter")).collect::<Result<_>>()?;
        let camera = ModelCamera { model: model.name.to_owned(), width, height, params };
        at(start, insert_new(&mut cameras, "camera", id, camera))?;
    }
    cursor.finish()?;
    Ok(cameras)
}

/// Parses `images.bin`.
pub fn parse_images_binary(bytes: &[u8]) -> Result<BTreeMap<u32, ModelImage>> {
    let mut cursor = Cursor::new(bytes);
    let mut images = BTreeMap::new();
    for _ in 0..cursor.count("images", 73)? {
        let start = cursor.position;
        let id = cursor.u32("an image id")?;
        let pose_start = cursor.position;
        let (wxyz, translation) = (cursor.f64s("a rotation")?, cursor.f64s("a translation")?);
        let camera_from_world = at(pose_start, pose(wxyz, translation))?;
        let camera_id = cursor.u32("a camera id")?;
        let name = cursor.name()?;
        let count = cursor.count("features", 24)?;
        let mut points = Vec::with_capacity(count);
        for _ in 0..count {
            let position_px = cursor.f64s("a feature")?;
            let point3d = Some(cursor.u64("a point id")?).filter(|&id| id != NO_POINT);
            points.push(Point2d { position_px, point3d });
        }
        at(start, insert_new(&mut images, "image", id, ModelImage { camera_from_world, camera_id, name, points }))?;
    }
    cursor.finish()?;
    Ok(images)
}

/// Parses `points3D.bin`.
pub fn parse_points_binary(bytes: &[u8]) -> Result<BTreeMap<u64, Point3d>> {
    let mut cursor = Cursor::new(bytes);
    let mut points = BTreeMap::new();
    for _ in 0..cursor.count("points", 51)? {
        let start = cursor.position;
        let id = cursor.u64("a point id")?;
        let position = DVec3::from_array(cursor.f64s("a position")?);
        let rgb = cursor.array("a colour")?;
        let error_px = cursor.any_f64("an error")?;
        let count = cursor.count("observations", 8)?;
        let track = (0..count)
            .map(|_| Ok((cursor.u32("an observation")?, cursor.u32("an observation")?)))
            .collect::<Result<_>>()?;
        at(start, insert_new(&mut points, "point", id, Point3d { position, rgb, error_px, track }))?;
    }
    cursor.finish()?;
    Ok(points)
}

fn put_f64s(out: &mut Vec<u8>, values: &[f64]) {
    out.extend(values.iter().flat_map(|v| v.to_le_bytes()));
}

fn put_count(out: &mut Vec<u8>, count: usize) {
    out.extend((count as u64).to_le_bytes());
}

/// The bytes of `cameras.bin`; an error for a camera model that COLMAP did not have yet.
pub fn cameras_to_binary(cameras: &BTreeMap<u32, ModelCamera>) -> Result<Vec<u8>> {
    let mut out = Vec::new();
    put_count(&mut out, cameras.len());
    for (id, camera) in cameras {
        let model = CameraModel::by_name(&camera.model).ok_or_else(|| {
            let message = format!("camera model `{}` has no number in binary models", camera.model);
            FormatError::new(ErrorKind::Unsupported, message).with_hint("write a text model instead")
        })?;
        if model.param_count != camera.params.len() {
            return Err(wrong_param_count(model.name, camera.params.len()));
        }
        out.extend(id.to_le_bytes());
        out.extend(model.id.to_le_bytes());
        out.extend(camera.width.to_le_bytes());
        out.extend(camera.height.to_le_bytes());
        put_f64s(&mut out, &camera.params);
    }
    Ok(out)
}

/// The bytes of `images.bin`; an error for a name with a NUL in it.
pub fn images_to_binary(images: &BTreeMap<u32, ModelImage>) -> Result<Vec<u8>> {
    let mut out = Vec::new();
    put_count(&mut out, images.len());
    for (id, image) in images {
        if image.name.contains('\0') {
            let message = format!("`{:?}` cannot be an image name in a binary model", image.name);
            return Err(FormatError::new(ErrorKind::Unsupported, message));
        }
        out.extend(id.to_le_bytes());
        put_f64s(&mut out, &image.camera_from_world.to_wxyz());
        put_f64s(&mut out, &image.camera_from_world.translation.to_array());
        out.extend(image.camera_id.to_le_bytes());
        out.extend(image.name.as_bytes());
        out.push(0);
        put_count(&mut out, image.points.len());
        for point in &image.points {
            put_f64s(&mut out, &point.position_px);
            out.extend(point.point3d.unwrap_or(NO_POINT).to_le_bytes());
        }
    }
    Ok(out)
}

/// The bytes of `points3D.bin`.
pub fn points_to_binary(points: &BTreeMap<u64, Point3d>) -> Vec<u8> {
    let mut out = Vec::new();
    put_count(&mut out, points.len());
    for (id, point) in points {
        out.extend(id.to_le_bytes());
        put_f64s(&mut out, &point.position.to_array());
        out.extend(point.rgb);
        out.extend(point.error_px.to_le_bytes());
        put_count(&mut out, point.track.len());
        for (image, feature) in &point.track {
            out.extend(image.to_le_bytes());
            out.extend(feature.to_le_bytes());
        }
    }
    out
}
