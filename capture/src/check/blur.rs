//! Motion blur: how much sharpness is lost where the picture moves.

use risorius_formats::FrameRecord;

use crate::timing::{median, quantile};

/// Fewer frames tell nothing.
const LEAST: usize = 60;
/// The lively frames have to move so much more than the still ones.
const CONTRAST: f32 = 2.0;

/// 1 − sharpness of the quarter of frames that moves most / sharpness of the quarter that moves least.
///
/// `None` when motion was not measured, or the whole take moves alike.
pub(super) fn motion_blur(frames: &[FrameRecord]) -> Option<f32> {
    let measured: Vec<(f32, f32)> =
        frames.iter().filter(|f| !f.repeated).filter_map(|f| f.motion.zip(f.sharpness)).collect();
    if measured.len() < LEAST {
        return None;
    }
    let motion: Vec<f32> = measured.iter().map(|m| m.0).collect();
    let (low, high) = (quantile(&motion, 0.25)?, quantile(&motion, 0.75)?);
    let of = |keep: &dyn Fn(f32) -> bool| {
        let part: Vec<(f32, f32)> = measured.iter().filter(|m| keep(m.0)).copied().collect();
        let pick = |f: fn(&(f32, f32)) -> f32| median(&part.iter().map(f).collect::<Vec<_>>());
        pick(|m| m.0).zip(pick(|m| m.1))
    };
    let ((still_motion, still), (lively_motion, lively)) = (of(&|m| m <= low)?, of(&|m| m >= high)?);
    (lively_motion >= CONTRAST * still_motion.max(0.05) && still > 0.0).then(|| 1.0 - lively / still)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frames(sharpness: impl Fn(f32) -> f32, motion: impl Fn(usize) -> f32) -> Vec<FrameRecord> {
        (0..400)
            .map(|i| {
                let moved = motion(i);
                FrameRecord { motion: Some(moved), sharpness: Some(sharpness(moved)), ..FrameRecord::default() }
            })
            .collect()
    }

    #[test]
    fn sharpness_that_falls_with_motion_is_blur() {
        let lively = |i: usize| 1.0 + 4.0 * ((i as f32 / 40.0).sin().abs());
        let blur = motion_blur(&frames(|m| 300.0 / m, lively)).unwrap();
        assert!((0.5..0.9).contains(&blur), "{blur}");
        let sharp = motion_blur(&frames(|_| 300.0, lively)).unwrap();
        assert!(sharp.abs() < 1e-6);
        assert_eq!(motion_blur(&frames(|m| 300.0 / m, |_| 2.0)), None);
        assert_eq!(motion_blur(&[]), None);
    }
}
