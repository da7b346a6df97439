//! `transforms.json` as nerfstudio, instant-ngp and NeRF's synthetic scenes write it.
//!
//! The lens stands in each frame or once at the top of the file, whole numbers may be floats (`1080.0`), the focal length may
//! be an angle, paths begin with `./` or lack their ending. Lens models that are no perspective with OpenCV's k1, k2, k3, p1,
//! p2 are refused: read as one, their numbers would mean another lens.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use glam::{DMat3, DVec3};
use risorius_formats::camera::Distortion;
use risorius_formats::nerfies;
use risorius_formats::pose_report::json_error;
use risorius_formats::{Camera, ErrorKind, FormatError, Intrinsics, Isometry};
use serde::Deserialize;

use super::id_of;
use crate::error::Result;
use crate::export::FLIP;

/// Lens models whose numbers are k1, k2, k3, p1, p2 of a perspective lens, or fewer.
const PERSPECTIVE: [&str; 7] =
    ["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV", "PERSPECTIVE"];
/// Endings that are tried where a path has none.
const ENDINGS: [&str; 4] = ["png", "jpg", "jpeg", "PNG"];
/// No camera has more pixels along a side.
const MAX_SIDE_PX: f64 = 1e6;

/// The whole file, as far as it concerns us.
#[derive(Deserialize)]
struct File {
    #[serde(flatten)]
    lens: Lens,
    frames: Vec<Frame>,
    #[serde(default)]
    train_filenames: Vec<String>,
    #[serde(default)]
    val_filenames: Vec<String>,
    #[serde(default)]
    test_filenames: Vec<String>,
}

#[derive(Deserialize)]
struct Frame {
    file_path: String,
    transform_matrix: Vec<Vec<f64>>,
    #[serde(flatten)]
    lens: Lens,
}

/// A lens, whole or in part; `None` leaves a number to the top of the file.
#[derive(Clone, Default, Deserialize)]
struct Lens {
    camera_model: Option<String>,
    is_fisheye: Option<bool>,
    w: Option<f64>,
    h: Option<f64>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    camera_angle_x: Option<f64>,
    camera_angle_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    k5: Option<f64>,
    k6: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
}

/// A picture of the file.
pub(crate) struct TransformsPicture {
    /// The id that the picture gets: its name, or its path where names repeat.
    pub(crate) id: String,
    /// As it stands in the file.
    pub(crate) path: String,
    /// Where the picture is, relative to the folder; the ending is found where the file has none.
    pub(crate) file: PathBuf,
    pub(crate) camera: Camera,
}

/// What a file says.
pub(crate) struct Transforms {
    pub(crate) pictures: Vec<TransformsPicture>,
    pub(crate) train: Vec<String>,
    pub(crate) val: Vec<String>,
    pub(crate) test: Vec<String>,
}

/// Reads `transforms.json`.
pub(crate) fn read_transforms(path: &Path) -> Result<Transforms> {
    let bytes = std::fs::read(path).map_err(|e| FormatError::io(path, "read", &e))?;
    let file: File = serde_json::from_slice(&bytes).map_err(|e| json_error(&e).in_file(path))?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let stems: BTreeSet<Option<String>> = file.frames.iter().map(|f| id_of(&f.file_path)).collect();
    let by_name = stems.len() == file.frames.len();
    let mut pictures = Vec::with_capacity(file.frames.len());
    for frame in &file.frames {
        let place = |e: FormatError| e.in_file(path);
        let bad = |what: &str| inconsistent(frame, what);
        let relative = found(folder, &frame.file_path);
        let whole = || frame.file_path.trim_start_matches("./").replace(['/', '\\'], "_");
        let id = if by_name { id_of(&frame.file_path) } else { id_of(&whole()) };
        let id = id.ok_or_else(|| place(bad("is no file name")))?;
        nerfies::check_id(&id).map_err(place)?;
        let camera = frame.camera(&file.lens, &folder.join(&relative)).map_err(place)?;
        pictures.push(TransformsPicture { id, path: frame.file_path.clone(), file: relative, camera });
    }
    let (train, val, test) = (file.train_filenames, file.val_filenames, file.test_filenames);
    Ok(Transforms { pictures, train, val, test })
}

