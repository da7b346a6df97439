//! How a stored picture is turned to be upright.
//!
//! OpenCV's own turning is switched off: 4.6 with FFmpeg 5 turns by −90° where the container asks for 90°, so that
//! phone videos would stand on their heads.

use opencv::core::{self, Mat};

/// Mirror left and right first, if so; then turn clockwise.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Orientation {
    pub(crate) mirrored: bool,
    /// 0, 90, 180 or 270.
    pub(crate) clockwise_degrees: u32,
}

impl Orientation {
    /// From the matrix of a track: (x, y) is shown at (a·x + c·y, b·x + d·y), y downwards; to the nearest quarter turn.
    pub(crate) fn from_matrix(a: i32, b: i32, c: i32, d: i32) -> Self {
        let (a, b, c, d) = (f64::from(a), f64::from(b), f64::from(c), f64::from(d));
        if a * d - b * c == 0.0 {
            return Self::default();
        }
        let mirrored = a * d - b * c < 0.0;
        let sign = if mirrored { -1.0 } else { 1.0 };
        let quarters = ((sign * b).atan2(sign * a).to_degrees() / 90.0).round() as i64;
        Self { mirrored, clockwise_degrees: 90 * quarters.rem_euclid(4) as u32 }
    }

    /// What OpenCV reports for containers other than MP4, which is counter-clockwise in 4.6.
    pub(crate) fn from_opencv(degrees: f64) -> Self {
        let quarters = (-degrees / 90.0).round() as i64;
        Self { mirrored: false, clockwise_degrees: 90 * quarters.rem_euclid(4) as u32 }
    }

    /// Turns `picture`; `spare` is a buffer to work in.
    pub(crate) fn apply(self, picture: &mut Mat, spare: &mut Mat) -> opencv::Result<()> {
        if self.mirrored {
            core::flip(picture, spare, 1)?;
            std::mem::swap(picture, spare);
        }
        let code = match self.clockwise_degrees {
            90 => core::ROTATE_90_CLOCKWISE,
            180 => core::ROTATE_180,
            270 => core::ROTATE_90_COUNTERCLOCKWISE,
            _ => return Ok(()),
        };
        core::rotate(picture, spare, code)?;
        std::mem::swap(picture, spare);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn matrices_are_quarter_turns_with_or_without_a_mirror() {
        let of = |a, b, c, d| {
            let o = Orientation::from_matrix(a, b, c, d);
            (o.mirrored, o.clockwise_degrees)
        };
        assert_eq!(
            [of(1, 0, 0, 1), of(0, 1, -1, 0), of(-1, 0, 0, -1), of(0, -1, 1, 0)],
            [(false, 0), (false, 90), (false, 180), (false, 270)]
        );
        assert_eq!([of(-1, 0, 0, 1), of(1, 0, 0, -1)], [(true, 0), (true, 180)]);
        assert_eq!(of(0, 0, 0, 0), (false, 0));
    }
}
