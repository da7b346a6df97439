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
