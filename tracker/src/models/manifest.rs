//! `models.toml`: what has to be known of networks to run them.

use serde::Deserialize;

use risorius_formats::au::OPENFACE_INTENSITIES;
use risorius_formats::{ActionUnit, ErrorKind, FormatError, package};

/// The layout of the manifest that this program knows.
pub const VERSION: u32 = 1;

/// The manifest of a folder of models.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Layout of this file.
    pub version: u32,
    /// Finds faces in whole pictures.
    pub detector: DetectorModel,
    /// Finds points in a crop around a face.
    pub landmarks: LandmarkModel,
    /// Expression coefficients from points of the mesh; only with `mesh478`.
    pub blendshapes: Option<BlendshapeModel>,
    /// AU intensities from a crop around the face, in the place of the built-in readout.
    pub aus: Option<AuModel>,
}

/// Order of the axes of a picture in a network's input.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Layout {
    /// Batch, height, width, channels.
    Nhwc,
    /// Batch, channels, height, width.
    Nchw,
}

/// How a detector's outputs are to be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DetectorKind {
    /// MediaPipe's short-range detector: 896 anchors; boxes relative to them, with two eyes; logits.
    BlazeFace,
    /// Decoded corners left, top, right, bottom in shares of the picture, and scores of background and face.
    Boxes,
}

/// A face detector; its picture is RGB, letterboxed, value = (level − mean) × scale.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DetectorModel {
    /// The ONNX file, beside the manifest.
    pub file: String,
    /// Its SHA-256, hexadecimal.
    pub sha256: Option<String>,
    /// How the outputs are read.
    pub kind: DetectorKind,
    /// Width of the input, pixels.
    pub width: u32,
    /// Height of the input, pixels.
    pub height: u32,
    /// Order of the axes.
    pub layout: Layout,
    /// Level 0–255 that becomes 0.
    #[serde(default)]
    pub mean: f32,
    /// Value per level.
    pub scale: f32,
    /// Name of the output with boxes.
    pub boxes: String,
    /// Name of the output with scores.
    pub scores: String,
    /// Smallest score of a face, 0–1.
    #[serde(default = "half")]
    pub threshold: f32,
}

/// Which points a landmark network gives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PointSet {
    /// MediaPipe's 478 (or 468) points: x, y, z in pixels of the crop.
    Mesh478,
    /// The 68 points in iBUG order: x, y in pixels of the crop.
    Points68,
}

/// A landmark network; its picture is an RGB crop, value = (level − mean) × scale.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LandmarkModel {
    /// The ONNX file, beside the manifest.
    pub file: String,
    /// Its SHA-256, hexadecimal.
    pub sha256: Option<String>,
    /// Which points it gives.
    pub kind: PointSet,
    /// Width of the input, pixels; crops are square.
    pub width: u32,
    /// Height of the input, pixels.
    pub height: u32,
    /// Order of the axes.
    pub layout: Layout,
    /// Level 0–255 that becomes 0.
    #[serde(default)]
    pub mean: f32,
    /// Value per level.
    pub scale: f32,
    /// Name of the output with points.
    pub points: String,
    /// Name of the output with the logit that there is a face; without one a face is lost when its points collapse.
    pub presence: Option<String>,
    /// Name of the output with the 8×8×128 feature map of MediaPipe's network; manifests name it, the AUs do without.
    pub inner8: Option<String>,
    /// Name of the output with the 16×16×128 feature map of MediaPipe's network, channels first; helps the AUs.
    pub inner16: Option<String>,
    /// Smallest probability of a face, 0–1.
    #[serde(default = "half")]
    pub threshold: f32,
    /// Side of the crop over the longer side of the box around the points.
    #[serde(default = "margin")]
    pub margin: f32,
}

/// MediaPipe's blendshape network: 146 points of the mesh in, 52 coefficients out.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BlendshapeModel {
    /// The ONNX file, beside the manifest.
    pub file: String,
    /// Its SHA-256, hexadecimal.
    pub sha256: Option<String>,
}

