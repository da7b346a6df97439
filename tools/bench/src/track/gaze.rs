//! Gaze: against exact directions of a rendered capture, and against OpenFace's angles on a real clip.

use glam::{DMat3, DVec3};

use super::columns::Columns;

/// AU45 from which an eye counts as closed.
const CLOSED: f64 = 1.0;

/// The columns of a table that have both eyes' directions.
const COLUMNS: [&str; 6] = ["gaze_0_x", "gaze_0_y", "gaze_0_z", "gaze_1_x", "gaze_1_y", "gaze_1_z"];

/// The mean of both eyes' directions in each row, camera axes: zero in a row without gaze, and no rows at all where the table
/// has no gaze columns.
pub(crate) fn directions(table: &Columns) -> Vec<DVec3> {
    let Some([a, b, c, d, e, f]) = table.get(COLUMNS) else { return Vec::new() };
    let mean = |i: usize| (DVec3::new(a[i], b[i], c[i]) + DVec3::new(d[i], e[i], f[i])).normalize_or_zero();
    (0..table.rows).map(mean).collect()
}

/// OpenFace's gaze angles of a direction: to the image's right and down, radians.
pub(crate) fn angles(direction: DVec3) -> [f64; 2] {
    [direction.x.atan2(-direction.z), direction.y.atan2(-direction.z)]
}

/// Mean angle (degrees) between the gaze and the truth over frames whose eyes are open. `gaze_deg` are yaw to the image's right
/// and pitch up, against the head; `blinks` the AU45 of each frame.
pub(crate) fn error_deg(rows: &[DVec3], head: &[DMat3], gaze_deg: &[[f64; 2]], blinks: &[f64]) -> Option<f64> {
    let errors: Vec<f64> = rows
        .iter()
        .zip(head)
        .zip(gaze_deg.iter().zip(blinks))
        .filter(|((row, _), (_, blink))| **blink < CLOSED && **row != DVec3::ZERO)
        .map(|((row, head), (&[yaw, pitch], _))| {
            let (yaw, pitch) = (yaw.to_radians(), pitch.to_radians());
            let truth = *head * DVec3::new(yaw.sin() * pitch.cos(), -pitch.sin(), -yaw.cos() * pitch.cos());
            row.angle_between(truth).to_degrees()
        })
        .collect();
    (!errors.is_empty()).then(|| errors.iter().sum::<f64>() / errors.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gaze_ahead_of_a_turned_head_has_no_error() {
        let head = DMat3::from_rotation_y(0.2);
        let ahead = head * DVec3::new(0.0, 0.0, -1.0);
        assert!(error_deg(&[ahead], &[head], &[[0.0; 2]], &[0.0]).unwrap() < 1e-6);
        assert!((error_deg(&[ahead], &[head], &[[0.0, 5.0]], &[0.0]).unwrap() - 5.0).abs() < 1e-6);
        assert_eq!(error_deg(&[ahead], &[head], &[[0.0; 2]], &[3.0]), None);
    }
}
