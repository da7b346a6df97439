//! `VIEWS.json`: cameras and AU intensities to render, with the true images where they exist.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::camera::{Camera, Distortion, Intrinsics, Isometry};
use crate::nerfies::check_id;
use crate::pose_report::json_error;
use crate::{ActionUnit, ErrorKind, FormatError, Result};

/// A view's camera as the file writes it: OpenCV names, missing coefficients are 0.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewCamera {
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// Horizontal focal length, pixels.
    pub fx: f64,
    /// Vertical focal length, pixels.
    pub fy: f64,
    /// Principal point x, pixels.
    pub cx: f64,
    /// Principal point y, pixels.
    pub cy: f64,
    /// Radial coefficients.
    #[serde(default)]
    pub k1: f64,
    /// See `k1`.
    #[serde(default)]
    pub k2: f64,
    /// See `k1`.
    #[serde(default)]
    pub k3: f64,
    /// Radial coefficients of the denominator.
    #[serde(default)]
    pub k4: f64,
    /// See `k4`.
    #[serde(default)]
    pub k5: f64,
    /// See `k4`.
    #[serde(default)]
    pub k6: f64,
    /// Tangential coefficients.
    #[serde(default)]
    pub p1: f64,
    /// See `p1`.
    #[serde(default)]
    pub p2: f64,
    /// Rows of the 3×4 matrix.
    pub camera_from_world: [[f64; 4]; 3],
}

impl From<&ViewCamera> for Camera {
    fn from(v: &ViewCamera) -> Self {
        let distortion =
            Distortion { radial: [v.k1, v.k2, v.k3], radial_denominator: [v.k4, v.k5, v.k6], tangential: [v.p1, v.p2] };
        Self {
            intrinsics: Intrinsics {
                width: v.width,
                height: v.height,
                fx: v.fx,
                fy: v.fy,
                cx: v.cx,
                cy: v.cy,
                skew: 0.0,
                distortion,
            },
            camera_from_world: Isometry::from_rows(v.camera_from_world),
        }
    }
}

impl From<&Camera> for ViewCamera {
    fn from(c: &Camera) -> Self {
        let i = &c.intrinsics;
        let ([k1, k2, k3], [k4, k5, k6], [p1, p2]) =
            (i.distortion.radial, i.distortion.radial_denominator, i.distortion.tangential);
        let camera_from_world = c.camera_from_world.to_rows();
        Self {
            width: i.width,
            height: i.height,
            fx: i.fx,
            fy: i.fy,
            cx: i.cx,
            cy: i.cy,
            k1,
            k2,
            k3,
            k4,
            k5,
            k6,
            p1,
            p2,
            camera_from_world,
        }
    }
}

/// One picture to render.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct View {
    /// Name of the rendered file without `.png`.
    pub id: String,
    /// The true image, relative to the file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub image: Option<PathBuf>,
    /// Of which sort the view is, for grouping results.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kind: Option<String>,
    /// The camera.
    pub camera: ViewCamera,
    /// AU intensities 0–5; AUs left out take the capture's neutral value.
    #[serde(default)]
    pub aus: BTreeMap<ActionUnit, f32>,
    /// The true depth, relative to the file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub depth: Option<PathBuf>,
}

/// The whole file.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ViewList {
    /// The views in order.
    pub views: Vec<View>,
}

/// No camera has numbers beyond this, whatever the unit: they come from damage, and 32-bit floats must hold them.
const LARGEST: f64 = 1e12;

impl ViewList {
    /// Parses and checks the list: ids must be plain, unique file names, cameras rigid, intensities finite.
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        let list: Self = serde_json::from_slice(bytes).map_err(|e| json_error(&e))?;
        if list.views.is_empty() {
            return Err(FormatError::new(ErrorKind::Empty, "holds no views"));
        }
        let mut seen = std::collections::BTreeSet::new();
        for view in &list.views {
            let fail = |message: String| {
                Err(FormatError::new(ErrorKind::Inconsistent, format!("view `{}`: {message}", view.id)))
            };
            // The id becomes a file's name in the output. Pictures are only read, and a list that was written by hand may
            // name them wherever they lie.
            if check_id(&view.id).is_err() {
                let id: String = view.id.chars().take(80).collect();
                let message = format!("the id {id:?} must be a plain file name");
                return Err(FormatError::new(ErrorKind::Inconsistent, message));
            }
            if !seen.insert(view.id.as_str()) {
                return fail("the id stands there twice".to_owned());
            }
            let camera = Camera::from(&view.camera);
            let i = &camera.intrinsics;
            let sane = |v: f64| v.abs() <= LARGEST;
            let finite = [i.fx, i.fy, i.cx, i.cy].into_iter().all(sane)
                && camera.camera_from_world.translation.to_array().into_iter().all(sane);
            if !finite
                || i.fx < 1.0 / LARGEST
                || i.fy < 1.0 / LARGEST
                || i.width == 0
                || i.height == 0
                || i.width > 16_384
                || i.height > 16_384
            {
                return fail("the camera's size, focal length or position makes no sense".to_owned());
            }
            let skewness = camera.camera_from_world.orthonormality_error();
            if !(skewness < 1e-3 && camera.camera_from_world.rotation.determinant() > 0.0) {
                return fail("`camera_from_world` is not a rotation and a translation".to_owned());
            }
            if let Some((unit, value)) = view.aus.iter().find(|(_, v)| !v.is_finite()) {
                return fail(format!("`{unit}` is {value}, expected a number from 0 to 5"));
            }
        }
        Ok(list)
    }

    /// Reads a view list.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let bytes = std::fs::read(path).map_err(|e| FormatError::io(path, "read", &e))?;
        Self::parse(&bytes).map_err(|e| e.in_file(path))
    }
}
