//! The head's own axes, and a convex body around the head: what is rigid with it, hair and open jaw included, and
//! nothing of the room.
//!
//! The head frame has x to the image's right, y down and z away from the camera. The face comes from the triangulated
//! landmarks; skull and hair, which have no landmarks, from proportions of heads: the crown is about as far above the
//! brows as the chin is below (0.9 times without hair), a skull is 1.3 times as long as it is wide.

use glam::{DMat3, DVec3};

use crate::Isometry;

/// The way from the head frame into the world of 68 triangulated `landmarks`, whose mean is the head frame's origin.
///
/// x runs from ear to ear and eye to eye, y from the brows to the chin at right angles to it. `None` unless there are 68
/// finite landmarks that span a face.
pub fn world_from_head(landmarks: &[DVec3]) -> Option<Isometry> {
    if landmarks.len() != 68 || !landmarks.iter().all(|p| p.is_finite()) {
        return None;
    }
    let origin = landmarks.iter().sum::<DVec3>() / 68.0;
    let brows = landmarks[17..27].iter().sum::<DVec3>() / 10.0;
    let x = ((landmarks[16] - landmarks[0]) + (landmarks[45] - landmarks[36])).try_normalize()?;
    let down = landmarks[8] - brows;
    let y = (down - x * down.dot(x)).try_normalize()?;
    Some(Isometry::new(DMat3::from_cols(x, y, x.cross(y)), origin))
}

/// Crown above the brows, in brow-to-chin heights, hair included.
const CROWN: f64 = 1.0;
/// Sideways and downward margin for ears, hair and cheeks.
const SIDE: f64 = 1.15;
/// Length of the skull in widths.
const LENGTH: f64 = 1.3;
/// Exponent on the sines of the skull's ellipsoid: 1 is an ellipsoid, 0 a box.
const FULLNESS: f64 = 0.8;
/// Margin below the chin, in brow-to-chin heights.
const BELOW: f64 = 0.06;

/// Corners of the body, head frame.
///
/// `landmarks`: the 68 points of the mean face; `chin_drop`: how far below its mean place the chin was ever seen.
pub fn head_hull(landmarks: &[DVec3], chin_drop: f64) -> Vec<DVec3> {
    let mean = |range: std::ops::Range<usize>, f: fn(&DVec3) -> f64| {
        let n = range.len() as f64;
        landmarks[range].iter().map(f).sum::<f64>() / n
    };
    let brow_y = mean(17..27, |p| p.y);
    let brow_z = mean(17..27, |p| p.z);
    let height = (landmarks[8].y - brow_y).abs();
    let middle_x = 0.5 * (landmarks[0].x + landmarks[16].x);
    let half_width = landmarks[0..17].iter().map(|p| (p.x - middle_x).abs()).fold(0.0, f64::max);
    let widened = |p: &DVec3| DVec3::new(middle_x + (p.x - middle_x) * SIDE, p.y, p.z);
    // The face and its jaw, closed and open; the lowest part gets a margin.
    let mut corners: Vec<DVec3> = landmarks.iter().map(widened).collect();
    let down = chin_drop.max(0.0) + BELOW * height;
    corners.extend(landmarks[3..14].iter().map(|p| widened(p) + DVec3::Y * down));
    // The skull: an ellipsoid whose widest level is at the brows; its lower front is the face, its lower back the neck.
    let side = half_width * SIDE;
    let half_length = half_width * LENGTH;
    let middle = DVec3::new(middle_x, brow_y, brow_z + half_length);
    for level in 0..=7 {
        let up = (90.0 - f64::from(level) * 15.0f64).to_radians();
        let turns = if level == 0 { 1 } else { 16 };
        for turn in 0..turns {
            let around = f64::from(turn) / 16.0 * std::f64::consts::TAU;
            // A little fuller than an ellipsoid, as skulls and hair are.
            let full = |v: f64| v.abs().powf(FULLNESS).copysign(v);
            let out = DVec3::new(full(up.cos()) * around.cos(), -full(up.sin()), full(up.cos()) * around.sin());
            corners.push(middle + out * DVec3::new(side, CROWN * height, half_length));
        }
    }
    corners
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::polygon::{convex_hull, hull_contains};
    use glam::DVec2;

    /// A rough face, metres.
    fn face() -> Vec<DVec3> {
        (0..68usize)
            .map(|i| {
                let t = i as f64;
                match i {
                    0..17 => {
                        let a = std::f64::consts::PI * t / 16.0;
                        DVec3::new(-0.07 * a.cos(), 0.02 + 0.085 * a.sin(), 0.09 - 0.08 * a.sin())
                    }
                    17..27 => DVec3::new(-0.055 + (t - 17.0) * 0.012, -0.03, 0.012),
                    _ => DVec3::new(0.03 * t.sin(), 0.03 + 0.03 * t.cos(), 0.0),
                }
            })
            .collect()
    }

    #[test]
    fn the_hull_holds_face_open_jaw_and_crown_and_little_else() {
        let face = face();
        let hull = head_hull(&face, 0.03);
        let project = |p: &DVec3| DVec2::new(p.x, p.y) / (p.z + 0.6);
        let outline = convex_hull(&hull.iter().map(project).collect::<Vec<_>>());
        assert!(face.iter().all(|p| hull_contains(&outline, project(p))));
        let lowest = face[8] + DVec3::Y * 0.03;
        assert!(hull_contains(&outline, project(&lowest)));
        let crown = DVec3::new(0.0, -0.03 - 0.12, 0.09);
        assert!(hull_contains(&outline, project(&crown)));
        for outside in [DVec3::new(0.12, 0.0, 0.1), DVec3::new(0.0, 0.2, 0.05), DVec3::new(0.0, -0.25, 0.1)] {
            assert!(!hull_contains(&outline, project(&outside)), "{outside}");
        }
        assert!(hull.iter().all(|p| p.is_finite() && p.z < 0.3));
    }

    #[test]
    fn the_heads_axes_are_found_wherever_the_head_is() {
        let turned = Isometry::from_wxyz([0.8, 0.1, 0.5, -0.2], DVec3::new(1.0, -2.0, 0.5));
        let own = world_from_head(&face()).unwrap();
        // The rough face looks along −z: its own axes are the identity, but for the asymmetry of its making.
        assert!((own.rotation.x_axis - DVec3::X).length() < 0.2 && own.rotation.z_axis.z > 0.9);
        let moved: Vec<DVec3> = face().iter().map(|&p| turned.transform_point(p)).collect();
        let found = world_from_head(&moved).unwrap();
        let expected = turned.compose(&own);
        assert!((found.translation - expected.translation).length() < 1e-9);
        assert!((found.rotation - expected.rotation).to_cols_array().iter().all(|v| v.abs() < 1e-9));
        assert!(world_from_head(&moved[..67]).is_none() && world_from_head(&[DVec3::ONE; 68]).is_none());
    }
}
