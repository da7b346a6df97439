//! Surfels drawn onto the surface that they and their neighbours make (moving least squares of order 0 along the
//! normal), and those without neighbours left out.

use glam::DVec3;
use rayon::prelude::*;

use super::fuse::Surfel;

/// Reach of the neighbourhood, sides of a voxel.
const REACH: f64 = 2.5;
/// Neighbours that a surfel must have.
const LEAST: usize = 4;
/// The farthest that a surfel is moved, sides of its voxel.
const FARTHEST: f64 = 2.0;

/// Cells of one size with the surfels in them, sorted by cell.
struct Grid {
    side: f64,
    cells: Vec<([i64; 3], u32)>,
}

impl Grid {
    fn new(surfels: &[Surfel], chosen: &[u32], side: f64) -> Self {
        let mut cells: Vec<_> = chosen.iter().map(|&i| (cell(surfels[i as usize].at, side), i)).collect();
        cells.par_sort_unstable();
        Self { side, cells }
    }

    /// Surfels in the 27 cells around a place, in a fixed order.
    fn near(&self, at: DVec3) -> impl Iterator<Item = usize> {
        let [x, y, z] = cell(at, self.side);
        (0..9).flat_map(move |k| {
            let (x, y) = (x + k % 3 - 1, y + k / 3 - 1);
            // Cells that differ in z only lie next to each other.
            let from = self.cells.partition_point(|c| c.0 < [x, y, z - 1]);
            self.cells[from..].iter().take_while(move |c| c.0 <= [x, y, z + 1]).map(|c| c.1 as usize)
        })
    }
}

fn cell(at: DVec3, side: f64) -> [i64; 3] {
    (at / side).floor().as_i64vec3().to_array()
}

/// The surfels, smoothed.
pub(crate) fn smooth(surfels: &[Surfel]) -> Vec<Surfel> {
    // Voxels of one size make one grid.
    let mut order: Vec<u32> = (0..surfels.len() as u32).collect();
    order.sort_by(|&a, &b| surfels[a as usize].voxel.total_cmp(&surfels[b as usize].voxel).then(a.cmp(&b)));
    let mut smoothed: Vec<Option<Surfel>> = vec![None; surfels.len()];
    for group in order.chunk_by(|&a, &b| surfels[a as usize].voxel == surfels[b as usize].voxel) {
        let voxel = surfels[group[0] as usize].voxel;
        let grid = Grid::new(surfels, group, REACH * voxel);
        let results: Vec<Option<Surfel>> =
            group.par_iter().map(|&i| moved(surfels, &grid, i as usize, group.len())).collect();
        for (&i, result) in group.iter().zip(results) {
            smoothed[i as usize] = result;
        }
    }
    smoothed.into_iter().flatten().collect()
}

fn moved(surfels: &[Surfel], grid: &Grid, index: usize, of: usize) -> Option<Surfel> {
    let own = &surfels[index];
    let mut near = Vec::new();
    for other in grid.near(own.at).map(|i| &surfels[i]) {
        let away = (other.at - own.at).length_squared() / (grid.side * grid.side);
        let agreement = own.normal.dot(other.normal);
        if away < 1.0 && agreement > 0.3 {
            near.push((other, (1.0 - away).powi(2) * agreement));
        }
    }
    // Few surfels of a size have their neighbours among other sizes.
    if near.len() <= LEAST.min(of / 8) {
        return None;
    }
    let sum: f64 = near.iter().map(|n| n.1).sum();
    let normal = near.iter().map(|n| n.0.normal * n.1).sum::<DVec3>().normalize_or(own.normal);
    let offset = near.iter().map(|n| n.1 * normal.dot(n.0.at - own.at)).sum::<f64>() / sum;
    let limit = FARTHEST * own.voxel;
    Some(Surfel { at: own.at + normal * offset.clamp(-limit, limit), normal, ..*own })
}
