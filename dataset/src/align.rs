//! Takes, tracks and cameras brought together: rows and images are joined by frame number, never by position, and the
//! worlds of several takes by the face that is in all of them.

use std::collections::BTreeMap;
use std::path::Path;

use glam::{DMat3, DVec3};
use nalgebra::{Matrix3, Vector3};
use risorius_formats::pose_report::PoseReport;
use risorius_formats::{
    Camera, ErrorKind, FormatError, FrameIndex, Intrinsics, Isometry, Reporter, Take, Track, colmap, openface,
};

use crate::error::{DatasetError, Result};

/// A tracked and posed take.
#[derive(Debug)]
pub struct TakeInput {
    /// The take.
    pub take: Take,
    /// The name of its folder.
    pub name: String,
    /// Its track.
    pub track: Track,
    /// The camera of each posed frame, for the full-size image.
    pub cameras: BTreeMap<u32, Camera>,
    /// How the cameras were found.
    pub report: PoseReport,
}

impl TakeInput {
    /// Opens a take with its track and its poses.
    pub fn open(dir: &Path, reporter: &dyn Reporter) -> Result<Self> {
        let take = Take::open(dir)?;
        let name = std::path::absolute(dir).ok().and_then(|d| d.file_name().map(|n| n.to_string_lossy().into_owned()));
        let path = take.openface_path();
        if !path.exists() {
            return Err(FormatError::new(ErrorKind::Missing, "the take is not tracked yet")
                .in_file(&path)
                .with_hint("run `tracker run TAKE`, or `tracker import TAKE --openface FILE.csv`")
                .into());
        }
        let track = openface::read(&path, &openface::ReadOptions::default(), reporter)?;
        let path = take.pose_report_path();
        if !path.exists() || !take.sparse_dir().is_dir() {
            return Err(FormatError::new(ErrorKind::Missing, "the take has no cameras yet")
                .in_file(&path)
                .with_hint("run `tracker poses TAKE`")
                .into());
        }
        let report = PoseReport::read(&path)?;
        if !(report.near > 0.0 && report.far > report.near && report.far.is_finite()) {
            let message = format!("near {} and far {} bound nothing", report.near, report.far);
            return Err(FormatError::new(ErrorKind::Inconsistent, message)
                .in_file(&path)
                .with_hint("run `tracker poses TAKE` again")
                .into());
        }
        let cameras = read_cameras(&take)?;
        Ok(Self { take, name: name.unwrap_or_else(|| "take".to_owned()), track, cameras, report })
    }
}

fn read_cameras(take: &Take) -> Result<BTreeMap<u32, Camera>> {
    let dir = take.sparse_dir();
    let model = colmap::read_model(&dir)?;
    let images_path = dir.join("images.txt");
    let expected = (take.manifest.width, take.manifest.height);
    let mut intrinsics: BTreeMap<u32, Intrinsics> = BTreeMap::new();
    for (&id, camera) in &model.cameras {
        let found = (u32::try_from(camera.width).unwrap_or(u32::MAX), u32::try_from(camera.height).unwrap_or(u32::MAX));
        if found != expected {
            return Err(DatasetError::Size { path: dir.join("cameras.txt"), what: "the take has", expected, found });
        }
        intrinsics.insert(id, camera.intrinsics().map_err(|e| e.in_file(dir.join("cameras.txt")))?);
    }
    let mut cameras = BTreeMap::new();
    for image in model.images.values() {
        let bad = |message: String| FormatError::new(ErrorKind::Inconsistent, message).in_file(&images_path);
        let frame = FrameIndex::from_image_name(&image.name, 0)
            .ok_or_else(|| bad(format!("the image name `{}` has no frame number", image.name)))?;
        if frame.0 >= take.manifest.frame_count {
            return Err(
                bad(format!("image `{}`: the take has only {} frames", image.name, take.manifest.frame_count)).into()
            );
        }
        let lens = intrinsics.get(&image.camera_id).ok_or_else(|| {
            bad(format!("image `{}` names camera {}, which is not there", image.name, image.camera_id))
        })?;
        if cameras.insert(frame.0, Camera { intrinsics: *lens, camera_from_world: image.camera_from_world }).is_some() {
            return Err(bad(format!("two images are frame {}", frame.0)).into());
        }
    }
    Ok(cameras)
}

/// A similarity: `p_a = scale · rotation · p_b + translation` for an `a_from_b`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Similarity {
    /// Units of a per unit of b.
    pub scale: f64,
    /// A proper rotation.
    pub rotation: DMat3,
    /// In the units of a.
    pub translation: DVec3,
}