/// An AU network; its picture is an upright RGB crop around the face, value = (level − mean) × scale.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AuModel {
    /// The ONNX file, beside the manifest.
    pub file: String,
    /// Its SHA-256, hexadecimal.
    pub sha256: Option<String>,
    /// Width of the input, pixels; crops are square.
    pub width: u32,
    /// Height of the input, pixels.
    pub height: u32,
    /// Order of the axes.
    pub layout: Layout,
    /// Level 0–255 that becomes 0.
    #[serde(default)]
    pub mean: f32,
    /// Value per level.
    pub scale: f32,
    /// Side of the crop over the longer side of the box around the points.
    #[serde(default = "margin")]
    pub margin: f32,
    /// Name of the output with one number per AU.
    pub intensities: String,
    /// The AUs in the order of the output, among those of an OpenFace table.
    pub units: Vec<ActionUnit>,
    /// Turns the output into intensities 0–5: 1 for networks that give these, 5 for those that give 0–1.
    #[serde(default = "one")]
    pub factor: f32,
    /// From which intensity on an AU counts as present.
    #[serde(default = "one")]
    pub present_from: f32,
}

fn one() -> f32 {
    1.0
}

fn half() -> f32 {
    0.5
}

fn margin() -> f32 {
    1.5
}

impl Manifest {
    /// Parses and checks a manifest.
    pub fn parse(text: &str) -> Result<Self, FormatError> {
        let manifest: Self = toml::from_str(text).map_err(|e| {
            let error = FormatError::syntax(e.message().trim().to_owned());
            match e.span() {
                Some(span) => error.at_line(1 + text[..span.start.min(text.len())].matches('\n').count() as u64),
                None => error,
            }
        })?;
        manifest.check()?;
        Ok(manifest)
    }

    fn check(&self) -> Result<(), FormatError> {
        let fail = |message: String| Err(FormatError::new(ErrorKind::Inconsistent, message));
        if self.version != VERSION {
            let message = format!("version {} is not known to this program, which reads {VERSION}", self.version);
            return Err(FormatError::new(ErrorKind::Unsupported, message));
        }
        for (file, _) in self.files() {
            package::check_relative(file)?;
        }
        let (d, l) = (&self.detector, &self.landmarks);
        for (table, width, height) in [("detector", d.width, d.height), ("landmarks", l.width, l.height)] {
            if !(16..=2048).contains(&width) || !(16..=2048).contains(&height) {
                return fail(format!("[{table}]: an input of {width}×{height} pixels is not possible"));
            }
        }
        if l.width != l.height {
            return fail("[landmarks]: the crop has to be square: `width` = `height`".to_owned());
        }
        for (name, value) in [("detector.mean", d.mean), ("landmarks.mean", l.mean)] {
            if !value.is_finite() {
                return fail(format!("`{name}` has to be a number, not {value}"));
            }
        }
        let positive = [("detector.scale", d.scale), ("landmarks.scale", l.scale), ("landmarks.margin", l.margin)];
        for (name, value) in positive {
            if !(value.is_finite() && value > 0.0) {
                return fail(format!("`{name}` has to be above 0, not {value}"));
            }
        }
        for (name, value) in [("detector.threshold", d.threshold), ("landmarks.threshold", l.threshold)] {
            if !(0.0..=1.0).contains(&value) {
                return fail(format!("`{name}` has to lie between 0 and 1, not at {value}"));
            }
        }
        if let Some(aus) = &self.aus {
            aus.check().map_err(|message| FormatError::new(ErrorKind::Inconsistent, message))?;
        }
        if self.blendshapes.is_some() && l.kind != PointSet::Mesh478 {
            return fail("[blendshapes] needs the points of `mesh478`".to_owned());
        }
        Ok(())
    }

