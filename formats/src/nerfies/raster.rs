//! Filled polygons by the pixel-centre rule (fact sheet §3.7, §6.3).

use std::ops::Range;

/// Calls `span(row, columns)` for every run of pixels whose centre lies inside the polygon, even-odd rule.
///
/// `points` are x, y in pixels of an image of `width` × `height`, the centre of the first pixel at (0.5, 0.5); the
/// polygon is closed by itself and clipped to the image. A centre exactly on an edge belongs to the side right of it
/// (or below it), so polygons that share edges share no pixel and leave none out. A polygon with a coordinate that is
/// not a finite number covers nothing.
pub fn fill_polygon(points: &[[f64; 2]], width: u32, height: u32, mut span: impl FnMut(u32, Range<u32>)) {
    if points.len() < 3 || points.iter().flatten().any(|v| !v.is_finite()) {
        return;
    }
    let top = points.iter().fold(f64::INFINITY, |m, p| m.min(p[1]));
    let bottom = points.iter().fold(f64::NEG_INFINITY, |m, p| m.max(p[1]));
    let row_of = |y: f64| (y - 0.5).ceil().clamp(0.0, f64::from(height)) as u32;
    let mut crossings = Vec::with_capacity(8);
    for row in row_of(top)..row_of(bottom) {
        let y = f64::from(row) + 0.5;
        crossings.clear();
        for (i, &a) in points.iter().enumerate() {
            let b = points[(i + 1) % points.len()];
            // From top to bottom, so that a neighbour that runs the edge the other way finds the very same crossing.
            let ([x0, y0], [x1, y1]) = if a[1] <= b[1] { (a, b) } else { (b, a) };
            if y0 <= y && y < y1 {
                crossings.push(x0 + (y - y0) / (y1 - y0) * (x1 - x0));
            }
        }
        crossings.sort_unstable_by(f64::total_cmp);
        let column_of = |x: f64| (x - 0.5).ceil().clamp(0.0, f64::from(width)) as u32;
        for pair in crossings.chunks_exact(2) {
            let columns = column_of(pair[0])..column_of(pair[1]);
            if !columns.is_empty() {
                span(row, columns);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn fill(points: &[[f64; 2]], width: u32, height: u32) -> Vec<u8> {
        let mut counts = vec![0u8; (width * height) as usize];
        fill_polygon(points, width, height, |row, columns| {
            for column in columns {
                counts[(row * width + column) as usize] += 1;
            }
        });
        counts
    }

    #[test]
    fn a_box_covers_the_centres_inside() {
        let counts = fill(&[[1.0, 1.0], [3.0, 1.0], [3.0, 2.0], [1.0, 2.0]], 4, 3);
        assert_eq!(counts, [0, 0, 0, 0, 0, 1, 1, 0, 0, 0, 0, 0]);
        // 0.5 lies on the border and counts, 2.5 does not.
        let counts = fill(&[[0.5, 0.5], [2.5, 0.5], [2.5, 1.5], [0.5, 1.5]], 4, 3);
        assert_eq!(counts, [1, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
        assert!(fill(&[[0.0, 0.0], [f64::NAN, 0.0], [2.0, 2.0]], 4, 3).iter().all(|&c| c == 0));
        assert_eq!(fill(&[[-1e9, -1e9], [1e9, -1e9], [1e9, 1e9], [-1e9, 1e9]], 4, 3), [1; 12]);
    }

    /// Point in polygon by the winding-free even-odd test with a ray to the left.
    fn inside(points: &[[f64; 2]], x: f64, y: f64) -> bool {
        (0..points.len()).fold(false, |inside, i| {
            let (a, b) = (points[i], points[(i + 1) % points.len()]);
            let crosses = (a[1] <= y) != (b[1] <= y) && x >= a[0] + (y - a[1]) / (b[1] - a[1]) * (b[0] - a[0]);
            inside != crosses
        })
    }

    proptest! {
        #[test]
        fn spans_are_the_centres_inside(points in prop::collection::vec(prop::array::uniform2(-3f64..15.0), 3..9)) {
            let counts = fill(&points, 12, 11);
            for row in 0..11u32 {
                for column in 0..12u32 {
                    let expected = inside(&points, f64::from(column) + 0.5, f64::from(row) + 0.5);
                    prop_assert_eq!(counts[(row * 12 + column) as usize], u8::from(expected));
                }
            }
        }

        #[test]
        fn triangles_of_a_fan_tile_the_image(x in 0.1f64..11.9, y in 0.1f64..10.9) {
            let corners = [[0.0, 0.0], [12.0, 0.0], [12.0, 11.0], [0.0, 11.0]];
            let mut sum = vec![0u8; 132];
            for i in 0..4 {
                for (s, c) in sum.iter_mut().zip(fill(&[corners[i], corners[(i + 1) % 4], [x, y]], 12, 11)) {
                    *s += c;
                }
            }
            prop_assert_eq!(sum, vec![1u8; 132]);
        }
    }
}
