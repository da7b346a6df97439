//! Following one face through frames that hold several. OpenFace's ids are not stable over time, places are.

use crate::TrackRow;

/// Where a face is and how large, in units that are the same for the whole table.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Candidate {
    center: [f32; 2],
    /// Diagonal of the box around the face.
    size: f32,
}

/// A typical face is this wide; turns a head pose into a size when there are no landmarks.
const FACE_WIDTH_MM: f64 = 150.0;

impl Candidate {
    /// The place of a row's face, from its landmarks or else from its head pose; `None` when it says neither.
    pub(super) fn of(row: &TrackRow) -> Option<Self> {
        if !row.success {
            return None;
        }
        let found = if let Some(landmarks) = &row.landmarks {
            let [left, top, right, bottom] = landmarks.bounds_px();
            Self {
                center: [f32::midpoint(left, right), f32::midpoint(top, bottom)],
                size: (right - left).hypot(bottom - top),
            }
        } else {
            let t = row.head_pose.as_ref()?.translation_mm;
            Self { center: [(t.x / t.z) as f32, (t.y / t.z) as f32], size: (FACE_WIDTH_MM / t.z) as f32 }
        };
        (found.center.iter().all(|v| v.is_finite()) && found.size.is_finite() && found.size > 0.0).then_some(found)
    }

    fn distance(&self, other: &Self) -> f32 {
        (self.center[0] - other.center[0]).hypot(self.center[1] - other.center[1])
    }
}

/// One row per frame: the largest face of the first frame that has one, then always the nearest.
///
/// A face further away than the last one's box is somebody else; the reach grows by a tenth of it with every frame
/// in which the face was not seen. Frames without the face keep a row that says so.
pub(super) fn follow(frames: Vec<Vec<TrackRow>>, place: impl Fn(&TrackRow) -> Option<Candidate>) -> Vec<TrackRow> {
    let mut last: Option<(u32, Candidate)> = None;
    let mut last_id = None;
    let mut chosen = Vec::with_capacity(frames.len());
    for mut group in frames {
        let places = group.iter().map(&place).enumerate().filter_map(|(i, p)| p.map(|p| (i, p)));
        let best = match last {
            None => places.reduce(|a, b| if b.1.size > a.1.size { b } else { a }),
            Some((_, known)) => places.reduce(|a, b| if b.1.distance(&known) < a.1.distance(&known) { b } else { a }),
        };
        let index = match (best, last) {
            (Some((i, found)), Some((frame, known))) => {
                let gap = group[i].frame.0.saturating_sub(frame) as f32;
                let ours = found.distance(&known) <= known.size * (0.9 + 0.1 * gap);
                ours.then_some((i, Some(found)))
            }
            (Some((i, found)), None) => Some((i, Some(found))),
            // Nobody has a place: keep to the id as long as it is there.
            (None, None) => {
                let same = group.iter().position(|r| r.success && Some(r.face_id) == last_id);
                same.or_else(|| group.iter().position(|r| r.success)).map(|i| (i, None))
            }
            (None, Some(_)) => None,
        };
        match index {
            Some((i, found)) => {
                let row = group.swap_remove(i);
                last = found.map(|p| (row.frame.0, p)).or(last);
                last_id = Some(row.face_id);
                chosen.push(row);
            }
            None => chosen.extend(group.into_iter().next().map(lost)),
        }
    }
    chosen
}

/// The row of a frame in which the followed face was not found.
fn lost(mut row: TrackRow) -> TrackRow {
    row.success = false;
    row.confidence = 0.0;
    row.intensities.fill(None);
    row.presences.fill(None);
    row.landmarks = None;
    row.landmarks_in_camera_mm = None;
    row.head_pose = None;
    row
}
