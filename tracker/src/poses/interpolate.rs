//! Poses of frames between placed ones.
//!
//! A camera in a hand moves smoothly, so the pose at time t lies on a curve through its neighbours. In the chart of the
//! placed pose `a` before the gap, every neighbour `i` is the twist `log(a⁻¹ · i)`; a natural cubic spline over the true
//! timestamps goes through up to four of them on each side (C², 4th order inside), and `a · exp(spline(t))` is the
//! pose. A camera on a constant twist has collinear twists, so it is met exactly. The twists are those of the camera's own
//! motion, so the result does not depend on where the world's origin lies or how long its units are.

use std::collections::BTreeMap;

use risorius_formats::{FrameRecord, Isometry};

use crate::se3::{self, Twist};

/// No frame is interpolated in a gap longer than this between placed frames, seconds; none is ever extrapolated.
pub const MAX_GAP_SECS: f64 = 0.5;

/// Placed poses that the spline uses on each side of a gap; farther ones weigh less than 0.27⁴.
const WINDOW: usize = 4;

/// Frames that lie between placed ones, and those that had to be left without a pose.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Interpolated {
    /// `camera_from_world` of the interpolated frames.
    pub poses: BTreeMap<u32, Isometry>,
    /// The same frames as inclusive runs.
    pub runs: Vec<[u32; 2]>,
    /// Inclusive runs of frames between placed ones whose gap is too long.
    pub gaps: Vec<[u32; 2]>,
}

/// Interpolates `camera_from_world` of the frames between those in `placed`, by the times in `frames`.
///
/// `placed` are indices into `frames`; indices beyond it are ignored.
pub fn interpolate(placed: &BTreeMap<u32, Isometry>, frames: &[FrameRecord], max_gap_secs: f64) -> Interpolated {
    let knots: Vec<Knot> = placed
        .iter()
        .filter_map(|(&frame, pose)| {
            let secs = frames.get(frame as usize)?.timestamp_nanos as f64 * 1e-9;
            Some(Knot { frame, secs, world_from_camera: pose.inverse() })
        })
        .collect();
    let mut result = Interpolated::default();
    for i in 1..knots.len() {
        let (a, b) = (&knots[i - 1], &knots[i]);
        if b.frame - a.frame < 2 {
            continue;
        }
        let run = [a.frame + 1, b.frame - 1];
        if b.secs - a.secs > max_gap_secs {
            result.gaps.push(run);
            continue;
        }
        let spline = Spline::around(&knots, i - 1, max_gap_secs);
        for frame in run[0]..=run[1] {
            let secs = frames[frame as usize].timestamp_nanos as f64 * 1e-9;
            let moved = se3::exp(Twist::from_array(spline.at(secs)));
            result.poses.insert(frame, a.world_from_camera.compose(&moved).inverse());
        }
        result.runs.push(run);
    }
    result
}

struct Knot {
    frame: u32,
    secs: f64,
    world_from_camera: Isometry,
}

/// A natural cubic spline of six numbers over time.
struct Spline {
    secs: Vec<f64>,
    values: Vec<[f64; 6]>,
    second: Vec<[f64; 6]>,
}

impl Spline {
    /// Through the knots around the gap after `knots[a]`, in the chart of that knot; does not reach over long gaps.
    fn around(knots: &[Knot], a: usize, max_gap_secs: f64) -> Self {
        let mut start = a;
        while start > 0 && a - start + 1 < WINDOW && knots[start].secs - knots[start - 1].secs <= max_gap_secs {
            start -= 1;
        }
        let mut end = a + 1;
        while end + 1 < knots.len() && end - a < WINDOW && knots[end + 1].secs - knots[end].secs <= max_gap_secs {
            end += 1;
        }
        let camera_a_from_world = knots[a].world_from_camera.inverse();
        let used: Vec<&Knot> = knots[start..=end].iter().collect();
        // Repeated times (a stuck clock) would divide by zero: they are pushed apart by a nanosecond, or by what a late time
        // can be told apart by.
        let mut secs: Vec<f64> = used.iter().map(|k| k.secs).collect();
        for i in 1..secs.len() {
            secs[i] = secs[i].max(secs[i - 1] + 1e-9f64.max(secs[i - 1].abs() * 1e-14));
        }
        let values =
            used.iter().map(|k| se3::log(&camera_a_from_world.compose(&k.world_from_camera)).to_array()).collect();
        Self::natural(secs, values)
    }

    fn natural(secs: Vec<f64>, values: Vec<[f64; 6]>) -> Self {
        let n = secs.len();
        let mut second = vec![[0.0; 6]; n];
        if n > 2 {
            // Thomas algorithm on the n − 2 inner knots; the matrix is the same for all six numbers.
            let h: Vec<f64> = secs.windows(2).map(|w| w[1] - w[0]).collect();
            let mut upper = vec![0.0; n];
            for i in 1..n - 1 {
                let pivot = 2.0 * (h[i - 1] + h[i]) - h[i - 1] * upper[i - 1];
                upper[i] = h[i] / pivot;
                for c in 0..6 {
                    let slope = |j: usize| (values[j + 1][c] - values[j][c]) / h[j];
                    second[i][c] = (6.0 * (slope(i) - slope(i - 1)) - h[i - 1] * second[i - 1][c]) / pivot;
                }
            }
            for i in (1..n - 1).rev() {
                let next = second[i + 1];
                for (value, next) in second[i].iter_mut().zip(next) {
                    *value -= upper[i] * next;
                }
            }
        }
        Self { secs, values, second }
    }

    fn at(&self, secs: f64) -> [f64; 6] {
        let i = self.secs.partition_point(|&s| s <= secs).clamp(1, self.secs.len() - 1);
        let (t0, t1) = (self.secs[i - 1], self.secs[i]);
        let h = t1 - t0;
        let (a, b) = ((t1 - secs) / h, (secs - t0) / h);
        std::array::from_fn(|c| {
            a * self.values[i - 1][c]
                + b * self.values[i][c]
                + ((a * a * a - a) * self.second[i - 1][c] + (b * b * b - b) * self.second[i][c]) * h * h / 6.0
        })
    }
}

#[cfg(test)]
#[path = "interpolate_tests.rs"]
mod tests;
