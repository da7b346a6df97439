//! The 68 facial landmarks (0-based iBUG / OpenFace order).

use std::ops::Range;

/// The jaw line from the image-left ear over the chin (8) to the image-right ear.
pub const JAW: Range<usize> = 0..17;
/// Image-left brow, 17 outer to 21 inner, then image-right brow, 22 inner to 26 outer.
pub const BROWS: Range<usize> = 17..27;
/// Nose bridge, top to tip, then the nose base.
pub const NOSE: Range<usize> = 27..36;
/// Image-left eye, clockwise from its outer corner 36 (37, 38 upper lid; 40, 41 lower lid).
pub const EYE_LEFT: Range<usize> = 36..42;
/// Image-right eye, clockwise from its inner corner 42 (43, 44 upper lid; 46, 47 lower lid).
pub const EYE_RIGHT: Range<usize> = 42..48;
/// Outer (48–59) and inner (60–67) lip.
pub const MOUTH: Range<usize> = 48..68;

/// The point on the other side of the face; points on the middle line are their own.
pub fn mirror_of(point: usize) -> usize {
    match point {
        0..=16 => 16 - point,
        17..=26 => 43 - point,
        31..=35 => 66 - point,
        36..=39 | 42..=45 => 81 - point,
        40 | 41 | 46 | 47 => 87 - point,
        48..=54 => 102 - point,
        55..=59 => 114 - point,
        60..=64 => 124 - point,
        65..=67 => 132 - point,
        _ => point,
    }
}

/// 68 points in the image: pixels of the full-size frame, the centre of the first pixel at (0.5, 0.5).
#[derive(Clone, Debug, PartialEq)]
pub struct Landmarks68 {
    /// x, y of each point.
    pub points_px: [[f32; 2]; 68],
}

impl Landmarks68 {
    /// Distance of the outer eye corners 36 and 45, the usual yardstick.
    pub fn outer_eye_distance_px(&self) -> f32 {
        let ([ax, ay], [bx, by]) = (self.points_px[36], self.points_px[45]);
        (ax - bx).hypot(ay - by)
    }

    /// How far the face is from its own mirror image: the root mean square distance of the points from their mirrored
    /// partners after the best turn, shift and scale, in outer-eye distances. A resting face seen from the front has
    /// about 0.02, a crooked mouth 0.05 and more; a turned head adds to it.
    pub fn asymmetry(&self) -> f32 {
        let points = &self.points_px;
        let mirrored: Vec<[f32; 2]> = (0..68).map(|i| [-points[mirror_of(i)][0], points[mirror_of(i)][1]]).collect();
        let mean = |list: &[[f32; 2]]| {
            let sum = list.iter().fold([0.0f64; 2], |s, p| [s[0] + f64::from(p[0]), s[1] + f64::from(p[1])]);
            sum.map(|v| v / 68.0)
        };
        let (to, from) = (mean(points), mean(&mirrored));
        let pairs = points.iter().zip(&mirrored).map(|(p, q)| {
            ([f64::from(p[0]) - to[0], f64::from(p[1]) - to[1]], [f64::from(q[0]) - from[0], f64::from(q[1]) - from[1]])
        });
        // The best similarity in the plane is one complex number a: p ≈ a q.
        let (mut re, mut im, mut norm) = (0.0, 0.0, 0.0);
        for (p, q) in pairs.clone() {
            re += p[0] * q[0] + p[1] * q[1];
            im += p[1] * q[0] - p[0] * q[1];
            norm += q[0] * q[0] + q[1] * q[1];
        }
        let (re, im) = if norm > 0.0 { (re / norm, im / norm) } else { (1.0, 0.0) };
        let squares: f64 =
            pairs.map(|(p, q)| (p[0] - re * q[0] + im * q[1]).powi(2) + (p[1] - re * q[1] - im * q[0]).powi(2)).sum();
        ((squares / 68.0).sqrt() / f64::from(self.outer_eye_distance_px()).max(1e-9)) as f32
    }

    /// Whether every coordinate is a finite number.
    pub fn is_finite(&self) -> bool {
        self.points_px.iter().flatten().all(|v| v.is_finite())
    }

    /// The smallest box around all points: left, top, right, bottom.
    pub fn bounds_px(&self) -> [f32; 4] {
        self.points_px.iter().fold([f32::MAX, f32::MAX, f32::MIN, f32::MIN], |[l, t, r, b], &[x, y]| {
            [l.min(x), t.min(y), r.max(x), b.max(y)]
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mirroring_twice_changes_nothing() {
        for point in 0..68 {
            assert_eq!(mirror_of(mirror_of(point)), point);
        }
        assert_eq!((mirror_of(36), mirror_of(40), mirror_of(48), mirror_of(59), mirror_of(67)), (45, 47, 54, 55, 65));
        assert_eq!((mirror_of(8), mirror_of(30), mirror_of(62)), (8, 30, 62));
    }

    #[test]
    fn a_symmetric_face_stays_symmetric_when_tilted_and_a_crooked_mouth_shows() {
        let mut points = [[0.0f32; 2]; 68];
        for i in 0..68 {
            let j = mirror_of(i);
            let side = if i == j {
                0.0
            } else if i < j {
                -1.0
            } else {
                1.0
            };
            let low = i.min(j) as f32;
            points[i] = [side * (20.0 + (low * 7.3) % 31.0), (low * 11.7) % 97.0];
        }
        let (sin, cos) = 0.3f32.sin_cos();
        let tilted = points.map(|[x, y]| [cos * x - sin * y + 200.0, sin * x + cos * y + 90.0]);
        assert!(Landmarks68 { points_px: tilted }.asymmetry() < 1e-5);
        let mut crooked = points;
        crooked[MOUTH].iter_mut().for_each(|p| p[0] += 8.0);
        assert!(Landmarks68 { points_px: crooked }.asymmetry() > 0.04);
    }
}
