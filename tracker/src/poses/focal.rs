//! The camera that a tracker assumed, from its own 3-D and 2-D landmarks.
//!
//! OpenFace writes every landmark twice: in the image and in camera space. `u = f X/Z + cx`, `v = f Y/Z + cy` is linear in
//! f, cx and cy, so three least-squares numbers tell its focal length and the middle of the picture it saw.

use nalgebra::{Matrix3, Vector3};
use risorius_formats::TrackRow;

/// The camera of a table.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TableCamera {
    /// Focal length, pixels.
    pub focal_px: f64,
    /// Principal point x, pixels.
    pub cx: f64,
    /// Principal point y, pixels.
    pub cy: f64,
    /// Median distance between the landmarks and the projected 3-D landmarks, pixels.
    pub median_error_px: f64,
}

/// Fits the camera to the rows' landmarks; `None` without 3-D landmarks or when they say nothing about the focal length.
pub fn table_camera<'a>(rows: impl IntoIterator<Item = &'a TrackRow>) -> Option<TableCamera> {
    let samples: Vec<[f64; 4]> = rows
        .into_iter()
        .filter(|r| r.success)
        .filter_map(|r| Some((r.landmarks.as_ref()?, r.landmarks_in_camera_mm.as_ref()?)))
        .flat_map(|(flat, solid)| flat.points_px.iter().zip(solid.iter()))
        .map(|(p, q)| [p[0], p[1], q[0] / q[2], q[1] / q[2]].map(f64::from))
        .filter(|s| s.iter().all(|v| v.is_finite()))
        .collect();
    if samples.len() < 68 {
        return None;
    }
    let mut scale = f64::INFINITY;
    let mut camera = None;
    // Re-weighted with Cauchy weights: the 2-D and 3-D landmarks disagree where the fit of a frame failed.
    for _ in 0..8 {
        let mut normal = Matrix3::<f64>::zeros();
        let mut right = Vector3::<f64>::zeros();
        for s in &samples {
            let weight = camera.map_or(1.0, |c: TableCamera| {
                let r2 = residual(&c, s).powi(2);
                1.0 / (1.0 + r2 / (scale * scale))
            });
            for (row, value) in [(Vector3::new(s[2], 1.0, 0.0), s[0]), (Vector3::new(s[3], 0.0, 1.0), s[1])] {
                normal += row * row.transpose() * weight;
                right += row * (value * weight);
            }
        }
        let found = normal.cholesky()?.solve(&right);
        let mut next = TableCamera { focal_px: found[0], cx: found[1], cy: found[2], median_error_px: 0.0 };
        let mut errors: Vec<f64> = samples.iter().map(|s| residual(&next, s)).collect();
        next.median_error_px = super::triangulate::median(&mut errors)?;
        scale = (2.0 * next.median_error_px).max(0.05);
        camera = Some(next);
    }
    // A table whose two kinds of landmarks do not belong together, or whose 3-D is flat, gives nonsense.
    camera.filter(|c| c.focal_px.is_finite() && c.focal_px > 1.0 && c.median_error_px < 0.02 * c.focal_px)
}

fn residual(c: &TableCamera, s: &[f64; 4]) -> f64 {
    (c.focal_px * s[2] + c.cx - s[0]).hypot(c.focal_px * s[3] + c.cy - s[1])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(wild: bool) -> TrackRow {
        let solid: [[f32; 3]; 68] = std::array::from_fn(|i| {
            let t = i as f32;
            [(t * 1.3).sin() * 70.0 + 15.0, (t * 0.7).cos() * 90.0 - 20.0, 500.0 + (t * 0.4).sin() * 40.0]
        });
        let flat = solid.map(|[x, y, z]| {
            let off = if wild { 60.0 } else { 0.0 };
            [900.0 * x / z + 320.0 + off, 900.0 * y / z + 240.0 - off]
        });
        TrackRow { landmarks_in_camera_mm: Some(Box::new(solid)), ..crate::testing::row(0, &flat) }
    }

    #[test]
    fn the_camera_of_the_table_is_found_in_spite_of_bad_frames() {
        let rows = [row(false), row(false), row(true), row(false), row(false)];
        let camera = table_camera(&rows).unwrap();
        assert!((camera.focal_px - 900.0).abs() < 1.0, "{camera:?}");
        assert!((camera.cx - 320.0).abs() < 0.5 && (camera.cy - 240.0).abs() < 0.5, "{camera:?}");
    }

    #[test]
    fn a_table_without_3d_landmarks_says_nothing() {
        let rows = [TrackRow { landmarks_in_camera_mm: None, ..row(false) }];
        assert_eq!(table_camera(&rows), None);
        // Zeros, as lost rows have them, are no landmarks either.
        let rows = [TrackRow { landmarks_in_camera_mm: Some(Box::new([[0.0; 3]; 68])), ..row(false) }];
        assert_eq!(table_camera(&rows), None);
    }
}
