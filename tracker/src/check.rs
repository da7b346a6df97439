//! How good a take's track and poses are, alone or against a reference model.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use glam::DVec3;
use risorius_formats::au::OPENFACE_INTENSITIES;
use risorius_formats::pose_report::PoseReport;
use risorius_formats::similarity::umeyama;
use risorius_formats::{ActionUnit, Camera, Isometry, Reporter, Take};
use serde::Serialize;

use crate::error::{Result, TrackerError};
use crate::import::MIN_CONFIDENCE;
use crate::parquet;
use crate::poses::model::{self, TakeModel};
use crate::poses::{Numbering, read_track};
use crate::quality::{self, TrackQuality};
use crate::se3::rotation_angle;

/// What to compare with.
#[derive(Clone, Debug)]
pub struct Reference {
    /// A COLMAP model.
    pub dir: PathBuf,
    /// What is known of the numbers in its image names.
    pub numbering: Numbering,
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
    /// How far the face landmarks move in the picture when the reference's camera takes the place of ours, pixels (mean
    /// over the landmarks): what an error means for whoever learns from these poses.
    pub face_shift_px: Spread,
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
pub fn check(
    take_dir: impl AsRef<Path>,
    reference: Option<&Reference>,
    reporter: &dyn Reporter,
) -> Result<CheckReport> {
    let take = Take::open(take_dir)?;
    let rows = read_track(&take)?;
    let mut track = quality::measure(&rows, take.frames.len(), MIN_CONFIDENCE);
    track.add_confidences(&mean_confidences(&take)?);
    let path = take.pose_report_path();
    let poses = if path.is_file() || reference.is_some() { Some(PoseReport::read(&path)?) } else { None };
    let reference = match (reference, &poses) {
        (Some(reference), Some(report)) => {
            let own = model::load(take.sparse_dir(), &take, 0, reporter)?.model;
            let rows = Some((&rows, MIN_CONFIDENCE));
            let other = model::load_foreign(&reference.dir, &take, rows, &reference.numbering, reporter)?.model.poses();
            Some(compare(&own, &other, report).ok_or_else(|| TrackerError::NothingInCommon {
                dir: reference.dir.clone(),
                common: own.frames.keys().filter(|f| other.contains_key(f)).count(),
            })?)
        }
        _ => None,
    };
    Ok(CheckReport { track, poses, reference })
}

/// The mean confidence of each AU over the frames that have one; none where the AUs are not the tracker's own.
fn mean_confidences(take: &Take) -> Result<Vec<(ActionUnit, f32)>> {
    let names = OPENFACE_INTENSITIES.map(|unit| format!("{unit}_confidence"));
    let columns = parquet::read_floats(&parquet::path(take), &names)?;
    let mean = |(unit, name): (&ActionUnit, &String)| {
        let known: Vec<f64> = columns.get(name)?.iter().flatten().map(|c| f64::from(*c)).collect();
        (!known.is_empty()).then(|| (*unit, (known.iter().sum::<f64>() / known.len() as f64) as f32))
    };
    Ok(OPENFACE_INTENSITIES.iter().zip(&names).filter_map(mean).collect())
}

/// Errors of `own` against `reference` after bringing the camera centres of the placed frames together; `None` with fewer
/// than 3 common frames.
pub fn compare(own: &TakeModel, reference: &BTreeMap<u32, Isometry>, report: &PoseReport) -> Option<ReferenceErrors> {
    let common: Vec<(Camera, Isometry, u32)> =
        own.frames.keys().filter_map(|&f| Some((own.camera(f)?, *reference.get(&f)?, f))).collect();
    let is_interpolated = |frame: u32| report.interpolated_runs.iter().any(|r| (r[0]..=r[1]).contains(&frame));
    let centers: Vec<_> = common.iter().map(|(a, b, _)| (b.camera_center(), a.center())).collect();
    // Interpolated frames are to be judged, not to decide where the worlds meet.
    let placed = common.iter().zip(&centers).filter(|((_, _, frame), _)| !is_interpolated(*frame));
    let placed: Vec<_> = placed.map(|(_, centers)| *centers).collect();
    let reference_from_own = umeyama(&placed, true).or_else(|| umeyama(&centers, true))?.a_from_b;
    let error = |(a, b, frame): &(Camera, Isometry, u32)| {
        let moved = reference_from_own.transform_pose(&a.camera_from_world);
        let angle = rotation_angle(&(moved.rotation * b.rotation.transpose())).to_degrees();
        let shift = |p: &DVec3| {
            let there = b.transform_point(reference_from_own.transform_point(*p));
            a.intrinsics.project(there).distance(a.project(*p))
        };
        let face = &report.landmarks_in_world;
        let shift_px = face.iter().map(shift).sum::<f64>() / face.len().max(1) as f64;
        (*frame, angle, moved.camera_center().distance(b.camera_center()), shift_px)
    };
    let errors: Vec<(u32, f64, f64, f64)> = common.iter().map(error).collect();
    let of = |keep: &dyn Fn(u32) -> bool| {
        let kept: Vec<_> = errors.iter().filter(|e| keep(e.0)).collect();
        Some(PoseErrors {
            frames: kept.len(),
            rotation_deg: Spread::of(kept.iter().map(|e| e.1).collect())?,
            position: Spread::of(kept.iter().map(|e| e.2).collect())?,
            face_shift_px: Spread::of(kept.iter().map(|e| e.3).collect())?,
        })
    };
    let n = centers.len() as f64;
    let mean = centers.iter().map(|c| c.0).sum::<DVec3>() / n;
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
    use risorius_formats::Similarity;

    use super::*;
    use crate::poses::model::PlacedFrame;
    use crate::se3::{self, Twist};
    use risorius_formats::Intrinsics;
    use risorius_formats::pose_report::PoseMethod;

    fn poses() -> BTreeMap<u32, Isometry> {
        (0..40u32)
            .map(|i| {
                let t = f64::from(i) * 0.1;
                let twist =
                    [0.1 * t.sin(), 0.1 * t.cos(), 0.1, 0.3 * t.cos(), 0.3 * t.sin(), 4.0 + 0.1 * (2.0 * t).sin()];
                (i, se3::exp(Twist::from_array(twist)))
            })
            .collect()
    }

    fn model(poses: &BTreeMap<u32, Isometry>) -> TakeModel {
        let frame = |(&f, &camera_from_world)| (f, PlacedFrame { lens: 1, camera_from_world, points: vec![] });
        TakeModel {
            lenses: [(1, Intrinsics::pinhole(100, 100, 100.0))].into(),
            frames: poses.iter().map(frame).collect(),
            points: [].into(),
        }
    }

    fn report(interpolated_runs: Vec<[u32; 2]>) -> PoseReport {
        PoseReport {
            method: PoseMethod::Colmap,
            frames: 40,
            frames_tried: 40,
            frames_registered: 40,
            frames_followed: 0,
            frames_interpolated: 0,
            registered_share: 1.0,
            reprojection_error_px: None,
            landmark_error_px: None,
            head_center: DVec3::ZERO,
            head_radius: 0.1,
            head_depth: [3.0, 5.0],
            near: 1.0,
            far: 9.0,
            background_depth: None,
            units_per_metre: None,
            landmarks_in_world: vec![DVec3::ZERO; 68],
            head_hull_in_world: None,
            head_box: None,
            problems: vec![],
            interpolated_runs,
            seconds: 0.0,
            notes: vec![],
        }
    }

    #[test]
    fn another_world_is_no_error_and_a_turned_camera_is() {
        let reference = poses();
        let rotation = se3::rotation_exp(DVec3::new(1.0, 0.5, -0.7));
        let similarity = Similarity { scale: 3.0, rotation, translation: DVec3::new(4.0, 5.0, 6.0) };
        let mut own: BTreeMap<u32, Isometry> =
            reference.iter().map(|(&f, p)| (f, similarity.transform_pose(p))).collect();
        let mut face = report(vec![]);
        // The same face in the other world.
        face.landmarks_in_world = vec![similarity.transform_point(DVec3::new(0.1, 0.0, 0.0)); 68];
        let errors = compare(&model(&own), &reference, &face).unwrap();
        assert!(errors.all.rotation_deg.max < 1e-6 && errors.all.position.max < 1e-9);
        assert!((errors.scale * 3.0 - 1.0).abs() < 1e-9 && errors.all.face_shift_px.max < 1e-6);
        assert_eq!((errors.interpolated, errors.registered.unwrap().frames), (None, 40));
        // A camera that turns about its own centre by 1° moves the picture by 1.75 % of the focal length.
        let turned = own[&7];
        let turn = se3::rotation_exp(DVec3::X * 1f64.to_radians());
        own.insert(7, Isometry::new(turn * turned.rotation, turn * turned.translation));
        face.interpolated_runs = vec![[7, 8]];
        let errors = compare(&model(&own), &reference, &face).unwrap();
        let interpolated = errors.interpolated.unwrap();
        assert!((interpolated.rotation_deg.max - 1.0).abs() < 1e-6);
        assert!((interpolated.face_shift_px.max - 1.75).abs() < 0.1, "{:?}", interpolated.face_shift_px);
        assert!(errors.registered.unwrap().rotation_deg.max < 1e-6);
        own.retain(|f, _| *f < 2);
        assert!(compare(&model(&own), &reference, &face).is_none());
    }
}
