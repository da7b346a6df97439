//! How far results are from the truth.

use std::path::Path;

use risorius_console::Failure;
use risorius_formats::{Silent, Track, openface};
use serde_json::Value;

/// A number of a JSON document, by the names on its way.
pub(crate) fn number(document: &Value, path: &[&str]) -> Option<f64> {
    path.iter().try_fold(document, |value, name| value.get(name))?.as_f64()
}

/// Mean distance of the landmarks of two tables, % of the distance between the outer corners of the eyes.
pub(crate) fn landmarks_percent(found: &Path, truth: &Path) -> Result<Option<f64>, Failure> {
    let read = |path: &Path| openface::read(path, &openface::ReadOptions::default(), &Silent);
    let (found, truth) = (read(found)?, read(truth)?);
    Ok(mean_percent(&found, &truth))
}

fn mean_percent(found: &Track, truth: &Track) -> Option<f64> {
    let mut sum = 0.0;
    let mut count = 0usize;
    for row in found.rows.iter().filter(|r| r.success) {
        let same = truth.rows.iter().find(|t| t.frame == row.frame);
        let (Some(a), Some(b)) = (&row.landmarks, same.and_then(|t| t.landmarks.as_ref())) else { continue };
        let distance = |p: [f32; 2], q: [f32; 2]| f64::from(p[0] - q[0]).hypot(f64::from(p[1] - q[1]));
        let eyes = distance(b.points_px[36], b.points_px[45]);
        // The outline of the jaw is where annotators differ most: the inner 51 points.
        let total: f64 = (17..68).map(|k| distance(a.points_px[k], b.points_px[k])).sum();
        sum += total / 51.0 / eyes.max(1.0) * 100.0;
        count += 1;
    }
    (count > 0).then(|| sum / count as f64)
}
