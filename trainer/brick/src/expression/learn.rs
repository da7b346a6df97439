//! The way back from B to the residuals, and their update, brick by brick: a residual's gradient lives in registers and is
//! never written.
#![allow(unsafe_code, reason = "innermost loops; vertices of a brick are below its size by construction")]

use rayon::prelude::*;

use super::{CHANNELS, Expression, MASKS, QUIET, reach};
use crate::lattice::BRICK;
use crate::simd::{self, Simd, Task};
use crate::table::{Adam, Update};

/// The gradient of an image's B, and which bricks have one: an image sees half of a head, and only from one side.
#[derive(Clone, Debug, Default)]
pub struct BlendGrad {
    /// As B; all 0 in bricks without a gradient.
    pub(crate) values: Vec<f32>,
    touched: Vec<bool>,
}

impl BlendGrad {
    /// Forgets all, and makes room for a lattice of `slots` slots.
    pub fn fit(&mut self, slots: usize) {
        for (brick, touched) in self.values.chunks_exact_mut(BRICK * CHANNELS).zip(&mut self.touched) {
            if std::mem::take(touched) {
                brick.fill(0.0);
            }
        }
        self.values.resize(slots * BRICK * CHANNELS, 0.0);
        self.touched.resize(slots, false);
    }

    /// Notes that vertices `index` are written to.
    #[inline(always)]
    pub(crate) fn touch(&mut self, index: &[u32; 8]) {
        for &i in index {
            self.touched[i as usize / BRICK] = true;
        }
    }

    /// The gradient in a brick, where there is one.
    fn of(&self, slot: usize) -> Option<&[f32]> {
        self.touched[slot].then(|| &self.values[slot * BRICK * CHANNELS..(slot + 1) * BRICK * CHANNELS])
    }
}

/// What one image says of the expression.
#[derive(Clone, Copy, Debug)]
pub struct Seen<'a> {
    /// Its activations, AUs and then code.
    pub activations: &'a [f32],
    /// Gradient of its B.
    pub d_blend: &'a BlendGrad,
}

/// One residual in one brick.
struct Block<'a> {
    k: usize,
    region: usize,
    /// The brick's vertices that the region allows.
    vertices: &'a [u16],
    values: &'a mut [f32],
    first: &'a mut [f32],
    second: &'a mut [f32],
    steps: &'a mut u32,
}

impl Expression {
    /// Updates the residuals after what the images say; gives the gradients of each image's activations.
    ///
    /// Masks get no gradient from here: they follow the 2D masks only.
    pub fn learn(&mut self, gates: &[f32], images: &[Seen<'_>], adam: &Adam) -> Vec<Vec<f32>> {
        let Self { lattice, region_of, slots_of, vertices_of, residuals, .. } = self;
        let count = residuals.len();
        let mut blocks: Vec<Vec<Block<'_>>> = (0..lattice.slots).map(|_| Vec::new()).collect();
        for (k, table) in residuals.iter_mut().enumerate() {
            let (size, region) = (table.block, region_of[k]);
            let places = slots_of[region].iter().zip(&vertices_of[region]);
            let moments = table.first.chunks_exact_mut(size).zip(table.second.chunks_exact_mut(size));
            let rows = table.values.chunks_exact_mut(size).zip(moments).zip(&mut table.steps);
            for ((&slot, vertices), ((values, (first, second)), steps)) in places.zip(rows) {
                blocks[slot as usize].push(Block { k, region, vertices, values, first, second, steps });
            }
        }
        let parts: Vec<Vec<f32>> = blocks
            .into_par_iter()
            .enumerate()
            .map(|(slot, blocks)| {
                let told: Vec<(usize, &[f32])> =
                    images.iter().enumerate().filter_map(|(i, image)| Some((i, image.d_blend.of(slot)?))).collect();
                if told.is_empty() {
                    return Vec::new();
                }
                let gates = &gates[slot * BRICK * MASKS..(slot + 1) * BRICK * MASKS];
                let mut d_activations = vec![0.0; images.len() * count];
                for block in blocks {
                    let k = block.k;
                    let acting: Vec<Acting<'_>> = told
                        .iter()
                        .map(|&(i, d_blend)| Acting { image: i, a: images[i].activations[k], d_blend })
                        .filter(|acting| acting.a.abs() >= QUIET)
                        .collect();
                    if acting.is_empty() {
                        continue;
                    }
                    *block.steps += 1;
                    let update = Update::new(adam, *block.steps);
                    let sums = simd::run(LearnBrick { acting: &acting, gates, block, update });
                    for (acting, sum) in acting.iter().zip(sums) {
                        d_activations[acting.image * count + k] = sum;
                    }
                }
                d_activations
            })
            .collect();
        let mut sums = vec![vec![0.0; count]; images.len()];
        for part in parts.iter().filter(|p| !p.is_empty()) {
            for (sum, part) in sums.iter_mut().zip(part.chunks_exact(count)) {
                sum.iter_mut().zip(part).for_each(|(a, b)| *a += b);
            }
        }
        sums
    }
}

/// An image in which an AU acts.
struct Acting<'a> {
    image: usize,
    a: f32,
    d_blend: &'a [f32],
}

struct LearnBrick<'a> {
    acting: &'a [Acting<'a>],
    gates: &'a [f32],
    block: Block<'a>,
    update: Update,
}

