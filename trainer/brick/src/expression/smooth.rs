//! Smoothing of the residuals: what few pixels have taught follows what many have.

use rayon::prelude::*;

use super::{CHANNELS, Expression};
use crate::lattice::{BRICK, EDGE};

impl Expression {
    /// Moves each number of every residual that was ever touched by `share` towards the mean of its neighbours,
    /// displacements by `warp_share`: what few pixels have taught then follows what many have. Neighbours reach across
    /// bricks, or their borders would show as seams.
    pub fn smooth(&mut self, share: f32, warp_share: f32) {
        let shares = [share, share, share, share, warp_share, warp_share, warp_share, share];
        let bricks = self.lattice.bricks();
        let mut brick_of = vec![usize::MAX; self.lattice.slots];
        for (brick, &slot) in self.lattice.slot.iter().enumerate().filter(|(_, s)| **s != 0) {
            brick_of[slot as usize] = brick;
        }
        let around: Vec<Vec<[Option<usize>; 6]>> =
            self.slots_of.iter().map(|slots| blocks_around(slots, &brick_of, bricks)).collect();
        let Self { residuals, region_of, .. } = self;
        residuals.par_iter_mut().zip(region_of).for_each(|(table, &mut region)| {
            let before = table.values.clone();
            for (block, around) in around[region].iter().enumerate() {
                if table.steps[block] > 0 {
                    let values = &mut table.values[block * BRICK * CHANNELS..(block + 1) * BRICK * CHANNELS];
                    smooth_brick(values, &before, block, around, &shares);
                }
            }
        });
    }
}

/// For each block of a region the blocks beside it: −x, +x, −y, +y, −z, +z.
fn blocks_around(slots: &[u32], brick_of: &[usize], bricks: [usize; 3]) -> Vec<[Option<usize>; 6]> {
    let strides = [1, bricks[0], bricks[0] * bricks[1]];
    let block_at = |brick: usize| slots.iter().position(|&s| brick_of[s as usize] == brick);
    slots
        .iter()
        .map(|&slot| {
            let brick = brick_of[slot as usize];
            std::array::from_fn(|side| {
                let axis = side / 2;
                let at = brick / strides[axis] % bricks[axis];
                if side % 2 == 0 {
                    (at > 0).then(|| block_at(brick - strides[axis])).flatten()
                } else {
                    (at + 1 < bricks[axis]).then(|| block_at(brick + strides[axis])).flatten()
                }
            })
        })
        .collect()
}

/// Smooths one brick; `before` are all values of its table before any was moved.
fn smooth_brick(
    values: &mut [f32],
    before: &[f32],
    block: usize,
    around: &[Option<usize>; 6],
    shares: &[f32; CHANNELS],
) {
    const STRIDES: [usize; 3] = [1, EDGE, EDGE * EDGE];
    for i in 0..BRICK {
        let mut sum = [0.0f32; CHANNELS];
        let mut count = 0.0;
        for side in 0..6 {
            let (axis, up) = (side / 2, side % 2 == 1);
            let at = i / STRIDES[axis] % EDGE;
            let inside = if up { at + 1 < EDGE } else { at > 0 };
            // The vertex beside this one, or the first one of the brick beside this one.
            let (neighbour, vertex) = match (inside, up) {
                (true, true) => (Some(block), i + STRIDES[axis]),
                (true, false) => (Some(block), i - STRIDES[axis]),
                (false, true) => (around[side], i - (EDGE - 1) * STRIDES[axis]),
                (false, false) => (around[side], i + (EDGE - 1) * STRIDES[axis]),
            };
            if let Some(neighbour) = neighbour {
                let from = (neighbour * BRICK + vertex) * CHANNELS;
                count += 1.0;
                for (s, v) in sum.iter_mut().zip(&before[from..from + CHANNELS]) {
                    *s += v;
                }
            }
        }
        let own = (block * BRICK + i) * CHANNELS;
        for c in 0..CHANNELS {
            values[i * CHANNELS + c] += shares[c] * (sum[c] / count - before[own + c]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two bricks side by side, one AU.
    fn pair() -> Expression {
        Expression::new([16, 8, 8], vec![0], 1, 0, |_| 1)
    }

    #[test]
    fn smoothing_reaches_across_bricks_and_keeps_what_is_even() {
        let mut e = pair();
        assert_eq!(e.slots_of[0].len(), 2);
        e.residuals[0].values.fill(0.25);
        e.residuals[0].steps.fill(1);
        e.smooth(0.5, 0.5);
        assert!(e.residuals[0].values.iter().all(|v| (v - 0.25).abs() < 1e-6));
        // A spike on the border: half of it stays, and every neighbour, the one beyond the border too, gets its share.
        let spike = (7 + EDGE + EDGE * EDGE) * CHANNELS;
        e.residuals[0].values.fill(0.0);
        e.residuals[0].values[spike] = 1.0;
        e.smooth(0.5, 0.5);
        let v = &e.residuals[0].values;
        let beyond = (BRICK + EDGE + EDGE * EDGE) * CHANNELS;
        assert!((v[spike] - 0.5).abs() < 1e-6);
        for neighbour in [spike - CHANNELS, spike + EDGE * CHANNELS, beyond] {
            assert!((v[neighbour] - 0.5 / 6.0).abs() < 1e-6, "{}", v[neighbour]);
        }
    }
}
