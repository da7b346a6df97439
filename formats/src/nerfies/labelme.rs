//! `annotations/<id>.json`: LabelMe polygons, in pixels of the full-size (1x) image (fact sheet §3.7).

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::raster::fill_polygon;
use crate::mask::LabelImage;
use crate::pose_report::{json_error, write_json};
use crate::{ErrorKind, FormatError, Result};

/// A closed outline with a name.
#[derive(Clone, Debug, PartialEq)]
pub struct Polygon {
    /// The attribute it belongs to; the region of a group stands under the name of the group's first AU.
    pub label: String,
    /// x, y of each corner, pixels of the 1x image.
    pub points_px: Vec<[f64; 2]>,
}

/// The polygons of one image.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Polygons {
    /// In the file's order; several with one label are united.
    pub polygons: Vec<Polygon>,
    /// The image they were drawn on, as the file states it.
    pub image_path: Option<String>,
    /// Width and height of that image, pixels, where stated.
    pub image_size: Option<[u32; 2]>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct LabelMeFile {
    #[serde(default)]
    shapes: Vec<Shape>,
    image_path: Option<String>,
    image_width: Option<u32>,
    image_height: Option<u32>,
}

#[derive(Deserialize)]
struct Shape {
    label: String,
    points: Vec<[f64; 2]>,
    #[serde(rename = "shape_type")]
    kind: Option<String>,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Written<'a> {
    version: &'static str,
    flags: Empty,
    shapes: Vec<WrittenShape<'a>>,
    image_path: &'a str,
    image_data: Option<()>,
    image_height: Option<u32>,
    image_width: Option<u32>,
}

#[derive(Serialize)]
struct WrittenShape<'a> {
    label: &'a str,
    points: &'a [[f64; 2]],
    group_id: Option<()>,
    shape_type: &'static str,
    flags: Empty,
}

#[derive(Serialize)]
struct Empty {}

/// The version of LabelMe's layout that is written.
const LABELME_VERSION: &str = "5.0.1";

impl Polygons {
    /// Parses a LabelMe file. Rectangles become polygons; shapes without an area are refused.
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        let file: LabelMeFile = serde_json::from_slice(bytes).map_err(|e| json_error(&e))?;
        let polygons = file.shapes.into_iter().enumerate().map(|(i, s)| polygon(i, s)).collect::<Result<_>>()?;
        let image_size = file.image_width.zip(file.image_height).map(|(w, h)| [w, h]);
        Ok(Self { polygons, image_path: file.image_path, image_size })
    }

    /// Reads a LabelMe file.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let bytes = std::fs::read(path).map_err(|e| FormatError::io(path, "read", &e))?;
        Self::parse(&bytes).map_err(|e| e.in_file(path))
    }

    /// Writes a LabelMe file, whole or not at all.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<()> {
        let path = path.as_ref();
        if self.polygons.iter().flat_map(|p| &p.points_px).flatten().any(|v| !v.is_finite()) {
            return Err(
                FormatError::new(ErrorKind::Inconsistent, "a polygon has a corner that is not a number").in_file(path)
            );
        }
        let shapes = self.polygons.iter().map(shape).collect();
        let file = Written {
            version: LABELME_VERSION,
            flags: Empty {},
            shapes,
            image_path: self.image_path.as_deref().unwrap_or_default(),
            image_data: None,
            image_height: self.image_size.map(|s| s[1]),
            image_width: self.image_size.map(|s| s[0]),
        };
        write_json(path, &file)
    }

    /// Paints the polygons into a label image of `width` × `height` whose pixels are `divisor` 1x pixels wide.
    ///
    /// `paint` lists (polygon label, pixel label) from the weakest to the strongest: later entries paint over
    /// earlier ones, so every pixel has one label. Polygons of other labels are left out.
    pub fn label_image(&self, paint: &[(&str, u8)], divisor: u32, width: u32, height: u32) -> LabelImage {
        let mut image = LabelImage::new(width, height);
        let scale = 1.0 / f64::from(divisor.max(1));
        for &(label, value) in paint {
            for polygon in self.polygons.iter().filter(|p| p.label == label) {
                let points: Vec<_> = polygon.points_px.iter().map(|p| p.map(|v| v * scale)).collect();
                fill_polygon(&points, width, height, |row, columns| {
                    let start = row as usize * width as usize;
                    image.labels[start + columns.start as usize..start + columns.end as usize].fill(value);
                });
            }
        }
        image
    }
}

