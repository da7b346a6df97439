//! What the machine can do at best: the same arithmetic as the kernels', on data that stays in the first cache.
//! Benchmarks state kernels as shares of these.

use crate::bin::Line;
use crate::raster::{Tile, train_block};
use crate::simd::{self, Simd, Task};

/// Entries of the tile that is composited over and over.
const ENTRIES: usize = 64;

/// The fastest of this many counts.
const RUNS: usize = 400;

/// Nanoseconds of one evaluation (a Gaussian at 16 pixels) in cache: forward, backward.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Floor {
    /// Compositing.
    pub forward_nanos: f64,
    /// The backward pass.
    pub backward_nanos: f64,
}

/// Measures the floor with one thread.
pub fn measure() -> Floor {
    simd::run(Measure)
}

struct Measure;

impl Task for Measure {
    type Output = Floor;
    #[inline(always)]
    fn run<S: Simd>(self) -> Floor {
        let mut tile = Tile::default();
        // Wide, thin Gaussians that every block meets and none is hidden by.
        let line = Line([8.0, 8.0, -0.004, 0.001, -0.004, -5.0, 0.5, 0.4, 0.3, 1.0, 30.0, 30.0, 0.0, 0.0, 1.0, 1.0]);
        tile.lines = vec![line; ENTRIES];
        tile.masks = vec![u16::MAX; ENTRIES];
        let mut sums = vec![Line::ZERO; ENTRIES];
        let evaluations = (ENTRIES * crate::raster::TILE_BLOCKS) as f64;
        // Plain loops: a closure would not be compiled for the instruction set.
        let mut best = [f64::INFINITY; 2];
        for _ in 0..RUNS {
            let begun = std::time::Instant::now();
            tile.composite::<S>(crate::TILE, crate::TILE);
            best[0] = best[0].min(begun.elapsed().as_secs_f64());
            let begun = std::time::Instant::now();
            train_block::<S>(&mut tile, &mut sums);
            best[1] = best[1].min(begun.elapsed().as_secs_f64());
        }
        let [forward_nanos, backward_nanos] = best.map(|secs| secs * 1e9 / evaluations);
        Floor { forward_nanos, backward_nanos }
    }
}
