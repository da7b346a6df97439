//! Gaze and eye landmarks in the lines of an OpenFace table, which have zeros there.
//!
//! Columns 5–292: two unit vectors (6 decimals), two angles (3), then x, y (px) and X, Y, Z (mm) of 56 eye landmarks (1).

use std::io::Write as _;

use crate::gaze::{EYE_LANDMARKS, Gaze};
use crate::parquet::Extra;

/// Columns before the gaze.
const BEFORE: usize = 5;
/// Columns of gaze and eye landmarks.
const COLUMNS: usize = 8 + 5 * EYE_LANDMARKS;

/// Puts the gaze of each frame into its line; lines without one stay as they are.
pub fn fill(lines: &[u8], extras: &[Extra]) -> Vec<u8> {
    let mut out = Vec::with_capacity(lines.len() + lines.len() / 4);
    for (i, line) in lines.split_inclusive(|b| *b == b'\n').enumerate() {
        let gaze = extras.get(i).and_then(|e| e.gaze.as_ref());
        match gaze.zip(comma(line, BEFORE - 1)).zip(comma(line, BEFORE + COLUMNS - 1)) {
            Some(((gaze, from), to)) => {
                out.extend_from_slice(&line[..from]);
                write(&mut out, gaze);
                out.extend_from_slice(&line[to..]);
            }
            None => out.extend_from_slice(line),
        }
    }
    out
}

/// Where the comma lies that follows column `column`.
fn comma(line: &[u8], column: usize) -> Option<usize> {
    line.iter().enumerate().filter(|(_, b)| **b == b',').nth(column).map(|(at, _)| at)
}

fn write(out: &mut Vec<u8>, gaze: &Gaze) {
    // Writing to memory does not fail.
    for direction in gaze.directions {
        let _ = write!(out, ",{:.6},{:.6},{:.6}", direction.x, direction.y, direction.z);
    }
    let _ = write!(out, ",{:.3},{:.3}", gaze.angles[0], gaze.angles[1]);
    for axis in 0..2 {
        for point in gaze.landmarks_px.iter() {
            // OpenFace counts from the centre of the first pixel.
            let _ = write!(out, ",{:.1}", point[axis] - 0.5);
        }
    }
    for axis in 0..3 {
        for i in 0..EYE_LANDMARKS {
            let _ = write!(out, ",{:.1}", gaze.landmarks_mm.get(i).map_or(0.0, |p| p[axis]));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    #[test]
    fn a_line_gets_its_gaze_and_keeps_all_else() {
        let mut line: Vec<String> = (0..714).map(|i| i.to_string()).collect();
        let lines = format!("{}\n{}\n", line.join(","), line.join(","));
        let gaze = Gaze {
            directions: [DVec3::new(0.1, -0.2, -0.97); 2],
            angles: [0.125, -0.25],
            open: [true; 2],
            landmarks_px: Box::new(std::array::from_fn(|i| [i as f32 + 0.5, 2.5])),
            landmarks_mm: vec![[1.0, 2.0, 3.0]; EYE_LANDMARKS],
        };
        let filled = fill(lines.as_bytes(), &[Extra::default(), Extra { gaze: Some(gaze), ..Extra::default() }]);
        let filled = String::from_utf8(filled).unwrap();
        let (first, second) = filled.trim_end().split_once('\n').unwrap();
        assert_eq!(first, line.join(","), "a frame without gaze");
        let found: Vec<&str> = second.split(',').collect();
        assert_eq!(found.len(), 714);
        assert_eq!((found[5], found[10], found[11], found[12]), ("0.100000", "-0.970000", "0.125", "-0.250"));
        assert_eq!((found[13], found[14], found[69], found[125], found[292]), ("0.0", "1.0", "2.0", "1.0", "3.0"));
        line.drain(5..293);
        let kept: Vec<&str> = found[..5].iter().chain(&found[293..]).copied().collect();
        assert_eq!(kept, line);
    }
}
