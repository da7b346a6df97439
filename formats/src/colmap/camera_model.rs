//! COLMAP's camera models: names, ids, parameter counts, and which of them OpenCV intrinsics can express.

use super::ModelCamera;
use crate::camera::Distortion;
use crate::{ErrorKind, FormatError, Intrinsics, Result};

/// A camera model that COLMAP knows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CameraModel {
    /// Its number in binary models.
    pub id: i32,
    /// Its name in text models.
    pub name: &'static str,
    /// How many parameters it has.
    pub param_count: usize,
}

const fn model(id: i32, name: &'static str, param_count: usize) -> CameraModel {
    CameraModel { id, name, param_count }
}

/// All camera models of COLMAP up to August 2026; a model's place is its id.
pub const CAMERA_MODELS: [CameraModel; 18] = [
    model(0, "SIMPLE_PINHOLE", 3),
    model(1, "PINHOLE", 4),
    model(2, "SIMPLE_RADIAL", 4),
    model(3, "RADIAL", 5),
    model(4, "OPENCV", 8),
    model(5, "OPENCV_FISHEYE", 8),
    model(6, "FULL_OPENCV", 12),
    model(7, "FOV", 5),
    model(8, "SIMPLE_RADIAL_FISHEYE", 4),
    model(9, "RADIAL_FISHEYE", 5),
    model(10, "THIN_PRISM_FISHEYE", 12),
    model(11, "RAD_TAN_THIN_PRISM_FISHEYE", 16),
    model(12, "SIMPLE_DIVISION", 4),
    model(13, "DIVISION", 5),
    model(14, "SIMPLE_FISHEYE", 3),
    model(15, "FISHEYE", 4),
    model(16, "EUCM", 6),
    model(17, "EQUIRECTANGULAR", 2),
];

impl CameraModel {
    /// The model of that id in a binary file.
    pub fn by_id(id: i32) -> Option<Self> {
        usize::try_from(id).ok().and_then(|i| CAMERA_MODELS.get(i)).copied()
    }

    /// The model of that name in a text file.
    pub fn by_name(name: &str) -> Option<Self> {
        CAMERA_MODELS.iter().find(|m| m.name == name).copied()
    }
}

impl ModelCamera {
    /// The camera as OpenCV intrinsics; an error for models (fisheye and the like) that these cannot express.
    ///
    /// Pixels need no shift: COLMAP too has the centre of the first pixel at (0.5, 0.5).
    pub fn intrinsics(&self) -> Result<Intrinsics> {
        let side = |name: &str, value: u64| match u32::try_from(value) {
            Ok(n) if n > 0 => Ok(n),
            _ => Err(FormatError::new(ErrorKind::Inconsistent, format!("image {name} `{value}` makes no sense"))),
        };
        let (width, height) = (side("width", self.width)?, side("height", self.height)?);
        let mut distortion = Distortion::default();
        let (fx, fy, cx, cy) = match (self.model.as_str(), self.params.as_slice()) {
            ("SIMPLE_PINHOLE", &[f, cx, cy]) => (f, f, cx, cy),
            ("PINHOLE", &[fx, fy, cx, cy]) => (fx, fy, cx, cy),
            ("SIMPLE_RADIAL", &[f, cx, cy, k]) => {
                distortion.radial = [k, 0.0, 0.0];
                (f, f, cx, cy)
            }
            ("RADIAL", &[f, cx, cy, k1, k2]) => {
                distortion.radial = [k1, k2, 0.0];
                (f, f, cx, cy)
            }
            ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => {
                distortion.radial = [k1, k2, 0.0];
                distortion.tangential = [p1, p2];
                (fx, fy, cx, cy)
            }
            ("FULL_OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6]) => {
                distortion =
                    Distortion { radial: [k1, k2, k3], radial_denominator: [k4, k5, k6], tangential: [p1, p2] };
                (fx, fy, cx, cy)
            }
            (name @ ("SIMPLE_PINHOLE" | "PINHOLE" | "SIMPLE_RADIAL" | "RADIAL" | "OPENCV" | "FULL_OPENCV"), params) => {
                return Err(wrong_param_count(name, params.len()));
            }
            (name, _) => {
                return Err(FormatError::new(
                    ErrorKind::Unsupported,
                    format!("camera model `{name}` has no OpenCV perspective intrinsics"),
                )
                .with_hint(
                    "run COLMAP with `--ImageReader.camera_model OPENCV`, or undistort the pictures with `colmap image_undistorter` and make the take of those",
                ));
            }
        };
        if !self.params.iter().all(|p| p.is_finite()) || fx <= 0.0 || fy <= 0.0 {
            return Err(FormatError::new(
                ErrorKind::Inconsistent,
                format!("camera parameters `{:?}` make no sense", self.params),
            )
            .with_hint("focal lengths are positive and every parameter is a finite number"));
        }
        Ok(Intrinsics { width, height, fx, fy, cx, cy, skew: 0.0, distortion })
    }

    /// The simplest COLMAP model that expresses `intrinsics`. COLMAP has no skew; it is left out.
    pub fn from_intrinsics(intrinsics: &Intrinsics) -> Self {
        let &Intrinsics { width, height, fx, fy, cx, cy, distortion, .. } = intrinsics;
        let ([k1, k2, k3], [k4, k5, k6], [p1, p2]) =
            (distortion.radial, distortion.radial_denominator, distortion.tangential);
        let square = fx == fy;
        let higher = [k3, k4, k5, k6].iter().any(|&v| v != 0.0);
        let tangential = p1 != 0.0 || p2 != 0.0;
        let (model, params) = if higher {
            ("FULL_OPENCV", vec![fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6])
        } else if tangential || (!square && (k1 != 0.0 || k2 != 0.0)) {
            ("OPENCV", vec![fx, fy, cx, cy, k1, k2, p1, p2])
        } else if k2 != 0.0 {
            ("RADIAL", vec![fx, cx, cy, k1, k2])
        } else if k1 != 0.0 {
            ("SIMPLE_RADIAL", vec![fx, cx, cy, k1])
        } else if square {
            ("SIMPLE_PINHOLE", vec![fx, cx, cy])
        } else {
            ("PINHOLE", vec![fx, fy, cx, cy])
        };
        Self { model: model.to_owned(), width: u64::from(width), height: u64::from(height), params }
    }
}

pub(super) fn wrong_param_count(model: &str, found: usize) -> FormatError {
    let expected = CameraModel::by_name(model).map_or(0, |m| m.param_count);
    FormatError::syntax(format!("camera model `{model}` has {expected} parameters, found {found}"))
}
