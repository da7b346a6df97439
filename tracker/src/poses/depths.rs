//! Where the head is, and where sampling along rays may start and end.
//!
//! The face comes from the tracked landmarks, not from the feature points of the background: selfie captures whose near
//! plane came from background points were cut off in front of the nose.

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use risorius_formats::{Isometry, Track, TrackRow};

use super::model::TakeModel;
use super::triangulate::{MIN_PARALLAX_RAD, View, median, triangulate};
use crate::error::{Result, TrackerError};

/// Near plane in shares of the smallest face depth.
const NEAR_SHARE: f64 = 0.8;
/// Far plane in multiples of the background's depth.
const FAR_SHARE: f64 = 1.1;
/// With a background of unknown depth the far plane lies this many head radii behind the face.
const FAR_RADII: f64 = 3.0;

/// The head in the world.
#[derive(Clone, Debug, PartialEq)]
pub struct Head {
    /// The 68 landmarks of the mean face.
    pub landmarks: Vec<DVec3>,
    /// Their mean.
    pub center: DVec3,
    /// Distance of the farthest of them from the mean.
    pub radius: f64,
    /// Median distance between tracked and reprojected landmarks, pixels.
    pub landmark_error_px: f64,
}

impl Head {
    /// Smallest and largest depth of `points` over the cameras; points behind a camera do not count.
    pub fn depths<'a>(points: &[DVec3], poses: impl IntoIterator<Item = &'a Isometry>) -> Option<[f64; 2]> {
        let mut range: Option<[f64; 2]> = None;
        for pose in poses {
            for &point in points {
                let z = pose.transform_point(point).z;
                if z > 0.0 {
                    let [lo, hi] = range.unwrap_or([z, z]);
                    range = Some([lo.min(z), hi.max(z)]);
                }
            }
        }
        range
    }
}

/// Triangulates the 68 landmarks over the frames that were placed by themselves.
pub fn find_head(model: &TakeModel, track: &Track, min_confidence: f32) -> Result<Head> {
    let rows: Vec<(&TrackRow, u32)> = track
        .rows
        .iter()
        .filter(|r| r.is_valid(min_confidence) && r.landmarks.is_some())
        .map(|r| (r, r.frame.0))
        .collect();
    let view = |row: &TrackRow, frame: u32, landmark: usize| {
        let p = row.landmarks.as_ref()?.points_px[landmark];
        View::new(&model.camera(frame)?, DVec2::new(f64::from(p[0]), f64::from(p[1])))
    };
    let found: Vec<_> = (0..68)
        .into_par_iter()
        .map(|i| {
            let views: Vec<View> = rows.iter().filter_map(|&(row, frame)| view(row, frame, i)).collect();
            triangulate(&views).filter(|t| t.parallax_rad >= MIN_PARALLAX_RAD)
        })
        .collect();
    let good = found.iter().flatten().count();
    // A landmark or two may lie outside the picture all the time; a face needs most of them.
    if good < 60 {
        return Err(TrackerError::TooLittleParallax { good });
    }
    let center = found.iter().flatten().map(|t| t.point).sum::<DVec3>() / good as f64;
    let landmarks: Vec<DVec3> = found.iter().map(|t| t.map_or(center, |t| t.point)).collect();
    let radius = landmarks.iter().map(|p| p.distance(center)).fold(0.0, f64::max);
    let mut errors: Vec<f64> = found.iter().flatten().map(|t| t.median_error_px).collect();
    let landmark_error_px = median(&mut errors).unwrap_or(0.0);
    Ok(Head { landmarks, center, radius, landmark_error_px })
}

/// near and far of the sampling, and the background's depth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Range {
    /// Sampling starts here.
    pub near: f64,
    /// And ends here.
    pub far: f64,
    /// 0.1 % and 99.9 % quantile of the points' depths.
    pub background: Option<[f64; 2]>,
}

/// near from the face alone; far behind the face and 99.5 % of the points.
pub fn range(head_depth: [f64; 2], head_radius: f64, mut point_depths: Vec<f64>) -> Range {
    let near = NEAR_SHARE * head_depth[0];
    let behind_head = head_depth[1] + FAR_RADII * head_radius;
    point_depths.sort_unstable_by(f64::total_cmp);
    let quantile = |q: f64| point_depths.get(((point_depths.len() - 1) as f64 * q).round() as usize).copied();
    // A handful of points is no background.
    if point_depths.len() < 20 {
        return Range { near, far: behind_head, background: None };
    }
    let far = quantile(0.995).map_or(behind_head, |q| (FAR_SHARE * q).max(behind_head));
    Range { near, far, background: quantile(0.001).zip(quantile(0.999)).map(|(a, b)| [a, b]) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn near_comes_from_the_face_and_far_from_the_background() {
        // Points from 0.2 (a mistaken one in front of the face) to 8.
        let depths: Vec<f64> = (0..2000).map(|i| 0.2 + 7.8 * f64::from(i) / 1999.0).collect();
        let r = range([0.5, 0.7], 0.1, depths);
        assert!((r.near - 0.4).abs() < 1e-12);
        assert!((r.far - 1.1 * (0.2 + 7.8 * 0.995)).abs() < 0.01);
        let [lo, hi] = r.background.unwrap();
        assert!((lo - 0.2).abs() < 0.02 && (hi - 8.0).abs() < 0.02);
    }

    #[test]
    fn without_background_far_lies_behind_the_head() {
        let r = range([0.5, 0.7], 0.1, vec![]);
        assert_eq!((r.near, r.background), (0.4, None));
        assert!((r.far - 1.0).abs() < 1e-12);
        // A wall that touches the nose must not cut the head off.
        assert!((range([0.5, 0.7], 0.1, vec![0.5; 100]).far - 1.0).abs() < 1e-12);
    }

    #[test]
    fn points_behind_a_camera_have_no_depth() {
        let pose = Isometry::IDENTITY;
        let points = [DVec3::new(0.0, 0.0, 2.0), DVec3::new(0.0, 0.0, -1.0), DVec3::new(1.0, 0.0, 3.0)];
        assert_eq!(Head::depths(&points, [&pose]), Some([2.0, 3.0]));
        assert_eq!(Head::depths(&points[1..2], [&pose]), None);
    }
}