impl Similarity {
    /// Leaves everything where it is.
    pub const IDENTITY: Self = Self { scale: 1.0, rotation: DMat3::IDENTITY, translation: DVec3::ZERO };

    /// The point in the target space.
    pub fn transform_point(&self, p: DVec3) -> DVec3 {
        self.rotation * p * self.scale + self.translation
    }

    /// The same camera, for the target space instead of the source space.
    pub fn move_camera(&self, camera: &Camera) -> Camera {
        let center = self.transform_point(camera.center());
        let rotation = camera.camera_from_world.rotation * self.rotation.transpose();
        Camera { intrinsics: camera.intrinsics, camera_from_world: Isometry::new(rotation, -(rotation * center)) }
    }
}

/// The similarity that best takes `from` to `to` (Umeyama 1991), and the root mean square of what is left, in units
/// of `to`. `None` for fewer than three points, unequal counts, or points in one line or one place.
pub fn fit_similarity(from: &[DVec3], to: &[DVec3]) -> Option<(Similarity, f64)> {
    if from.len() != to.len() || from.len() < 3 {
        return None;
    }
    let n = from.len() as f64;
    let mean = |points: &[DVec3]| points.iter().sum::<DVec3>() / n;
    let (mean_from, mean_to) = (mean(from), mean(to));
    let vector = |p: DVec3| Vector3::new(p.x, p.y, p.z);
    let mut covariance = Matrix3::zeros();
    let mut variance = 0.0;
    for (&a, &b) in from.iter().zip(to) {
        covariance += vector(b - mean_to) * vector(a - mean_from).transpose() / n;
        variance += (a - mean_from).length_squared() / n;
    }
    let svd = covariance.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    let mut order = [svd.singular_values[0], svd.singular_values[1], svd.singular_values[2]];
    order.sort_by(f64::total_cmp);
    // Written so that a NaN is refused.
    if !(order[1] > 1e-9 * order[2] && variance > 0.0) {
        return None;
    }
    let mut sign = Matrix3::identity();
    if (u * v_t).determinant() < 0.0 {
        // The direction with the smallest singular value is the one to mirror.
        sign[(svd.singular_values.imin(), svd.singular_values.imin())] = -1.0;
    }
    let r = u * sign * v_t;
    let scale = (Matrix3::from_diagonal(&svd.singular_values) * sign).trace() / variance;
    let rotation = DMat3::from_cols_array(&std::array::from_fn(|i| r[(i % 3, i / 3)]));
    let similarity = Similarity { scale, rotation, translation: mean_to - rotation * mean_from * scale };
    let squares: f64 = from.iter().zip(to).map(|(&a, &b)| (similarity.transform_point(a) - b).length_squared()).sum();
    Some((similarity, (squares / n).sqrt()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_similarity_is_found_again(q in prop::array::uniform4(-1f64..1.0), t in prop::array::uniform3(-5f64..5.0), scale in 0.1f64..10.0,
            points in prop::collection::vec(prop::array::uniform3(-1f64..1.0), 6..20)) {
            prop_assume!(q.iter().map(|v| v * v).sum::<f64>() > 1e-2);
            let truth = Similarity { scale, rotation: Isometry::from_wxyz(q, DVec3::ZERO).rotation, translation: DVec3::from(t) };
            let from: Vec<_> = points.into_iter().map(DVec3::from).collect();
            let to: Vec<_> = from.iter().map(|&p| truth.transform_point(p)).collect();
            let (found, rms) = fit_similarity(&from, &to).unwrap();
            prop_assert!(rms < 1e-9 && (found.scale / scale - 1.0).abs() < 1e-9);
            prop_assert!((found.rotation - truth.rotation).to_cols_array().iter().all(|v| v.abs() < 1e-8));
            // A moved camera sees the moved point at the same pixel.
            let camera = Camera { intrinsics: Intrinsics::pinhole(640, 480, 500.0), camera_from_world: Isometry::new(DMat3::IDENTITY, DVec3::new(0.1, 0.2, 4.0)) };
            let moved = found.move_camera(&camera);
            for (a, b) in from.iter().zip(&to) {
                prop_assert!((camera.project(*a) - moved.project(*b)).length() < 1e-6);
            }
        }
    }

    #[test]
    fn what_has_no_shape_is_refused() {
        let line: Vec<_> = (0..5).map(|i| DVec3::X * f64::from(i)).collect();
        assert!(fit_similarity(&line, &line).is_none());
        assert!(fit_similarity(&line[..2], &line[..2]).is_none());
        assert!(fit_similarity(&[DVec3::ONE; 4], &[DVec3::ONE; 4]).is_none());
        assert!(fit_similarity(&line, &line[..4]).is_none());
    }
}
