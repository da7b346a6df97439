//! The corners around 16 points at once: arithmetic side by side, what one point at a time would cost most.

use crate::lattice::{BRICK, Corners, EDGE, Lattice};
use crate::simd::Simd;

/// Points that are looked up together.
pub(crate) const POINTS: usize = 16;
/// A number for each of 16 points.
pub(crate) type Each<T> = [T; POINTS];

/// Corners of 16 points, see [`Corners`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sixteen {
    index: [Each<u32>; 8],
    weight: [Each<f32>; 8],
    t: [Each<f32>; 3],
}

impl Default for Sixteen {
    fn default() -> Self {
        Self { index: [[0; POINTS]; 8], weight: [[0.0; POINTS]; 8], t: [[0.0; POINTS]; 3] }
    }
}

impl Sixteen {
    /// The corners of one of the points.
    #[inline(always)]
    pub(crate) fn corners(&self, point: usize) -> Corners {
        Corners { index: std::array::from_fn(|k| self.index[k][point]), t: std::array::from_fn(|a| self.t[a][point]) }
    }

    /// Their interpolation weights.
    #[inline(always)]
    pub(crate) fn weights(&self, point: usize) -> [f32; 8] {
        std::array::from_fn(|k| self.weight[k][point])
    }

    /// Which points have a corner in a brick of the lattice's own, that is, not all in the empty one.
    #[inline(always)]
    pub(crate) fn inside(&self) -> Each<bool> {
        let mut largest = [0; POINTS];
        for index in &self.index {
            for (m, &i) in largest.iter_mut().zip(index) {
                *m = i.max(*m);
            }
        }
        largest.map(|m| m >= BRICK as u32)
    }
}

impl Lattice {
    /// As [`Lattice::corners`], of 16 points given as x, y, z.
    #[allow(unsafe_code, reason = "clamped numbers as indices: no branch and no check per point")]
    #[inline(always)]
    pub(crate) fn sixteen<S: Simd>(&self, points: &[Each<f32>; 3], out: &mut Sixteen) {
        let steps = self.steps_per_unit();
        let [nx, ny, _] = self.bricks().map(|n| n as i32);
        let brick_strides = [1, nx, nx * ny];
        // SAFETY: the clamp keeps 0 ≤ base and base + 1 < vertices along each axis, so that a brick's number is one of
        // the lattice's; all arrays hold 16 numbers.
        unsafe {
            let mut t = [S::splat(0.0); 3];
            // What either neighbour along an axis adds to the number of the brick, and to the place in it.
            let mut bricks = [[S::i_splat(0); 2]; 3];
            let mut places = [[S::i_splat(0); 2]; 3];
            for a in 0..3 {
                let last = (self.vertices[a] - 1) as f32 - 1e-3;
                let q = S::mul(S::add(S::load(points[a].as_ptr()), S::splat(1.0)), S::splat(steps[a]));
                // A number that is none goes to the border.
                let q = S::min(S::max(q, S::splat(0.0)), S::splat(last));
                let base = S::i_from(q);
                t[a] = S::sub(q, S::i_to(base));
                S::store(out.t[a].as_mut_ptr(), t[a]);
                for side in 0..2 {
                    let at = S::i_add(base, S::i_splat(side as i32));
                    let local = S::i_and(at, S::i_splat(EDGE as i32 - 1));
                    bricks[a][side] = S::i_mul(S::i_eighth(at), S::i_splat(brick_strides[a]));
                    places[a][side] = S::i_mul(local, S::i_splat(EDGE.pow(a as u32) as i32));
                }
            }
            let one = S::splat(1.0);
            let sides: [[S::V; 2]; 3] =
                [[S::sub(one, t[0]), t[0]], [S::sub(one, t[1]), t[1]], [S::sub(one, t[2]), t[2]]];
            for k in 0..8 {
                let [i, j, l] = [k & 1, k >> 1 & 1, k >> 2];
                let brick = S::i_add(bricks[0][i], S::i_add(bricks[1][j], bricks[2][l]));
                let slot = if self.sparse { S::i_gather(self.slot.as_ptr(), brick) } else { brick };
                let place = S::i_add(places[0][i], S::i_add(places[1][j], places[2][l]));
                let index = S::i_add(S::i_mul(slot, S::i_splat(BRICK as i32)), place);
                S::i_store(out.index[k].as_mut_ptr(), index);
                let weight = S::mul(sides[0][i], S::mul(sides[1][j], sides[2][l]));
                S::store(out.weight[k].as_mut_ptr(), weight);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::simd::{self, Task};

    struct Look<'a> {
        lattice: &'a Lattice,
        points: &'a [Each<f32>; 3],
        sixteen: &'a mut Sixteen,
    }

    impl Task for Look<'_> {
        type Output = ();

        #[inline(always)]
        fn run<S: Simd>(self) {
            self.lattice.sixteen::<S>(self.points, self.sixteen);
        }
    }

    #[test]
    fn sixteen_points_have_the_corners_that_each_has() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let mut sparse = Lattice::sparse([32, 16, 24]);
        (0..24).for_each(|brick| {
            if rng.random::<f32>() < 0.4 {
                sparse.allocate(brick);
            }
        });
        for lattice in [Lattice::dense([16, 24, 32]), sparse] {
            for round in 0..50 {
                let mut points: [Each<f32>; 3] =
                    std::array::from_fn(|_| std::array::from_fn(|_| rng.random::<f32>() * 2.4 - 1.2));
                if round == 0 {
                    points[0][..6].copy_from_slice(&[f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1.0, -1.0, 1e30]);
                }
                let mut sixteen = Sixteen::default();
                simd::run(Look { lattice: &lattice, points: &points, sixteen: &mut sixteen });
                let inside = sixteen.inside();
                for s in 0..POINTS {
                    let expected = lattice.corners(points.map(|p| p[s]));
                    let found = sixteen.corners(s);
                    assert_eq!(found.index, expected.index);
                    assert_eq!(found.t.map(f32::to_bits), expected.t.map(f32::to_bits));
                    assert_eq!(sixteen.weights(s), expected.weights());
                    assert_eq!(inside[s], expected.index.iter().any(|&i| i >= BRICK as u32));
                }
            }
        }
    }
}
