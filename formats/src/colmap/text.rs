//! COLMAP's text layout: a line per camera and point, two lines per image, `#` comments.

use std::collections::BTreeMap;
use std::io::Write;
use std::str::FromStr;

use glam::DVec3;

use super::camera_model::{CameraModel, wrong_param_count};
use super::{ModelCamera, ModelImage, Point2d, Point3d, insert_new, pose};
use crate::error::shown;
use crate::{ErrorKind, FormatError, Result};

/// The lines with their 1-based numbers, without line ends.
fn lines(bytes: &[u8]) -> impl Iterator<Item = (u64, &[u8])> {
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    (1..).zip(bytes.split(|&b| b == b'\n').map(<[u8]>::trim_ascii))
}

fn is_data(line: &[u8]) -> bool {
    !line.is_empty() && line[0] != b'#'
}

fn not_text(column: &str) -> FormatError {
    FormatError::syntax("is not text")
        .in_column(column)
        .with_hint("the file is damaged or of another kind; export the model again, as text")
}

/// The fields of one line, taken from left to right.
struct Fields<'a> {
    rest: &'a [u8],
}

impl<'a> Fields<'a> {
    fn new(line: &'a [u8]) -> Self {
        Self { rest: line.trim_ascii() }
    }

    fn next(&mut self) -> Option<&'a [u8]> {
        if self.rest.is_empty() {
            return None;
        }
        let end = self.rest.iter().position(u8::is_ascii_whitespace).unwrap_or(self.rest.len());
        let (field, rest) = self.rest.split_at(end);
        self.rest = rest.trim_ascii_start();
        Some(field)
    }

    fn word(&mut self, name: &str) -> Result<&'a str> {
        let field = self.next().ok_or_else(|| {
            FormatError::syntax(format!("the line ends where {name} should stand"))
                .with_hint("the file may be cut off; export the model again")
        })?;
        std::str::from_utf8(field).map_err(|_| not_text(name))
    }

    fn integer<T: FromStr>(&mut self, name: &str) -> Result<T> {
        let word = self.word(name)?;
        word.parse().map_err(|_| {
            FormatError::syntax(format!("expected a whole number, found {}", shown(word.as_bytes()))).in_column(name)
        })
    }

    fn any_number(&mut self, name: &str) -> Result<f64> {
        let word = self.word(name)?;
        fast_float2::parse(word).map_err(|_| {
            FormatError::syntax(format!("expected a number, found {}", shown(word.as_bytes()))).in_column(name)
        })
    }

    fn number(&mut self, name: &str) -> Result<f64> {
        let value = self.any_number(name)?;
        if value.is_finite() {
            Ok(value)
        } else {
            Err(FormatError::syntax(format!("expected a finite number, found `{value}`")).in_column(name))
        }
    }

    fn numbers<const N: usize>(&mut self, names: [&str; N]) -> Result<[f64; N]> {
        let mut out = [0.0; N];
        for (value, name) in out.iter_mut().zip(names) {
            *value = self.number(name)?;
        }
        Ok(out)
    }

    fn is_done(&self) -> bool {
        self.rest.is_empty()
    }
}

/// Parses `cameras.txt`. A camera model that COLMAP did not have yet is kept as it stands.
pub fn parse_cameras_text(bytes: &[u8]) -> Result<BTreeMap<u32, ModelCamera>> {
    let mut cameras = BTreeMap::new();
    for (number, line) in lines(bytes).filter(|(_, line)| is_data(line)) {
        camera_line(line, &mut cameras).map_err(|e| e.at_line(number))?;
    }
    Ok(cameras)
}