fn shape(p: &Polygon) -> WrittenShape<'_> {
    WrittenShape { label: &p.label, points: &p.points_px, group_id: None, shape_type: "polygon", flags: Empty {} }
}

fn polygon(index: usize, shape: Shape) -> Result<Polygon> {
    let Shape { label, points, kind } = shape;
    let fail = |kind, message: String| Err(FormatError::new(kind, format!("shape {index} (`{label}`): {message}")));
    let points_px = match (kind.as_deref().unwrap_or("polygon"), &points[..]) {
        ("polygon", corners) if corners.len() >= 3 => points,
        ("polygon", corners) => {
            return fail(ErrorKind::Inconsistent, format!("a polygon of {} points has no area", corners.len()));
        }
        ("rectangle", &[[x0, y0], [x1, y1]]) => vec![[x0, y0], [x1, y0], [x1, y1], [x0, y1]],
        (kind, _) => {
            return fail(ErrorKind::Unsupported, format!("`{kind}` of {} points is not an area", points.len()));
        }
    };
    Ok(Polygon { label, points_px })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const BY_HAND: &str = r#"{"version": "4.5.6", "flags": {}, "shapes": [
        {"label": "AU01", "points": [[0, 0], [8, 0], [8, 8], [0, 8]], "group_id": null, "shape_type": "polygon", "flags": {}},
        {"label": "AU10", "points": [[4.0, 4.0], [12.0, 8.0]], "shape_type": "rectangle"},
        {"label": "other", "points": [[0, 0], [16, 0], [0, 16]]}],
        "imagePath": "../rgb/1x/000001.png", "imageData": "aGVsbG8=", "imageHeight": 16, "imageWidth": 12}"#;

    #[test]
    fn files_by_hand_are_read_and_painted_in_order() {
        let file = Polygons::parse(BY_HAND.as_bytes()).unwrap();
        assert_eq!((file.polygons.len(), file.image_size), (3, Some([12, 16])));
        let image = file.label_image(&[("AU01", 1), ("AU10", 3)], 4, 3, 4);
        assert_eq!(image.labels, [1, 1, 0, 1, 3, 3, 0, 0, 0, 0, 0, 0]);
        let image = file.label_image(&[("AU10", 3), ("AU01", 1)], 4, 3, 4);
        assert_eq!(image.labels, [1, 1, 0, 1, 1, 3, 0, 0, 0, 0, 0, 0]);
    }

    #[test]
    fn shapes_without_an_area_and_broken_files_are_named() {
        let circle = BY_HAND.replace("rectangle", "circle");
        assert!(Polygons::parse(circle.as_bytes()).unwrap_err().to_string().contains("shape 1 (`AU10`): `circle`"));
        let line = BY_HAND.replace("[[0, 0], [16, 0], [0, 16]]", "[[0, 0], [16, 0]]");
        assert!(Polygons::parse(line.as_bytes()).unwrap_err().to_string().contains("shape 2"));
        assert_eq!(Polygons::parse(b"{\n\"shapes\": [{]").unwrap_err().line(), Some(2));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn polygons_come_back(points in prop::collection::vec(prop::array::uniform2(-1_000_000i32..1_000_000), 3..9), label in "[A-Z0-9]{1,6}") {
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().join("1.json");
            // Short decimals: the JSON reader may miss the last bit of long ones.
            let points = points.into_iter().map(|p| p.map(|v| f64::from(v) / 64.0)).collect();
            let file = Polygons { polygons: vec![Polygon { label, points_px: points }], image_path: Some("1.png".into()), image_size: Some([3, 4]) };
            file.write(&path).unwrap();
            prop_assert_eq!(Polygons::read(&path).unwrap(), file);
        }

        #[test]
        fn nothing_makes_the_parser_panic(bytes in prop::collection::vec(any::<u8>(), 0..120), cut in 0usize..600) {
            let _ = Polygons::parse(&bytes);
            if let Ok(file) = Polygons::parse(&BY_HAND.as_bytes()[..cut.min(BY_HAND.len())]) {
                let _ = file.label_image(&[("AU01", 1)], 0, 2, 2);
            }
        }
    }
}