impl Task for LearnBrick<'_> {
    /// The brick's part of the activation's gradient, per image that acts.
    type Output = Vec<f32>;

    #[inline(always)]
    fn run<S: Simd>(self) -> Vec<f32> {
        let Self { acting, gates, block, update } = self;
        let Block { region, vertices, values, first, second, .. } = block;
        let size = BRICK * CHANNELS;
        assert!(gates.len() >= BRICK * MASKS && values.len() >= size, "a brick");
        assert!(first.len() >= size && second.len() >= size, "a block");
        assert!(acting.iter().all(|a| a.d_blend.len() >= size), "a brick");
        let mut sums = vec![[0.0f32; 4]; acting.len()];
        for &vertex in vertices {
            let at = usize::from(vertex) * CHANNELS;
            // SAFETY: vertices are below BRICK.
            unsafe {
                let gate = reach(*gates.get_unchecked(usize::from(vertex) * MASKS + region));
                if gate == 0.0 {
                    continue;
                }
                let value = values.as_ptr().add(at);
                let value = [S::q_load(value), S::q_load(value.add(4))];
                let mut g = [S::q_splat(0.0); 2];
                for (acting, sum) in acting.iter().zip(&mut sums) {
                    let d = acting.d_blend.as_ptr().add(at);
                    let d = [S::q_load(d), S::q_load(d.add(4))];
                    let weight = S::q_splat(acting.a * gate);
                    g = [S::q_fma(weight, d[0], g[0]), S::q_fma(weight, d[1], g[1])];
                    let product = S::q_fma(d[0], value[0], S::q_fma(d[1], value[1], S::q_splat(0.0)));
                    S::q_store(sum.as_mut_ptr(), S::q_fma(S::q_splat(gate), product, S::q_load(sum.as_ptr())));
                }
                let (m, v) = (first.as_mut_ptr().add(at), second.as_mut_ptr().add(at));
                update.eight::<S>(g, m, v, values.as_mut_ptr().add(at));
            }
        }
        sums.iter().map(|[a, b, c, d]| (a + c) + (b + d)).collect()
    }
}

/// The way back as it reads: the twin of [`Expression::learn`], without the update.
pub(crate) fn backward(
    expression: &Expression,
    gates: &[f32],
    image: Seen<'_>,
    grads: &mut [Vec<f32>],
    d_activations: &mut [f32],
) {
    for (k, (&a, table)) in image.activations.iter().zip(&expression.residuals).enumerate() {
        let region = expression.region_of[k];
        for (block, &slot) in expression.slots_of[region].iter().enumerate() {
            for i in 0..BRICK {
                let gate = reach(gates[(slot as usize * BRICK + i) * MASKS + region]);
                for c in 0..CHANNELS {
                    let d = image.d_blend.values[(slot as usize * BRICK + i) * CHANNELS + c];
                    let at = (block * BRICK + i) * CHANNELS + c;
                    grads[k][at] += a * gate * d;
                    d_activations[k] += gate * d * table.values[at];
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::table::{Table, TableGrad};

    /// The fused update is the plain way back followed by Adam on whole tables.
    #[test]
    fn learning_is_the_twin_s_gradient_through_adam() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let mut number = |size: f32| (rng.random::<f32>() - 0.5) * size;
        let hull = |p: [f32; 3]| u8::from(p[0] < 0.2) | u8::from(p[1] > -0.3) << 1;
        let mut fused = Expression::new([16, 16, 8], vec![0, 1, 1], 2, 2, hull);
        fused.masks.values.iter_mut().for_each(|v| *v = number(6.0));
        let gates = fused.gates();
        let n = fused.lattice.slots * BRICK * CHANNELS;
        let count = fused.residuals.len();
        let mut plain: Vec<Table> = fused.residuals.clone();
        let adam = Adam { rates: [0.01, 0.01, 0.01, 0.01, 0.002, 0.002, 0.002, 0.01], ..Adam::new(0.01) };
        for step in 0..4 {
            let activations: Vec<Vec<f32>> = (0..3)
                .map(|i| (0..count).map(|k| if (i + k + step) % 4 == 0 { 0.0 } else { number(1.0) }).collect())
                .collect();
            let d_blend: Vec<BlendGrad> = (0..3)
                .map(|image| {
                    let mut d = BlendGrad::default();
                    d.fit(fused.lattice.slots);
                    // One image says nothing of the last brick.
                    let told = if image == 1 { n - BRICK * CHANNELS } else { n };
                    d.values[..told].fill_with(|| number(1.0));
                    (0..told / CHANNELS).for_each(|i| d.touch(&[i as u32; 8]));
                    d
                })
                .collect();
            let seen: Vec<Seen<'_>> =
                activations.iter().zip(&d_blend).map(|(activations, d_blend)| Seen { activations, d_blend }).collect();
            let mut grads: Vec<Vec<f32>> = plain.iter().map(|t| vec![0.0; t.values.len()]).collect();
            let mut expected = vec![vec![0.0; count]; 3];
            let mut twin = fused.clone();
            twin.residuals.clone_from(&plain);
            for (image, d_activations) in seen.iter().zip(&mut expected) {
                backward(&twin, &gates, *image, &mut grads, d_activations);
            }
            for (table, values) in plain.iter_mut().zip(grads) {
                let mut grad = TableGrad { touched: vec![true; table.blocks()], values };
                table.step(&mut [&mut grad], &adam, 0);
            }
            let d_activations = fused.learn(&gates, &seen, &adam);
            for (i, (found, expected)) in d_activations.iter().zip(&expected).enumerate() {
                for k in (0..count).filter(|&k| activations[i][k] != 0.0) {
                    let apart = (found[k] - expected[k]).abs();
                    assert!(apart < 2e-3 * expected[k].abs().max(1.0), "image {i}, {k}: {} {}", found[k], expected[k]);
                }
            }
        }
        for (k, (found, expected)) in fused.residuals.iter().zip(&plain).enumerate() {
            assert_eq!(found.steps, expected.steps, "{k}");
            for (a, b) in found.values.iter().zip(&expected.values) {
                assert!((a - b).abs() < 1e-4, "residual {k}: {a} {b}");
            }
        }
    }
}