/// The path of a picture in `folder`, with its ending.
fn found(folder: &Path, path: &str) -> PathBuf {
    let plain = PathBuf::from(path.trim_start_matches("./"));
    if plain.extension().is_some() || folder.join(&plain).is_file() {
        return plain;
    }
    let with = |ending: &&str| plain.with_extension(ending);
    ENDINGS.iter().map(with).find(|p| folder.join(p).is_file()).unwrap_or(plain)
}

fn inconsistent(frame: &Frame, what: &str) -> FormatError {
    FormatError::new(ErrorKind::Inconsistent, format!("frame `{}`: {what}", frame.file_path))
}

impl Frame {
    /// The camera of the picture at `picture`, which is looked at only where the file states no size.
    fn camera(&self, top: &Lens, picture: &Path) -> Result<Camera, FormatError> {
        let lens = self.lens.or(top);
        lens.check_model(self)?;
        let bad = |what: &str| inconsistent(self, what);
        let (w, h) = match (lens.w, lens.h) {
            (Some(w), Some(h)) => (w, h),
            _ => image::image_dimensions(picture)
                .map(|(w, h)| (f64::from(w), f64::from(h)))
                .map_err(|e| bad(&format!("has no `w` and `h`, and its picture does not tell: {e}")))?,
        };
        let side = |v: f64| ((1.0..=MAX_SIDE_PX).contains(&v) && v.fract() == 0.0).then_some(v as u32);
        let (Some(width), Some(height)) = (side(w), side(h)) else {
            return Err(bad(&format!("`w` and `h` are {w} and {h}, expected numbers of pixels")));
        };
        let of_angle = |angle: Option<f64>, side: f64| angle.map(|a| 0.5 * side / (0.5 * a).tan());
        let fx = lens.fl_x.or(of_angle(lens.camera_angle_x, w));
        let fy = lens.fl_y.or(of_angle(lens.camera_angle_y, h)).or(fx);
        let (Some(fx), Some(fy)) = (fx.or(fy), fy) else {
            return Err(bad("has neither `fl_x` nor `camera_angle_x`, nor has the top of the file"));
        };
        let none = |v: Option<f64>| v.unwrap_or(0.0);
        let intrinsics = Intrinsics {
            width,
            height,
            fx,
            fy,
            cx: lens.cx.unwrap_or(0.5 * w),
            cy: lens.cy.unwrap_or(0.5 * h),
            skew: 0.0,
            distortion: Distortion {
                radial: [lens.k1, lens.k2, lens.k3].map(none),
                radial_denominator: [0.0; 3],
                tangential: [lens.p1, lens.p2].map(none),
            },
        };
        let k = &intrinsics;
        let numbers = [k.fx, k.fy, k.cx, k.cy].into_iter().chain(k.distortion.radial).chain(k.distortion.tangential);
        if !numbers.into_iter().all(f64::is_finite) || fx <= 0.0 || fy <= 0.0 {
            return Err(bad("its lens is no lens"));
        }
        let camera_from_world =
            self.pose().ok_or_else(|| bad("`transform_matrix` is no matrix of 3 or 4 rows of 4"))?;
        Ok(Camera { intrinsics, camera_from_world })
    }

    fn pose(&self) -> Option<Isometry> {
        let m = &self.transform_matrix;
        if !matches!(m.len(), 3 | 4) || m.iter().any(|row| row.len() != 4 || row.iter().any(|v| !v.is_finite())) {
            return None;
        }
        let row = |i: usize| DVec3::new(m[i][0], m[i][1], m[i][2]);
        // Rows of the rotation are rows of world_from_camera; the camera's y and z are turned back.
        let world_from_gl = DMat3::from_cols(row(0), row(1), row(2)).transpose();
        let camera_from_world = (world_from_gl * FLIP).transpose();
        let center = DVec3::new(m[0][3], m[1][3], m[2][3]);
        Some(Isometry::new(camera_from_world, -(camera_from_world * center)))
    }
}

impl Lens {
    /// The numbers of this lens, and where it lacks them those of `top`.
    fn or(&self, top: &Self) -> Self {
        let Self { w, h, fl_x, fl_y, camera_angle_x, camera_angle_y, cx, cy, .. } = *self;
        Self {
            camera_model: self.camera_model.clone().or_else(|| top.camera_model.clone()),
            is_fisheye: self.is_fisheye.or(top.is_fisheye),
            w: w.or(top.w),
            h: h.or(top.h),
            fl_x: fl_x.or(top.fl_x),
            fl_y: fl_y.or(top.fl_y),
            camera_angle_x: camera_angle_x.or(top.camera_angle_x),
            camera_angle_y: camera_angle_y.or(top.camera_angle_y),
            cx: cx.or(top.cx),
            cy: cy.or(top.cy),
            k1: self.k1.or(top.k1),
            k2: self.k2.or(top.k2),
            k3: self.k3.or(top.k3),
            k4: self.k4.or(top.k4),
            k5: self.k5.or(top.k5),
            k6: self.k6.or(top.k6),
            p1: self.p1.or(top.p1),
            p2: self.p2.or(top.p2),
        }
    }

