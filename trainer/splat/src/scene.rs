//! What a fit is given: posed pictures with their AU activations, labels and landmarks.
//!
//! Lengths are metres, the origin is the middle of the face (the caller converts). There are two rigid frames, room and
//! head; at rest they coincide. `camera_from_room` is the camera's own pose, `room_from_head` the head's.

use glam::{DMat3, DVec3};
use risorius_formats::{Camera, Isometry};

/// One training frame.
#[derive(Clone, Debug)]
pub struct Frame<'a> {
    /// Intrinsics of the picture in memory (distortion included) and `camera_from_room`.
    pub camera: Camera,
    /// The head's pose in the room as it is known before the fit; the identity where the head is still.
    pub room_from_head: Isometry,
    /// RGB bytes, row by row.
    pub rgb: &'a [u8],
    /// Which pixels show what is to be fitted (non-zero), row by row; `None` means all. Depth and memberships are sought there
    /// only; colours too, unless there is a plate, before which all of a picture counts.
    pub valid: Option<&'a [u8]>,
    /// Region of each pixel + 1, 0 for none, row by row; `None` where the frame has no masks.
    pub labels: Option<&'a [u8]>,
    /// Activation of each AU: 0 is the least and 1 is 80 % of the most that the capture shows; may exceed 1.
    /// `None` where the frame has no annotation.
    pub activations: Option<Vec<f32>>,
    /// The 68 facial landmarks, pixels of the picture in memory, the centre of the first pixel at (0.5, 0.5).
    pub landmarks_px: Option<[[f32; 2]; 68]>,
}

/// A still picture behind everything, of the same camera as the frames.
#[derive(Clone, Copy, Debug)]
pub struct Plate<'a> {
    /// Pixels along a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// RGB bytes, row by row.
    pub rgb: &'a [u8],
}

/// The training data of an avatar.
#[derive(Clone, Debug)]
pub struct Scene<'a> {
    /// The frames to fit.
    pub frames: Vec<Frame<'a>>,
    /// Region of each AU.
    pub region_of: Vec<usize>,
    /// Regions that an AU acts in beside its own, a bit each; AUs that are not listed have none.
    pub also_in: Vec<u8>,
    /// Number of regions, at most [`crate::model::REGIONS`].
    pub regions: usize,
    /// Radius of the face about the origin: its farthest landmark, metres.
    pub face_radius_m: f32,
    /// Corners of the head's hull in the head frame, where only the head may be fitted (a still camera's capture).
    pub head_hull: Option<Vec<DVec3>>,
    /// What is behind the head, where the camera stands still and the world is the head's frame.
    pub plate: Option<Plate<'a>>,
    /// Index of the most neutral frame.
    pub neutral_frame: usize,
}

/// `camera_from_head`: the pose that head-bound points are seen with.
pub fn camera_from_head(camera: &Camera, room_from_head: &Isometry) -> Isometry {
    camera.camera_from_world.compose(room_from_head)
}

/// The rotation of a rotation vector, radians.
pub fn rotation_from_vector(v: DVec3) -> DMat3 {
    match v.length() {
        angle if angle > 1e-12 => DMat3::from_axis_angle(v / angle, angle),
        _ => DMat3::IDENTITY,
    }
}
