//! Frames that stand out in time: dropped where they fit badly, told as cuts where they fit.

use std::collections::BTreeMap;

use risorius_formats::Isometry;

use super::{Follow, Followed};
use crate::poses::triangulate::median;
use crate::se3::{self, Twist};

/// A frame that is this many times as far from its neighbours' mean as others is dropped.
const OUTLIER: f64 = 12.0;
/// … and at least this far, pixels.
const OUTLIER_PX: f64 = 1.5;
/// A frame that stands out is dropped if its patches miss by this many times what is usual.
const MISFIT: f64 = 2.0;
/// A step of this many times the usual one, and of this many pixels, is a cut.
const CUT: f64 = 12.0;
const CUT_PX: f64 = 25.0;

impl Follow<'_> {
    /// Drops poses that stand out from their neighbours in time.
    pub(super) fn drop_outliers(&self, placed: &BTreeMap<u32, Isometry>, result: &mut Followed) {
        let mut all = placed.clone();
        all.extend(result.poses.iter().map(|(f, p)| (*f, *p)));
        let focal = 0.5 * (self.lens.fx + self.lens.fy);
        let off = |frame: u32| {
            let (a, b) = (all.get(&frame.checked_sub(1)?)?, all.get(&(frame + 1))?);
            let (t0, t1, t2) = (self.secs(frame - 1), self.secs(frame), self.secs(frame + 1));
            let share = if t2 > t0 { (t1 - t0) / (t2 - t0) } else { 0.5 };
            let half = se3::log(&b.compose(&a.inverse())).to_array().map(|v| v * share);
            let expected = se3::exp(Twist::from_array(half)).compose(a);
            let twist = se3::log(&all[&frame].compose(&expected.inverse()));
            // A turn moves the picture, a shift moves what is near.
            Some(focal * (twist.rotation.length() + twist.translation.length() / self.depth))
        };
        let distances: BTreeMap<u32, f64> = result.poses.keys().filter_map(|&f| Some((f, off(f)?))).collect();
        let Some(usual) = median(&mut distances.values().copied().collect::<Vec<_>>()) else { return };
        let limit = (OUTLIER * usual).max(OUTLIER_PX);
        let usual_error = median(&mut result.errors_px.values().copied().collect::<Vec<_>>()).unwrap_or(0.0);
        for (&frame, &distance) in &distances {
            // The neighbours of a wild frame look wild too: only the worst of three goes.
            let worst =
                [frame.wrapping_sub(1), frame + 1].iter().all(|f| distances.get(f).is_none_or(|d| *d <= distance));
            // On both sides of a cut the pictures fit their poses.
            let fits = result.errors_px.get(&frame).is_some_and(|e| *e <= MISFIT * usual_error);
            if distance > limit && worst && !fits {
                result.poses.remove(&frame);
                result.errors_px.remove(&frame);
                result.dropped.push(frame);
            }
        }
        result.cuts = self.cuts(&all, usual);
    }

    /// Frames that the camera cannot have reached from the frame before.
    fn cuts(&self, all: &BTreeMap<u32, Isometry>, usual: f64) -> Vec<u32> {
        let focal = 0.5 * (self.lens.fx + self.lens.fy);
        let steps: Vec<(u32, f64)> = all
            .iter()
            .zip(all.iter().skip(1))
            .filter(|((a, _), (b, _))| **b == **a + 1)
            .map(|((_, a), (b, pose))| {
                let twist = se3::log(&pose.compose(&a.inverse()));
                (*b, focal * (twist.rotation.length() + twist.translation.length() / self.depth))
            })
            .collect();
        let Some(step) = median(&mut steps.iter().map(|s| s.1).collect::<Vec<_>>()) else { return Vec::new() };
        let limit = (CUT * step).max(OUTLIER * usual).max(CUT_PX);
        steps.into_iter().filter(|s| s.1 > limit).map(|s| s.0).collect()
    }
}