    /// Fails for lenses that are no perspective with k1, k2, k3, p1 and p2.
    fn check_model(&self, frame: &Frame) -> Result<(), FormatError> {
        let unknown = self.camera_model.as_deref().filter(|m| !PERSPECTIVE.contains(m));
        let higher = [self.k4, self.k5, self.k6].into_iter().flatten().any(|k| k != 0.0);
        let what = match unknown {
            Some(model) => format!("has the lens model `{model}`"),
            None if self.is_fisheye == Some(true) => "has a fisheye lens (`is_fisheye`)".to_owned(),
            None if higher => "has a lens with k4 to k6".to_owned(),
            None => return Ok(()),
        };
        let message =
            format!("frame `{}`: {what}; perspective lenses with k1, k2, k3, p1, p2 are known", frame.file_path);
        Err(FormatError::new(ErrorKind::Unsupported, message)
            .with_hint("undistort the pictures first, for example with `colmap image_undistorter`"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MATRIX: &str = "[[1,0,0,0.1],[0,1,0,0],[0,0,1,0.6],[0,0,0,1]]";

    fn read(top: &str, frame: &str) -> Result<Transforms> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("transforms.json");
        let text = format!(r#"{{{top} "frames": [{{"transform_matrix": {MATRIX}, {frame}}}]}}"#);
        std::fs::write(&path, text).unwrap();
        image::RgbImage::new(64, 48).save(dir.path().join("r_0.png")).unwrap();
        read_transforms(&path)
    }

    fn lens(top: &str, frame: &str) -> Intrinsics {
        read(top, frame).unwrap().pictures[0].camera.intrinsics
    }

    #[test]
    fn lenses_at_the_top_as_floats_and_as_angles_are_read() {
        let nerfstudio = lens(
            r#""camera_model": "OPENCV", "w": 64, "h": 48, "fl_x": 50.0, "fl_y": 51, "cx": 31.5, "cy": 24, "k1": 0.1,"#,
            r#""file_path": "images/a.png""#,
        );
        assert_eq!((nerfstudio.width, nerfstudio.fy, nerfstudio.cx), (64, 51.0, 31.5));
        assert_eq!(nerfstudio.distortion.radial[0], 0.1);
        let ngp = lens(r#""w": 64.0, "h": 48.0, "fl_x": 50,"#, r#""file_path": "./images/a.png", "fl_x": 60"#);
        assert_eq!((ngp.height, ngp.fx, ngp.fy, ngp.cy), (48, 60.0, 60.0, 24.0));
        let synthetic = lens(r#""camera_angle_x": 1.5707963267948966,"#, r#""file_path": "./r_0""#);
        assert!((synthetic.width, synthetic.height) == (64, 48) && (synthetic.fx - 32.0).abs() < 1e-9);
    }

    #[test]
    fn other_lenses_and_broken_numbers_are_refused() {
        let whole = r#""w": 64, "h": 48, "fl_x": 50,"#;
        for (top, frame, words) in [
            (format!(r#"{whole} "camera_model": "OPENCV_FISHEYE","#), r#""file_path": "a.png""#, "`OPENCV_FISHEYE`"),
            (format!(r#"{whole} "is_fisheye": true,"#), r#""file_path": "a.png""#, "is_fisheye"),
            (format!(r#"{whole} "k4": 0.1,"#), r#""file_path": "a.png""#, "k4"),
            (whole.to_owned(), r#""file_path": "a.png", "w": 64.5"#, "64.5"),
            (String::new(), r#""file_path": "a.png", "w": 64, "h": 48"#, "fl_x"),
        ] {
            let error = read(&top, frame).err().unwrap().to_string();
            assert!(error.contains(words) && error.contains("a.png"), "{top} {frame}: {error}");
        }
        assert!(
            read(&format!(r#"{whole} "k4": 0.0, "camera_model": "FULL_OPENCV","#), r#""file_path": "a.png""#).is_ok()
        );
    }
}
