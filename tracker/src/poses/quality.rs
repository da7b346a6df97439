//! Whether the cameras can be trusted, and what to do when they cannot.

use risorius_formats::pose_report::{PoseMethod, PoseReport};
use risorius_formats::{Take, Track};

use super::triangulate::median;

/// Points miss the features by at most this share of the longer side.
const MOST_ERROR_SHARE: f64 = 0.002;
/// … and on the skin, which moves with the expression, by this.
const MOST_SKIN_SHARE: f64 = 0.006;
/// Rigid landmarks of the head route miss by at most this share of the longer side.
const MOST_LANDMARK_SHARE: f64 = 0.02;
/// The mean face of a foreign model misses by at most this share of the distance between the outer corners of the eyes:
/// cameras of other frames miss by more.
const MOST_EYE_SHARE: f64 = 0.08;
/// Frames that have to get a pose.
const LEAST_POSED: f64 = 0.9;
/// The focal length has to be known this well.
const MOST_FOCAL_SHARE: f64 = 0.02;

/// Something that is wrong with the cameras.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Problem {
    pub(crate) what: String,
    pub(crate) advice: &'static str,
}

/// What errors are compared with.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sizes {
    /// The picture's longer side, pixels.
    pub(crate) longer_side_px: f64,
    /// Median distance between the outer corners of the eyes, pixels.
    pub(crate) eyes_px: Option<f64>,
}

impl Sizes {
    pub(crate) fn of(take: &Take, track: &Track, min_confidence: f32) -> Self {
        let valid = track.rows.iter().filter(|r| r.is_valid(min_confidence));
        let mut eyes: Vec<f64> = valid
            .filter_map(|r| r.landmarks.as_ref())
            .map(|l| (l.points_px[36], l.points_px[45]))
            .map(|(a, b)| f64::from((a[0] - b[0]).hypot(a[1] - b[1])))
            .collect();
        let longer_side_px = f64::from(take.manifest.width.max(take.manifest.height));
        Self { longer_side_px, eyes_px: median(&mut eyes) }
    }
}

/// What speaks against the cameras of a report. `focal_share` is the deviation of the focal length over itself.
pub(crate) fn problems(report: &PoseReport, sizes: Sizes, focal_share: Option<f64>) -> Vec<Problem> {
    let mut found = Vec::new();
    let side = sizes.longer_side_px;
    let posed = report.frames_registered + report.frames_followed + report.frames_interpolated;
    let colmap = report.method == PoseMethod::Colmap;
    if f64::from(posed) < LEAST_POSED * f64::from(report.frames) {
        found.push(Problem {
            what: format!("only {posed} of {} frames have a pose", report.frames),
            advice: match report.method {
                PoseMethod::Colmap => "move slowly, keep the background in the picture, and leave cuts out",
                PoseMethod::ColmapModel => {
                    "make the model from more frames, or leave the rest of the video out of the take"
                }
                PoseMethod::Head => "keep the face in the picture and lit",
            },
        });
    }
    let most = if colmap { MOST_ERROR_SHARE } else { MOST_SKIN_SHARE };
    if let Some(error) = report.reprojection_error_px.filter(|e| *e > most * side) {
        found.push(Problem {
            what: format!("points miss their features by {error:.2} px"),
            advice: "hold the head still against the background, and use more light so that nothing blurs",
        });
    }
    if let Some(share) = focal_share.filter(|s| colmap && *s > MOST_FOCAL_SHARE) {
        found.push(Problem {
            what: format!("the focal length is known to {:.1} % only", 100.0 * share),
            advice: "move the camera farther around the head before a background with texture (shelves, pictures, plants)",
        });
    }
    let foreign = report.method == PoseMethod::ColmapModel;
    let by_eyes = sizes.eyes_px.filter(|_| foreign).map_or(f64::INFINITY, |eyes| MOST_EYE_SHARE * eyes);
    let landmarks = report.landmark_error_px.filter(|e| *e > by_eyes.min(MOST_LANDMARK_SHARE * side));
    if let Some(error) = landmarks {
        found.push(Problem {
            what: format!("the mean face misses the landmarks by {error:.1} px"),
            advice: if foreign {
                "are its images frames of this take? `--colmap-first`, `--colmap-step` and `--colmap-folder` state which; and look at the landmarks (`tracker check TAKE --overlay FILE.mp4`)"
            } else {
                "look at the landmarks (`tracker check TAKE --overlay FILE.mp4`): were they on the face?"
            },
        });
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    fn report() -> PoseReport {
        PoseReport {
            method: PoseMethod::Colmap,
            frames: 100,
            frames_tried: 20,
            frames_registered: 20,
            frames_followed: 75,
            frames_interpolated: 5,
            registered_share: 1.0,
            reprojection_error_px: Some(0.3),
            landmark_error_px: Some(3.0),
            head_center: DVec3::ZERO,
            head_radius: 0.1,
            head_depth: [0.4, 0.6],
            near: 0.3,
            far: 2.0,
            background_depth: None,
            units_per_metre: None,
            landmarks_in_world: vec![],
            head_hull_in_world: None,
            head_box: None,
            interpolated_runs: vec![],
            problems: vec![],
            seconds: 0.0,
            notes: vec![],
        }
    }

    fn problems(report: &PoseReport, side: u32, focal_share: Option<f64>) -> Vec<Problem> {
        super::problems(report, Sizes { longer_side_px: f64::from(side), eyes_px: Some(100.0) }, focal_share)
    }

    #[test]
    fn each_flaw_is_named_with_advice_and_a_good_result_has_none() {
        assert!(problems(&report(), 960, Some(0.001)).is_empty());
        let poor = [
            PoseReport { frames_followed: 60, ..report() },
            PoseReport { reprojection_error_px: Some(2.1), ..report() },
            PoseReport { landmark_error_px: Some(30.0), ..report() },
        ];
        for report in &poor {
            assert_eq!(problems(report, 960, Some(0.001)).len(), 1, "{report:?}");
        }
        let vague = problems(&report(), 960, Some(0.04));
        assert!(vague[0].what.contains("4.0 %") && vague[0].advice.contains("texture"));
        // Of a foreign model the face's size is the measure.
        let foreign = |px| PoseReport { method: PoseMethod::ColmapModel, landmark_error_px: Some(px), ..report() };
        assert_eq!([7.0, 9.0].map(|px| problems(&foreign(px), 960, None).len()), [0, 1]);
        // A finished model brings no deviations, and the head route has none.
        assert!(problems(&PoseReport { method: PoseMethod::Head, ..report() }, 960, Some(0.04)).is_empty());
    }
}
