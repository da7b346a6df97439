//! `poses/report.json`: how the cameras were found, how good they are, and where the head is.

use std::path::Path;

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::{ErrorKind, FormatError, Result, atomic};

/// How the cameras of a take were found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PoseMethod {
    /// COLMAP was run on key frames.
    Colmap,
    /// An existing COLMAP model was taken.
    ColmapModel,
    /// A still camera and a moving head: the head pose is the camera.
    Head,
}

/// `poses/report.json`. Lengths are in the model's world units.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PoseReport {
    /// How the cameras were found.
    pub method: PoseMethod,
    /// Frames of the take.
    pub frames: u32,
    /// Frames handed to the pose finder.
    pub frames_tried: u32,
    /// Frames it placed by itself.
    pub frames_registered: u32,
    /// Frames placed by the pictures of the nearest registered ones.
    #[serde(default)]
    pub frames_followed: u32,
    /// Frames placed between placed ones by interpolation.
    pub frames_interpolated: u32,
    /// `frames_registered / frames_tried`.
    pub registered_share: f64,
    /// Mean reprojection error of the 3-D points, pixels of the full-size frame; `None` without points.
    pub reprojection_error_px: Option<f64>,
    /// Median distance between the tracked landmarks and the reprojected mean face, pixels; expression included.
    pub landmark_error_px: Option<f64>,
    /// The middle of the triangulated face landmarks.
    pub head_center: DVec3,
    /// Distance of the farthest triangulated landmark from `head_center`.
    pub head_radius: f64,
    /// Smallest and largest depth of the triangulated face landmarks over all cameras.
    pub head_depth: [f64; 2],
    /// Where sampling has to start: from the face, not from background points.
    pub near: f64,
    /// Where it may end: behind the face and the background.
    pub far: f64,
    /// Depth of the background points (0.1 % and 99.9 %), where there are any.
    pub background_depth: Option<[f64; 2]>,
    /// World units per metre, where known.
    pub units_per_metre: Option<f64>,
    /// The triangulated face: 68 points in the world, in iBUG order.
    pub landmarks_in_world: Vec<DVec3>,
    /// Only for the head route: corners of a convex hull around the head, scalp and jaw included. Pixels outside its
    /// projection are not rigid with the head and are left out of fitting.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub head_hull_in_world: Option<Vec<DVec3>>,
    /// A box along the world's axes with the head in it: its corners of smallest and largest coordinates.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub head_box: Option<[DVec3; 2]>,
    /// What speaks against these cameras; empty when nothing does.
    #[serde(default)]
    pub problems: Vec<String>,
    /// Frames whose camera was interpolated, as inclusive runs.
    #[serde(default)]
    pub interpolated_runs: Vec<[u32; 2]>,
    /// Wall time spent, seconds.
    pub seconds: f64,
    /// What to know: which sub-model was chosen, what was left out, and why.
    pub notes: Vec<String>,
}

impl PoseReport {
    /// Reads `poses/report.json`.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let bytes = std::fs::read(path)
            .map_err(|e| FormatError::io(path, "read", &e).with_hint("find the cameras with `tracker poses TAKE`"))?;
        let report: Self = serde_json::from_slice(&bytes).map_err(|e| json_error(&e).in_file(path))?;
        let hull = report.head_hull_in_world.iter().flatten().chain(report.head_box.iter().flatten());
        let points = report.landmarks_in_world.iter().chain(hull).chain([&report.head_center]);
        let lengths = [report.head_radius, report.near, report.far, report.head_depth[0], report.head_depth[1]];
        // Written so that a NaN is refused; 32-bit floats must hold them.
        let bad = points.flat_map(DVec3::to_array).chain(lengths).find(|v| !(0.0..=1e12).contains(&v.abs()));
        if let Some(bad) = bad {
            let message = format!("a place or length of the head is {bad}");
            return Err(FormatError::new(ErrorKind::Limits, message)
                .in_file(path)
                .with_hint("find the cameras again with `tracker poses TAKE`"));
        }
        Ok(report)
    }

    /// Writes `poses/report.json`, whole or not at all.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<()> {
        write_json(path, self)
    }
}

/// A JSON error with its line and column.
pub fn json_error(error: &serde_json::Error) -> FormatError {
    let text = error.to_string();
    let message = text.rsplit_once(" at line ").map_or(text.as_str(), |(m, _)| m).to_owned();
    let (line, column) = (error.line() as u64, error.column());
    if error.is_eof() {
        // The place where it ends says nothing about what is wrong.
        return if line <= 1 && column == 0 {
            FormatError::new(ErrorKind::Empty, "is empty").with_hint("the disk was full, or the copy of it failed")
        } else {
            FormatError::syntax(format!("the file ends too early: {message}"))
                .at_line(line)
                .with_hint("it is cut off; make or copy it again")
        };
    }
    let result = FormatError::syntax(message);
    let result = if line > 0 { result.at_line(line).in_column(column.to_string()) } else { result };
    if (line, column) == (1, 1) && error.is_syntax() { result.with_hint("this is not a JSON file") } else { result }
}

/// Writes `value` as indented JSON, whole or not at all.
pub fn write_json<T: Serialize + ?Sized>(path: impl AsRef<Path>, value: &T) -> Result<()> {
    let path = path.as_ref();
    let mut bytes = serde_json::to_vec_pretty(value)
        .map_err(|e| FormatError::syntax(format!("cannot encode: {e}")).in_file(path))?;
    bytes.push(b'\n');
    atomic::write_file(path, &bytes)
}
