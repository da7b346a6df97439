//! Histograms of oriented gradients of the aligned face (FHOG; Felzenszwalb et al. 2010, PAMI 32(9)).
//!
//! Cells of 8 px; 12 × 12 inner cells, row by row, 31 numbers each: 18 signed orientations, 9 unsigned ones, 4 texture
//! energies, every one normalised by the four blocks of 2 × 2 cells around the cell and cut at 0.2. The gradient of a pixel
//! is that of the colour where it is largest. `tools/train-aus/fhog.py` computes the same numbers.

use super::face::{AlignedFace, PLANE, SIDE};

const CELL: usize = 8;
/// Cells of a side, those at the edge included.
const GRID: usize = SIDE / CELL;
/// Cells of a side that have numbers.
const INNER: usize = GRID - 2;
const SIGNED: usize = 18;
const UNSIGNED: usize = 9;
const CELL_NUMBERS: usize = SIGNED + UNSIGNED + 4;
/// Numbers of a face.
pub const FHOG_NUMBERS: usize = INNER * INNER * CELL_NUMBERS;
/// No orientation may have more than this share of a block's energy.
const CUT: f32 = 0.2;
/// Weight of the texture energies, 1 / √18.
const TEXTURE: f32 = 0.2357;
/// Keeps black blocks from division by zero; levels².
const EPSILON: f32 = 1e-4;

/// Histograms of a row of cells.
type Row = [[f32; SIGNED]; GRID + 2];

/// The FHOG of a face.
pub fn fhog(face: &AlignedFace) -> Vec<f32> {
    // One histogram for each cell and a ring of cells around them, which is dropped.
    let mut histograms: Vec<Row> = vec![[[0.0; SIGNED]; GRID + 2]; GRID + 2];
    let directions: [[f32; 2]; UNSIGNED] = std::array::from_fn(|o| {
        let (sin, cos) = (o as f64 * std::f64::consts::PI / UNSIGNED as f64).sin_cos();
        [cos as f32, sin as f32]
    });
    for y in 1..SIDE - 1 {
        let (lengths, orientations) = gradients(face, y, &directions);
        let (row, fy) = cell(y);
        for x in 1..SIDE - 1 {
            let length = lengths[x];
            if length == 0.0 {
                continue;
            }
            let (column, fx) = cell(x);
            let o = orientations[x] as usize;
            histograms[row][column][o] += length * (1.0 - fx) * (1.0 - fy);
            histograms[row][column + 1][o] += length * fx * (1.0 - fy);
            histograms[row + 1][column][o] += length * (1.0 - fx) * fy;
            histograms[row + 1][column + 1][o] += length * fx * fy;
        }
    }
    normalised(&histograms)
}

/// The cell whose centre lies before pixel `i`, counted with the ring, and the share of the next cell.
fn cell(i: usize) -> (usize, f32) {
    let half = 2 * i + 1 + CELL;
    (half / (2 * CELL), (half % (2 * CELL)) as f32 / (2 * CELL) as f32)
}

/// Length and orientation (0–17) of the gradients of one row; without branches, so that the compiler makes vector code.
fn gradients(face: &AlignedFace, y: usize, directions: &[[f32; 2]; UNSIGNED]) -> ([f32; SIDE], [u32; SIDE]) {
    let (mut gx, mut gy, mut best) = ([0.0f32; SIDE], [0.0f32; SIDE], [0.0f32; SIDE]);
    for plane in face.levels.chunks_exact(PLANE) {
        let row = |y: usize| &plane[y * SIDE..(y + 1) * SIDE];
        let (above, here, below) = (row(y - 1), row(y), row(y + 1));
        for x in 1..SIDE - 1 {
            let (dx, dy) = (here[x + 1] - here[x - 1], below[x] - above[x]);
            let size = dx * dx + dy * dy;
            let larger = size > best[x];
            gx[x] = if larger { dx } else { gx[x] };
            gy[x] = if larger { dy } else { gy[x] };
            best[x] = if larger { size } else { best[x] };
        }
    }
    let (mut largest, mut orientations) = ([0.0f32; SIDE], [0u32; SIDE]);
    for (o, [cos, sin]) in (0u32..).zip(directions) {
        for x in 0..SIDE {
            let dot = cos * gx[x] + sin * gy[x];
            let (size, number) = if dot < 0.0 { (-dot, o + UNSIGNED as u32) } else { (dot, o) };
            let larger = size > largest[x];
            largest[x] = if larger { size } else { largest[x] };
            orientations[x] = if larger { number } else { orientations[x] };
        }
    }
    (best.map(f32::sqrt), orientations)
}

fn normalised(histograms: &[Row]) -> Vec<f32> {
    let energy: [[f32; GRID]; GRID] = std::array::from_fn(|y| {
        std::array::from_fn(|x| {
            let h = &histograms[y + 1][x + 1];
            (0..UNSIGNED).map(|o| (h[o] + h[o + UNSIGNED]).powi(2)).sum()
        })
    });
    // The scale of the block whose first cell is (y, x).
    let scale: [[f32; GRID - 1]; GRID - 1] = std::array::from_fn(|y| {
        std::array::from_fn(|x| {
            let block = energy[y][x] + energy[y][x + 1] + energy[y + 1][x] + energy[y + 1][x + 1];
            1.0 / (block + EPSILON).sqrt()
        })
    });
    let mut out = vec![0.0; FHOG_NUMBERS];
    for (i, cell) in out.chunks_exact_mut(CELL_NUMBERS).enumerate() {
        let (y, x) = (i / INNER, i % INNER);
        let h = &histograms[y + 2][x + 2];
        for corner in 0..4 {
            let scale = scale[y + corner / 2][x + corner % 2];
            let mut texture = 0.0;
            for o in 0..SIGNED {
                let share = (h[o] * scale).min(CUT);
                cell[o] += 0.5 * share;
                texture += share;
            }
            for o in 0..UNSIGNED {
                cell[SIGNED + o] += 0.5 * ((h[o] + h[o + UNSIGNED]) * scale).min(CUT);
            }
            cell[SIGNED + UNSIGNED + corner] = TEXTURE * texture;
        }
    }
    out
}

#[cfg(test)]
#[path = "fhog_tests.rs"]
mod tests;