    /// Every file with its hash.
    pub(crate) fn files(&self) -> Vec<(&str, Option<&str>)> {
        let mut files = vec![
            (self.detector.file.as_str(), self.detector.sha256.as_deref()),
            (self.landmarks.file.as_str(), self.landmarks.sha256.as_deref()),
        ];
        files.extend(self.blendshapes.iter().map(|m| (m.file.as_str(), m.sha256.as_deref())));
        files.extend(self.aus.iter().map(|m| (m.file.as_str(), m.sha256.as_deref())));
        files
    }
}

impl AuModel {
    fn check(&self) -> Result<(), String> {
        if self.width != self.height || !(16..=2048).contains(&self.width) {
            return Err(format!("[aus]: an input of {}×{} pixels is not possible", self.width, self.height));
        }
        for (name, value) in [("scale", self.scale), ("margin", self.margin), ("factor", self.factor)] {
            if !(value.is_finite() && value > 0.0) {
                return Err(format!("`aus.{name}` has to be above 0, not {value}"));
            }
        }
        if self.units.is_empty() {
            return Err("`aus.units` names no AU".to_owned());
        }
        for (i, unit) in self.units.iter().enumerate() {
            if !OPENFACE_INTENSITIES.contains(unit) {
                return Err(format!("`aus.units`: an OpenFace table has no intensity of {unit}"));
            }
            if self.units[..i].contains(unit) {
                return Err(format!("`aus.units` names {unit} twice"));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DEFAULT: &str = include_str!("../../../tools/model-fetch/models.toml");

    #[test]
    fn the_manifest_that_is_fetched_is_read() {
        let manifest = Manifest::parse(DEFAULT).unwrap();
        assert_eq!((manifest.detector.kind, manifest.landmarks.kind), (DetectorKind::BlazeFace, PointSet::Mesh478));
        assert_eq!(manifest.files().len(), 3);
    }

    #[test]
    fn what_makes_no_sense_is_refused_with_its_place() {
        let error = |from: &str, to: &str| {
            assert!(DEFAULT.contains(from), "{from}");
            Manifest::parse(&DEFAULT.replacen(from, to, 1)).unwrap_err().to_string()
        };
        assert!(error("version = 1", "version = 2").contains("version 2 is not known"));
        assert!(error("width = 128", "width = 0").contains("[detector]: an input of 0×128"));
        assert!(error("height = 256", "height = 192").contains("has to be square"));
        assert!(error("\"mesh478\"", "\"points68\"").contains("[blendshapes] needs"));
        assert!(
            error("threshold = 0.5", "threshold = 5.0").contains("`detector.threshold` has to lie between 0 and 1")
        );
        assert!(
            error("kind = \"blazeface\"", "kind = \"yolo\"").starts_with("line 8: "),
            "{}",
            error("kind = \"blazeface\"", "kind = \"yolo\"")
        );
        assert!(error("margin = 1.5", "margins = 1.5").contains("unknown field `margins`"));
    }

    #[test]
    fn an_au_network_says_which_aus_it_gives() {
        let aus = |units: &str| {
            let table = "[aus]\nfile = \"a.onnx\"\nwidth = 112\nheight = 112\nlayout = \"nchw\"\nscale = 1.0\n";
            Manifest::parse(&format!("{DEFAULT}\n{table}intensities = \"out\"\nunits = [{units}]\n"))
        };
        let manifest = aus("\"AU12\", \"AU04\"").unwrap();
        assert_eq!(manifest.files().len(), 4);
        assert_eq!(manifest.aus.unwrap().units, [ActionUnit(12), ActionUnit(4)]);
        for (units, words) in
            [("", "names no AU"), ("\"AU12\", \"AU12\"", "AU12 twice"), ("\"AU28\"", "no intensity of AU28")]
        {
            assert!(aus(units).unwrap_err().to_string().contains(words), "{units}");
        }
    }
}
