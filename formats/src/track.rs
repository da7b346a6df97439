//! What a tracker says about each frame: AU intensities, landmarks, head pose, confidence.

use glam::{DMat3, DVec3};

use crate::{ActionUnit, FrameIndex, Isometry, Landmarks68};

/// A head pose as OpenFace writes it: `X_camera = R X_head + T`, OpenCV camera axes.
///
/// The head frame is OpenFace's: a face that looks straight into the camera has the identity rotation
/// (x to the image's right, y down, z away from the camera).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HeadPose {
    /// Position of the head's origin in camera space, millimetres.
    pub translation_mm: DVec3,
    /// Euler angles about x, y, z; `R = Rx · Ry · Rz`.
    pub rotation_rad: DVec3,
}

impl HeadPose {
    /// `camera_from_head`, millimetres.
    pub fn camera_from_head(&self) -> Isometry {
        let DVec3 { x, y, z } = self.rotation_rad;
        Isometry::new(
            DMat3::from_rotation_x(x) * DMat3::from_rotation_y(y) * DMat3::from_rotation_z(z),
            self.translation_mm,
        )
    }

    /// The pose of a `camera_from_head` in millimetres.
    pub fn from_isometry(camera_from_head: &Isometry) -> Self {
        let r = &camera_from_head.rotation;
        // R[0][2] = sin y; the clamp keeps rounding from leaving the domain of asin.
        let y = r.row(0).z.clamp(-1.0, 1.0).asin();
        let x = (-r.row(1).z).atan2(r.row(2).z);
        let z = (-r.row(0).y).atan2(r.row(0).x);
        Self { translation_mm: camera_from_head.translation, rotation_rad: DVec3::new(x, y, z) }
    }
}

/// One face in one frame.
#[derive(Clone, Debug, PartialEq)]
pub struct TrackRow {
    /// The frame, from 0.
    pub frame: FrameIndex,
    /// Which face, where the table has several.
    pub face_id: u32,
    /// The table's own time; frames.csv knows better.
    pub timestamp_secs: Option<f64>,
    /// 0–1.
    pub confidence: f32,
    /// Whether the tracker had the face.
    pub success: bool,
    /// Intensity 0–5 of each of the track's units; `None` where the table has none.
    pub intensities: Vec<Option<f32>>,
    /// Presence of each of the track's presence units.
    pub presences: Vec<Option<bool>>,
    /// The 68 landmarks in the image.
    pub landmarks: Option<Box<Landmarks68>>,
    /// The 68 landmarks in camera space, millimetres.
    pub landmarks_in_camera_mm: Option<Box<[[f32; 3]; 68]>>,
    /// The head pose.
    pub head_pose: Option<HeadPose>,
}

impl TrackRow {
    /// Whether the row can be trusted: tracked, confident enough, and all its intensities are finite numbers.
    pub fn is_valid(&self, min_confidence: f32) -> bool {
        self.success
            && self.confidence >= min_confidence
            && self.intensities.iter().flatten().all(|v| v.is_finite())
            && self.landmarks.as_ref().is_none_or(|l| l.is_finite())
    }
}

/// A table of rows for one video, in the order of frames.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Track {
    /// The AUs of [`TrackRow::intensities`].
    pub units: Vec<ActionUnit>,
    /// The AUs of [`TrackRow::presences`].
    pub presence_units: Vec<ActionUnit>,
    /// The rows.
    pub rows: Vec<TrackRow>,
}

impl Track {
    /// The place of `unit` in [`TrackRow::intensities`].
    pub fn unit_index(&self, unit: ActionUnit) -> Option<usize> {
        self.units.iter().position(|&u| u == unit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn head_pose_angles_come_back(x in -1.4f64..1.4, y in -1.4f64..1.4, z in -3f64..3.0) {
            let pose = HeadPose { translation_mm: DVec3::new(1.0, 2.0, 3.0), rotation_rad: DVec3::new(x, y, z) };
            let back = HeadPose::from_isometry(&pose.camera_from_head());
            prop_assert!((back.rotation_rad - pose.rotation_rad).length() < 1e-9);
        }
    }

    #[test]
    fn positive_yaw_is_openfaces() {
        // OpenFace's matrix has R[0][2] = sin(ry) and R[1][2] = −cos(ry) sin(rx).
        let pose = HeadPose { translation_mm: DVec3::ZERO, rotation_rad: DVec3::new(0.2, 0.3, 0.0) };
        let r = pose.camera_from_head().rotation;
        assert!((r.row(0).z - 0.3f64.sin()).abs() < 1e-12);
        assert!((r.row(1).z + 0.3f64.cos() * 0.2f64.sin()).abs() < 1e-12);
    }
}