fn camera_line(line: &[u8], cameras: &mut BTreeMap<u32, ModelCamera>) -> Result<()> {
    let mut fields = Fields::new(line);
    let id = fields.integer("CAMERA_ID")?;
    let model = fields.word("MODEL")?.to_owned();
    let (width, height) = (fields.integer("WIDTH")?, fields.integer("HEIGHT")?);
    let mut params = Vec::new();
    while !fields.is_done() {
        params.push(fields.number("PARAMS")?);
    }
    if CameraModel::by_name(&model).is_some_and(|m| m.param_count != params.len()) {
        return Err(wrong_param_count(&model, params.len()));
    }
    insert_new(cameras, "camera", id, ModelCamera { model, width, height, params })
}

/// Parses `images.txt`: two lines per image, of which the second (the features) may be blank.
pub fn parse_images_text(bytes: &[u8]) -> Result<BTreeMap<u32, ModelImage>> {
    let mut images = BTreeMap::new();
    let mut lines = lines(bytes);
    while let Some((number, line)) = lines.next() {
        if !is_data(line) {
            continue;
        }
        let (id, mut image) = image_line(line).map_err(|e| e.at_line(number))?;
        if let Some((number, line)) = lines.next() {
            image.points = feature_line(line).map_err(|e| e.at_line(number))?;
        }
        insert_new(&mut images, "image", id, image).map_err(|e| e.at_line(number))?;
    }
    Ok(images)
}

fn image_line(line: &[u8]) -> Result<(u32, ModelImage)> {
    let mut fields = Fields::new(line);
    let id = fields.integer("IMAGE_ID")?;
    let wxyz = fields.numbers(["QW", "QX", "QY", "QZ"])?;
    let translation = fields.numbers(["TX", "TY", "TZ"])?;
    let camera_id = fields.integer("CAMERA_ID")?;
    // A name may hold spaces: it is all that is left of the line.
    let name = std::str::from_utf8(fields.rest).map_err(|_| not_text("NAME"))?;
    if name.is_empty() {
        return Err(FormatError::syntax("the line ends where NAME should stand"));
    }
    let image = ModelImage {
        camera_from_world: pose(wxyz, translation)?,
        camera_id,
        name: name.to_owned(),
        points: Vec::new(),
    };
    Ok((id, image))
}

fn feature_line(line: &[u8]) -> Result<Vec<Point2d>> {
    if !is_data(line) {
        return Ok(Vec::new());
    }
    features(line).map_err(|e| {
        e.with_hint("an image has two lines, of which the second holds X, Y, POINT3D_ID of its features or is blank")
    })
}

fn features(line: &[u8]) -> Result<Vec<Point2d>> {
    let mut fields = Fields::new(line);
    let mut points = Vec::new();
    while !fields.is_done() {
        let position_px = fields.numbers(["X", "Y"])?;
        let word = fields.word("POINT3D_ID")?;
        // −1 is COLMAP's way to write the largest id, which means none.
        let point3d = match (word, word.parse::<u64>()) {
            ("-1", _) | (_, Ok(u64::MAX)) => None,
            (_, Ok(id)) => Some(id),
            (_, Err(_)) => {
                let message = format!("expected a point id or `-1`, found {}", shown(word.as_bytes()));
                return Err(FormatError::syntax(message).in_column("POINT3D_ID"));
            }
        };
        points.push(Point2d { position_px, point3d });
    }
    Ok(points)
}

/// Parses `points3D.txt`.
pub fn parse_points_text(bytes: &[u8]) -> Result<BTreeMap<u64, Point3d>> {
    let mut points = BTreeMap::new();
    for (number, line) in lines(bytes).filter(|(_, line)| is_data(line)) {
        point_line(line, &mut points).map_err(|e| e.at_line(number))?;
    }
    Ok(points)
}

fn point_line(line: &[u8], points: &mut BTreeMap<u64, Point3d>) -> Result<()> {
    let mut fields = Fields::new(line);
    let id = fields.integer("POINT3D_ID")?;
    let position = DVec3::from_array(fields.numbers(["X", "Y", "Z"])?);
    let rgb = [fields.integer("R")?, fields.integer("G")?, fields.integer("B")?];
    // COLMAP writes whatever its solver had, so that an error alone may be no finite number.
    let error_px = fields.any_number("ERROR")?;
    let mut track = Vec::new();
    while !fields.is_done() {
        track.push((fields.integer("IMAGE_ID")?, fields.integer("POINT2D_IDX")?));
    }
    insert_new(points, "point", id, Point3d { position, rgb, error_px, track })
}

