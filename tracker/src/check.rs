//! How good a take's track and poses are, alone or against a reference model.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use risorius_formats::pose_report::PoseReport;
use risorius_formats::{Isometry, Reporter, Take};
use serde::Serialize;

use crate::align::{Similarity, umeyama};
use crate::error::{Result, TrackerError};
use crate::import::MIN_CONFIDENCE;
use crate::poses::{model, read_track};
use crate::quality::{self, TrackQuality};
use crate::se3::rotation_angle;

/// What to compare with.
#[derive(Clone, Debug)]
pub struct Reference {
    /// A COLMAP model.
    pub dir: PathBuf,
    /// The number of the take's first frame in its image names.
    pub first: u32,
}

/// Everything that `tracker check` tells.
#[derive(Clone, Debug, Serialize)]
pub struct CheckReport {
    /// The track.
    pub track: TrackQuality,
    /// The poses, where they were found already.
    pub poses: Option<PoseReport>,
    /// Their errors against the reference.
    pub reference: Option<ReferenceErrors>,
}

/// Mean, median and largest of a set of errors.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Spread {
    /// Mean.
    pub mean: f64,
    /// Median.
    pub median: f64,
    /// Largest.
    pub max: f64,
}

impl Spread {
    fn of(mut values: Vec<f64>) -> Option<Self> {
        values.sort_unstable_by(f64::total_cmp);
        let max = *values.last()?;
        Some(Self { mean: values.iter().sum::<f64>() / values.len() as f64, median: values[values.len() / 2], max })
    }
}

/// Errors of a set of frames after the similarity alignment.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PoseErrors {
    /// Frames.
    pub frames: usize,
    /// Angle between the cameras, degrees.
    pub rotation_deg: Spread,
    /// Distance between the cameras, units of the reference.
    pub position: Spread,
}

/// Errors against a reference model.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ReferenceErrors {
    /// All common frames.
    pub all: PoseErrors,
    /// Frames placed by themselves.
    pub registered: Option<PoseErrors>,
    /// Interpolated frames.
    pub interpolated: Option<PoseErrors>,
    /// Units of the reference per unit of the take's world.
    pub scale: f64,
    /// Standard deviation of the reference's cameras from their mean, units of the reference: what errors relate to.
    pub camera_spread: f64,
}

/// Measures a take.
pub fn check(take_dir: impl AsRef<Path>, reference: Option<&Reference>, reporter: &dyn Reporter) -> Result<CheckReport> {
    let take = Take::open(take_dir)?;
    let track = quality::measure(&read_track(&take)?, take.frames.len(), MIN_CONFIDENCE);
    let path = take.pose_report_path();
    let poses = if path.is_file() || reference.is_some() { Some(PoseReport::read(&path)?) } else { None };
    let reference = match (reference, &poses) {
        (Some(reference), Some(report)) => {
            let own = model::load(take.sparse_dir(), &take, 0, reporter)?.model.poses();
            let other = model::load(&reference.dir, &take, reference.first, reporter)?.model.poses();
            Some(compare(&own, &other, &report.interpolated_runs).ok_or_else(|| TrackerError::NothingInCommon {
                dir: reference.dir.clone(),
                common: own.keys().filter(|f| other.contains_key(f)).count(),
            })?)
        }
        _ => None,
    };
    Ok(CheckReport { track, poses, reference })
}

/// Errors of `own` against `reference` after bringing the camera centres together; `None` with fewer than 3 common frames.
pub fn compare(
    own: &BTreeMap<u32, Isometry>,
    reference: &BTreeMap<u32, Isometry>,
    interpolated_runs: &[[u32; 2]],
) -> Option<ReferenceErrors> {
    let common: Vec<(u32, &Isometry, &Isometry)> =
        own.iter().filter_map(|(f, a)| reference.get(f).map(|b| (*f, a, b))).collect();
    let centers: Vec<_> = common.iter().map(|(_, a, b)| (b.camera_center(), a.camera_center())).collect();
    let reference_from_own: Similarity = umeyama(&centers, true)?;
    let error = |(frame, a, b): &(u32, &Isometry, &Isometry)| {
        let moved = reference_from_own.transform_pose(a);
        let angle = rotation_angle(&(moved.rotation * b.rotation.transpose())).to_degrees();
        (*frame, angle, moved.camera_center().distance(b.camera_center()))
    };
    let errors: Vec<(u32, f64, f64)> = common.iter().map(error).collect();
    let is_interpolated = |frame: u32| interpolated_runs.iter().any(|r| (r[0]..=r[1]).contains(&frame));
    let of = |keep: &dyn Fn(u32) -> bool| {
        let kept: Vec<_> = errors.iter().filter(|e| keep(e.0)).collect();
        Some(PoseErrors {
            frames: kept.len(),
            rotation_deg: Spread::of(kept.iter().map(|e| e.1).collect())?,
            position: Spread::of(kept.iter().map(|e| e.2).collect())?,
        })
    };
    let n = centers.len() as f64;
    let mean = centers.iter().map(|c| c.0).sum::<glam::DVec3>() / n;
    let camera_spread = (centers.iter().map(|c| c.0.distance_squared(mean)).sum::<f64>() / n).sqrt();
    Some(ReferenceErrors {
        all: of(&|_| true)?,
        registered: of(&|f| !is_interpolated(f)),
        interpolated: of(&is_interpolated),
        scale: reference_from_own.scale,
        camera_spread,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::se3::{self, Twist};
    use glam::DVec3;

    fn poses() -> BTreeMap<u32, Isometry> {
        (0..40u32)
            .map(|i| {
                let t = f64::from(i) * 0.1;
                (i, se3::exp(Twist::from_array([0.3 * t.sin(), 0.4 * t.cos(), 0.1, t.cos(), t.sin(), 0.3 * (2.0 * t).sin()])))
            })
            .collect()
    }

    #[test]
    fn another_world_is_no_error_and_a_turned_camera_is() {
        let reference = poses();
        let similarity = Similarity { scale: 3.0, rotation: se3::rotation_exp(DVec3::new(1.0, 0.5, -0.7)), translation: DVec3::new(4.0, 5.0, 6.0) };
        let mut own: BTreeMap<u32, Isometry> = reference.iter().map(|(&f, p)| (f, similarity.transform_pose(p))).collect();
        let errors = compare(&own, &reference, &[]).unwrap();
        assert!(errors.all.rotation_deg.max < 1e-6 && errors.all.position.max < 1e-9 && (errors.scale * 3.0 - 1.0).abs() < 1e-9);
        assert_eq!((errors.interpolated, errors.registered.unwrap().frames), (None, 40));
        // A camera that turns about its own centre by 1°.
        let turned = own[&7];
        let turn = se3::rotation_exp(DVec3::X * 1f64.to_radians());
        own.insert(7, Isometry::new(turn * turned.rotation, turn * turned.translation));
        let errors = compare(&own, &reference, &[[7, 8]]).unwrap();
        assert!((errors.interpolated.unwrap().rotation_deg.max - 1.0).abs() < 1e-6);
        assert!(errors.registered.unwrap().rotation_deg.max < 1e-6);
        assert!(compare(&own.into_iter().take(2).collect(), &reference, &[]).is_none());
    }
}
