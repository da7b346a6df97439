//! How fast this machine could fit at best: a floor to hold measured speeds against, calibrated on the spot.
//!
//! A sample costs the arithmetic of its networks, forward and twice that backward, and look-ups of 8 × 16 bytes. The floor
//! takes both at the rates that the very same kernels reach on data that never leave the second-level cache.

use std::time::{Duration, Instant};

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::field::{COLOR_INPUT, HIDDEN, INPUT, LEVELS, MIDDLE, OUTPUT};
use crate::lattice::{self, BRICK, Lattice};
use crate::matmul;
use crate::simd::{self, Simd, Task};
use crate::sixteen::{Each, POINTS, Sixteen};

/// Multiply-adds of a sample's networks, forward.
pub const MACS: usize = INPUT * HIDDEN + HIDDEN * MIDDLE + COLOR_INPUT * HIDDEN + HIDDEN * OUTPUT;
/// Look-ups of a sample, forward: the levels, B's two halves, the masks, the latent displacement.
pub const LOOK_UPS: usize = LEVELS + 4;
/// … and there and back: levels are also written and sloped, B written.
pub const LOOK_UPS_BOTH_WAYS: usize = LOOK_UPS + 2 * LEVELS + 2;

/// Rates of all threads together.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Floor {
    /// Threads.
    pub threads: usize,
    /// Arithmetic of small matrix products, 10⁹ operations per second.
    pub gflops: f64,
    /// Look-ups of 8 × 16 bytes, 10⁶ per second.
    pub million_look_ups_per_sec: f64,
}

impl Floor {
    /// Measures for about half a second on every thread of the pool.
    pub fn measure() -> Self {
        let seconds = Duration::from_millis(250);
        let products: Vec<f64> = rayon::broadcast(|_| simd::run(Products { seconds }));
        let look_ups: Vec<f64> = rayon::broadcast(|_| simd::run(LookUps { seconds }));
        Self {
            threads: products.len(),
            gflops: products.iter().sum::<f64>() * 1e-9,
            million_look_ups_per_sec: look_ups.iter().sum::<f64>() * 1e-6,
        }
    }

    /// Samples per second of a fit at these rates.
    pub fn fit_samples_per_sec(&self) -> f64 {
        self.samples_per_sec(6 * MACS, LOOK_UPS_BOTH_WAYS)
    }

    /// Samples per second of rendering at these rates.
    pub fn render_samples_per_sec(&self) -> f64 {
        self.samples_per_sec(2 * MACS, LOOK_UPS)
    }

    fn samples_per_sec(&self, flops: usize, look_ups: usize) -> f64 {
        1.0 / (flops as f64 / (self.gflops * 1e9) + look_ups as f64 / (self.million_look_ups_per_sec * 1e6))
    }
}

/// Floating-point operations per second.
struct Products {
    seconds: Duration,
}

impl Task for Products {
    type Output = f64;

    #[inline(always)]
    fn run<S: Simd>(self) -> f64 {
        const ROWS: usize = 256;
        let (x, w) = (vec![0.5f32; ROWS * INPUT], vec![0.01f32; INPUT * HIDDEN]);
        let mut y = vec![0.0f32; ROWS * HIDDEN];
        let (started, mut rounds) = (Instant::now(), 0u64);
        while started.elapsed() < self.seconds {
            for _ in 0..64 {
                matmul::product::<S, INPUT, HIDDEN>(&x, &w, &mut y, ROWS, true);
            }
            rounds += 64;
        }
        std::hint::black_box(&y);
        rounds as f64 * (2 * ROWS * INPUT * HIDDEN) as f64 / started.elapsed().as_secs_f64()
    }
}

/// Look-ups per second.
struct LookUps {
    seconds: Duration,
}

impl Task for LookUps {
    type Output = f64;

    #[inline(always)]
    #[allow(unsafe_code, reason = "corners come from the lattice that the table was made for")]
    fn run<S: Simd>(self) -> f64 {
        // 32³ vertices of 16 bytes: half a MiB.
        let lattice = Lattice::dense([32; 3]);
        let values = vec![0.25f32; lattice.slots * BRICK * 4];
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let points: Vec<[f32; 3]> =
            (0..1024).map(|_| std::array::from_fn(|_| rng.random::<f32>() * 2.0 - 1.0)).collect();
        let mut sum = [0.0f32; 4];
        let mut corners = Sixteen::default();
        let (started, mut rounds) = (Instant::now(), 0u64);
        while started.elapsed() < self.seconds {
            for sixteen in points.chunks_exact(POINTS) {
                let split: [Each<f32>; 3] = std::array::from_fn(|a| std::array::from_fn(|s| sixteen[s][a]));
                lattice.sixteen::<S>(&split, &mut corners);
                for s in 0..POINTS {
                    // SAFETY: the table has a row for every slot of the lattice.
                    unsafe {
                        let v = lattice::gather::<S>(&values, 4, 0, &corners.corners(s), &corners.weights(s));
                        S::q_store(sum.as_mut_ptr(), S::q_fma(v, S::q_splat(0.5), S::q_load(sum.as_ptr())));
                    }
                }
            }
            rounds += points.len() as u64;
        }
        std::hint::black_box(sum);
        rounds as f64 / started.elapsed().as_secs_f64()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fit_is_slower_than_rendering_and_both_have_a_floor() {
        let floor = Floor { threads: 2, gflops: 100.0, million_look_ups_per_sec: 100.0 };
        let (fit, render) = (floor.fit_samples_per_sec(), floor.render_samples_per_sec());
        // 2 × 2,816 operations take 56.32 ns, 10 look-ups 100 ns.
        assert!((render - 1e9 / 156.32).abs() < 1e3, "{render}");
        assert!(fit < render && fit > render / 4.0, "{fit}");
        let measured = Floor::measure();
        assert!(measured.gflops > 0.0 && measured.million_look_ups_per_sec > 0.0);
    }
}