/// A text file under construction; writing to memory does not fail.
struct Text(Vec<u8>);

impl Text {
    fn new(head: &str) -> Self {
        Self(head.as_bytes().to_vec())
    }

    fn put(&mut self, args: std::fmt::Arguments<'_>) {
        // A vector takes whatever it is given.
        let _ = self.0.write_fmt(args);
    }
}

/// The bytes of `cameras.txt`.
pub fn cameras_to_text(cameras: &BTreeMap<u32, ModelCamera>) -> Vec<u8> {
    let mut out =
        Text::new("# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n");
    out.put(format_args!("# Number of cameras: {}\n", cameras.len()));
    for (id, camera) in cameras {
        out.put(format_args!("{id} {} {} {}", camera.model, camera.width, camera.height));
        // Debug's digits are the fewest that read back as the same number, with an exponent where that is shorter.
        for param in &camera.params {
            out.put(format_args!(" {param:?}"));
        }
        out.put(format_args!("\n"));
    }
    out.0
}

/// The bytes of `images.txt`; an error for a name that a line cannot hold.
pub fn images_to_text(images: &BTreeMap<u32, ModelImage>) -> Result<Vec<u8>> {
    let mut out = Text::new(
        "# Image list with two lines of data per image:\n#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n#   POINTS2D[] as (X, Y, POINT3D_ID)\n",
    );
    let observations: usize = images.values().map(|i| i.points.iter().filter(|p| p.point3d.is_some()).count()).sum();
    let mean = observations as f64 / images.len().max(1) as f64;
    out.put(format_args!("# Number of images: {}, mean observations per image: {mean}\n", images.len()));
    for (id, image) in images {
        let name = &image.name;
        if name.is_empty() || name.contains(['\n', '\r', '\0']) || name.trim_ascii() != name {
            return Err(FormatError::new(
                ErrorKind::Unsupported,
                format!("`{name:?}` cannot be an image name in a text model"),
            ));
        }
        let [w, x, y, z] = image.camera_from_world.to_wxyz();
        let t = image.camera_from_world.translation;
        out.put(format_args!(
            "{id} {w:?} {x:?} {y:?} {z:?} {:?} {:?} {:?} {} {name}\n",
            t.x, t.y, t.z, image.camera_id
        ));
        for (i, point) in image.points.iter().enumerate() {
            let [x, y] = point.position_px;
            let gap = if i == 0 { "" } else { " " };
            match point.point3d {
                Some(id) => out.put(format_args!("{gap}{x:?} {y:?} {id}")),
                None => out.put(format_args!("{gap}{x:?} {y:?} -1")),
            }
        }
        out.put(format_args!("\n"));
    }
    Ok(out.0)
}

/// The bytes of `points3D.txt`.
pub fn points_to_text(points: &BTreeMap<u64, Point3d>) -> Vec<u8> {
    let mut out = Text::new(
        "# 3D point list with one line of data per point:\n#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n",
    );
    let mean = points.values().map(|p| p.track.len()).sum::<usize>() as f64 / points.len().max(1) as f64;
    out.put(format_args!("# Number of points: {}, mean track length: {mean}\n", points.len()));
    for (id, point) in points {
        let ([x, y, z], [r, g, b]) = (point.position.to_array(), point.rgb);
        out.put(format_args!("{id} {x:?} {y:?} {z:?} {r} {g} {b} {:?}", point.error_px));
        for (image, feature) in &point.track {
            out.put(format_args!(" {image} {feature}"));
        }
        out.put(format_args!("\n"));
    }
    out.0
}
