//! Light smoothing of poses in time: a local parabola (Savitzky–Golay) on the twist of the camera's motion.
//!
//! White noise of independent frames shrinks with the number of frames in the window, motion that is a parabola over the
//! window stays as it is.

use nalgebra::Matrix3;
use rayon::prelude::*;
use risorius_formats::Isometry;

use crate::se3::{self, Twist};

/// `camera_from_world` at ascending times, smoothed over ±`half_window_secs`. Poses with too few neighbours stay.
pub fn smooth(poses: &[Isometry], secs: &[f64], half_window_secs: f64) -> Vec<Isometry> {
    let middle = |i: usize| {
        let from = secs.partition_point(|&s| s < secs[i] - half_window_secs);
        let to = secs.partition_point(|&s| s <= secs[i] + half_window_secs);
        if to < from + 5 {
            return poses[i];
        }
        // Parabola a + b t + c t² by least squares; only a, the value at t = 0, is wanted. Tricube weights fade out.
        let world_from_camera = poses[i].inverse();
        let mut normal = Matrix3::<f64>::zeros();
        let mut right = [[0.0; 6]; 3];
        for k in from..to {
            let t = (secs[k] - secs[i]) / half_window_secs;
            let weight = (1.0 - (t.abs() * 0.95).powi(3)).powi(3);
            let twist = se3::log(&poses[i].compose(&poses[k].inverse())).to_array();
            let powers = [1.0, t, t * t];
            for a in 0..3 {
                for b in 0..3 {
                    normal[(a, b)] += weight * powers[a] * powers[b];
                }
                for c in 0..6 {
                    right[a][c] += weight * powers[a] * twist[c];
                }
            }
        }
        let Some(inverse) = normal.try_inverse() else { return poses[i] };
        let value = std::array::from_fn(|c| (0..3).map(|a| inverse[(0, a)] * right[a][c]).sum());
        world_from_camera.compose(&se3::exp(Twist::from_array(value))).inverse()
    };
    (0..poses.len()).into_par_iter().map(middle).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn track(noise: f64) -> (Vec<Isometry>, Vec<f64>) {
        let secs: Vec<f64> = (0..300).map(|i| f64::from(i) / 120.0).collect();
        let poses = secs
            .iter()
            .enumerate()
            .map(|(i, t)| {
                let jitter = |k: u64| {
                    let hash = (i as u64 * 6 + k + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
                    noise * ((hash >> 40) as f64 / f64::from(1u32 << 24) - 0.5)
                };
                let twist = [0.3 * t, -0.2 * t, 0.1 * t, 0.05 * t, 0.0, 0.4];
                let twist: [f64; 6] = std::array::from_fn(|k| twist[k] + jitter(k as u64));
                se3::exp(Twist::from_array(twist)).inverse()
            })
            .collect();
        (poses, secs)
    }

    fn rms(a: &[Isometry], b: &[Isometry]) -> f64 {
        let angle =
            |(a, b): (&Isometry, &Isometry)| se3::rotation_angle(&(a.rotation * b.rotation.transpose())).powi(2);
        (a.iter().zip(b).map(angle).sum::<f64>() / a.len() as f64).sqrt()
    }

    #[test]
    fn even_motion_stays_and_noise_shrinks() {
        let (clean, secs) = track(0.0);
        assert!(rms(&smooth(&clean, &secs, 0.06), &clean) < 1e-5);
        let (noisy, _) = track(0.02);
        let (before, after) = (rms(&noisy, &clean), rms(&smooth(&noisy, &secs, 0.06), &clean));
        assert!(after < 0.6 * before, "{before} {after}");
    }

    #[test]
    fn lonely_poses_stay() {
        let (noisy, secs) = track(0.02);
        assert_eq!(smooth(&noisy[..3], &secs[..3], 0.06), &noisy[..3]);
    }
}
