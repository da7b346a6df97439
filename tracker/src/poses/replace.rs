//! Whether poses that exist may be replaced by others.

use risorius_formats::pose_report::{PoseMethod, PoseReport};
use risorius_formats::{Reporter, Take, Warning};

use crate::error::{Result, TrackerError};

/// A mean face so many times farther from the landmarks makes poses worse …
const WORSE: f64 = 1.5;
/// … and one so many times farther is worth a word.
const WORTH_A_WORD: f64 = 1.1;
/// Distances below this are the noise of landmarks, pixels.
const NOISE_PX: f64 = 0.5;
/// Poses for fewer frames than this share of those that had one are worse.
const FEWER: f64 = 0.9;

/// Fails where `new` is clearly worse than the poses that the take has, unless that is accepted; warns where it is a little
/// worse.
pub(super) fn check(take: &Take, new: &PoseReport, accept: bool, reporter: &dyn Reporter) -> Result<()> {
    // A report that cannot be read is worth nothing.
    let Ok(old) = PoseReport::read(take.pose_report_path()) else { return Ok(()) };
    let Some((difference, refused)) = worse(&old, new) else { return Ok(()) };
    if refused && !accept {
        return Err(TrackerError::WorsePoses { path: take.pose_report_path(), difference });
    }
    reporter.warn(Warning::new("worse-poses", format!("the take had better poses, which are replaced: {difference}")));
    Ok(())
}

/// In what `new` is worse than `old`, and whether by much.
fn worse(old: &PoseReport, new: &PoseReport) -> Option<(String, bool)> {
    let posed = |r: &PoseReport| r.frames_registered + r.frames_followed + r.frames_interpolated;
    if f64::from(posed(new)) < FEWER * f64::from(posed(old)) {
        return Some((format!("{} frames with a pose instead of {}", posed(new), posed(old)), true));
    }
    let (before, after) = (old.landmark_error_px?, new.landmark_error_px?);
    let times = after.max(NOISE_PX) / before.max(NOISE_PX);
    // The head route fits the landmarks by itself: cameras that see the room cannot come as near.
    let alike = (old.method == PoseMethod::Head) == (new.method == PoseMethod::Head);
    (times > WORTH_A_WORD).then(|| {
        let text = format!("the mean face misses the landmarks by {after:.2} px instead of {before:.2} px");
        (text, alike && times > WORSE)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_clearly_worse_poses_are_refused() {
        let text = include_str!("../../tests/data/pose_report.json");
        let old: PoseReport = serde_json::from_str(text).unwrap();
        let new = |px: f64| PoseReport { landmark_error_px: Some(px), ..old.clone() };
        let of = |new: &PoseReport| worse(&old, new).map(|w| w.1);
        assert_eq!(old.landmark_error_px, Some(1.0));
        assert_eq!((of(&new(1.05)), of(&new(1.3)), of(&new(1.6))), (None, Some(false), Some(true)));
        assert_eq!(of(&PoseReport { frames_registered: 80, ..old.clone() }), Some(true));
        let head = PoseReport { method: PoseMethod::Head, ..new(3.0) };
        assert_eq!(of(&head), Some(false));
    }
}
