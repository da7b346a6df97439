//! Trainable numbers in blocks, with Adam's moments and a step count per block.
//!
//! Only blocks that received a gradient are updated (nothing else moves), and bias correction uses a block's own count:
//! with the global one, the first touch of a late block would take a full-size step in a random direction.

use rayon::prelude::*;

/// A table of trainable numbers.
#[derive(Clone, Debug, Default)]
pub struct Table {
    /// The numbers.
    pub values: Vec<f32>,
    /// First moments.
    pub first: Vec<f32>,
    /// Second moments.
    pub second: Vec<f32>,
    /// Updates so far, per block.
    pub steps: Vec<u32>,
    /// Numbers per block.
    pub block: usize,
}

/// Gradients of a [`Table`], gathered by one thread.
#[derive(Clone, Debug, Default)]
pub struct TableGrad {
    /// The gradients; all 0 outside touched blocks.
    pub values: Vec<f32>,
    /// Blocks that were written to.
    pub touched: Vec<bool>,
}

/// How Adam steps.
#[derive(Clone, Copy, Debug)]
pub struct Adam {
    /// Learning rates of each 8 consecutive numbers.
    pub rates: [f32; 8],
    /// Decay of the first moment.
    pub beta1: f32,
    /// Decay of the second moment.
    pub beta2: f32,
    /// Floor of the denominator.
    pub epsilon: f32,
}

impl Adam {
    /// The usual decays for grids.
    pub fn new(rate: f32) -> Self {
        Self { rates: [rate; 8], beta1: 0.9, beta2: 0.99, epsilon: 1e-12 }
    }
}

impl Table {
    /// A table of `blocks` blocks, filled by `init`.
    pub fn new(blocks: usize, block: usize, mut init: impl FnMut() -> f32) -> Self {
        let n = blocks * block;
        Self {
            values: (0..n).map(|_| init()).collect(),
            first: vec![0.0; n],
            second: vec![0.0; n],
            steps: vec![0; blocks],
            block,
        }
    }

    /// Number of blocks.
    pub fn blocks(&self) -> usize {
        self.steps.len()
    }

    /// Appends zero blocks until there are `blocks`.
    pub fn grow(&mut self, blocks: usize) {
        if blocks > self.steps.len() {
            let n = blocks * self.block;
            for values in [&mut self.values, &mut self.first, &mut self.second] {
                lengthen(values, n);
            }
            self.steps.resize(blocks, 0);
        }
    }

    /// Updates the touched blocks from `from_block` on with the sum of `grads`, in their order, and clears these.
    pub fn step(&mut self, grads: &mut [&mut TableGrad], adam: &Adam, from_block: usize) {
        /// Numbers that one thread takes at a time.
        const SHARE: usize = 1 << 15;
        let Self { values, first, second, steps, block } = self;
        let per_share = (SHARE / *block).max(1);
        let numbers = per_share * *block;
        let mut shares: Vec<Share<'_>> = values
            .chunks_mut(numbers)
            .zip(first.chunks_mut(numbers))
            .zip(second.chunks_mut(numbers))
            .zip(steps.chunks_mut(per_share))
            .map(|(((values, first), second), steps)| Share { values, first, second, steps, grads: Vec::new() })
            .collect();
        for grad in grads {
            let TableGrad { values, touched } = &mut **grad;
            let parts = values.chunks_mut(numbers).zip(touched.chunks_mut(per_share));
            shares.iter_mut().zip(parts).for_each(|(share, part)| share.grads.push(part));
        }
        let block = *block;
        shares.into_par_iter().enumerate().for_each(|(i, mut share)| {
            let from = from_block.saturating_sub(i * per_share);
            share.step(block, adam, from);
        });
    }
}

/// Some blocks of a table, with what each thread gathered for them.
struct Share<'a> {
    values: &'a mut [f32],
    first: &'a mut [f32],
    second: &'a mut [f32],
    steps: &'a mut [u32],
    grads: Vec<(&'a mut [f32], &'a mut [bool])>,
}

impl Share<'_> {
    fn step(&mut self, size: usize, adam: &Adam, from: usize) {
        for block in from..self.steps.len() {
            if !self.grads.iter().any(|(_, touched)| touched[block]) {
                continue;
            }
            let range = block * size..(block + 1) * size;
            let Some(((sum, touched), rest)) = self.grads.split_first_mut() else { return };
            for (values, touched) in rest {
                if std::mem::take(&mut touched[block]) {
                    for (a, b) in sum[range.clone()].iter_mut().zip(&mut values[range.clone()]) {
                        *a += *b;
                        *b = 0.0;
                    }
                }
            }
            touched[block] = false;
            self.steps[block] += 1;
            let (first, second) = (&mut self.first[range.clone()], &mut self.second[range.clone()]);
            Update::new(adam, self.steps[block]).all(&mut sum[range.clone()], first, second, &mut self.values[range]);
        }
    }
}

/// Zeros up to `n` numbers. Tables grow brick by brick to hundreds of megabytes: doubling would waste as much again.
fn lengthen(values: &mut Vec<f32>, n: usize) {
    if values.capacity() < n {
        values.reserve_exact(n + n / 8 - values.len());
    }
    values.resize(n, 0.0);
}

/// An update of numbers that share a count of steps.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Update {
    correct1: f32,
    correct2: f32,
    adam: Adam,
}

impl Update {
    /// The update number `steps`, from 1.
    pub(crate) fn new(adam: &Adam, steps: u32) -> Self {
        let t = steps.min(10_000) as i32;
        Self { correct1: 1.0 / (1.0 - adam.beta1.powi(t)), correct2: 1.0 / (1.0 - adam.beta2.powi(t)), adam: *adam }
    }

    #[inline(always)]
    fn one(&self, g: f32, m: &mut f32, v: &mut f32, value: &mut f32, rate: f32) {
        let adam = &self.adam;
        *m = adam.beta1 * *m + (1.0 - adam.beta1) * g;
        *v = adam.beta2 * *v + (1.0 - adam.beta2) * g * g;
        // The corrected rate first: the corrected moment of a huge gradient would overflow, and inf/inf is no number.
        *value -= (rate * self.correct1) * *m / ((*v * self.correct2).sqrt() + adam.epsilon);
    }

    /// Updates numbers of one block, and clears their gradients.
    pub(crate) fn all(self, grads: &mut [f32], first: &mut [f32], second: &mut [f32], values: &mut [f32]) {
        crate::simd::run(UpdateTask { update: self, values, first, second, grads });
    }

    /// Updates 8 numbers, each with its own rate.
    #[inline(always)]
    pub(crate) fn eight(&self, g: &[f32; 8], m: &mut [f32], v: &mut [f32], values: &mut [f32]) {
        let (m, v, values) = (&mut m[..8], &mut v[..8], &mut values[..8]);
        for c in 0..8 {
            self.one(g[c], &mut m[c], &mut v[c], &mut values[c], self.adam.rates[c]);
        }
    }
}

struct UpdateTask<'a> {
    update: Update,
    values: &'a mut [f32],
    first: &'a mut [f32],
    second: &'a mut [f32],
    grads: &'a mut [f32],
}

impl crate::simd::Task for UpdateTask<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: crate::simd::Simd>(self) {
        let Self { update, values, first, second, grads } = self;
        let n = values.len();
        let (first, second, grads) = (&mut first[..n], &mut second[..n], &mut grads[..n]);
        let whole = n / 8 * 8;
        for i in (0..whole).step_by(8) {
            for j in 0..8 {
                let rate = update.adam.rates[j];
                update.one(grads[i + j], &mut first[i + j], &mut second[i + j], &mut values[i + j], rate);
            }
        }
        for i in whole..n {
            update.one(grads[i], &mut first[i], &mut second[i], &mut values[i], update.adam.rates[i % 8]);
        }
        grads.fill(0.0);
    }
}

impl TableGrad {
    /// Makes room for `table`.
    pub fn fit(&mut self, table: &Table) {
        if self.values.len() < table.values.len() {
            lengthen(&mut self.values, table.values.len());
            self.touched.resize(table.blocks(), false);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grad(table: &Table, touched: &[usize], value: f32) -> TableGrad {
        let mut g = TableGrad::default();
        g.fit(table);
        for &block in touched {
            g.touched[block] = true;
            g.values[block * table.block..(block + 1) * table.block].fill(value);
        }
        g
    }

    /// Adam by the book, for one number.
    fn by_the_book(gradients: &[f64], rate: f64) -> f64 {
        let (mut m, mut v, mut x) = (0.0, 0.0, 0.0);
        for (i, g) in gradients.iter().enumerate() {
            m = 0.9 * m + 0.1 * g;
            v = 0.99 * v + 0.01 * g * g;
            let t = i as i32 + 1;
            x -= rate * (m / (1.0 - 0.9f64.powi(t))) / ((v / (1.0 - 0.99f64.powi(t))).sqrt() + 1e-12);
        }
        x
    }

    #[test]
    fn a_block_counts_its_own_steps() {
        let mut table = Table::new(3, 10, || 0.0);
        for step in 0..20 {
            let touched: &[usize] = if step == 19 { &[1, 2] } else { &[1] };
            let mut a = grad(&table, touched, 0.3);
            let mut b = grad(&table, &[1], 0.1);
            table.step(&mut [&mut a, &mut b], &Adam::new(0.01), 1);
            assert!(a.values.iter().chain(&b.values).all(|v| *v == 0.0), "gradients are cleared");
        }
        assert_eq!(table.steps, [0, 20, 1]);
        assert!(table.values[..10].iter().all(|v| *v == 0.0), "block 0 is the empty one");
        for (block, gradients) in [(1, vec![0.4; 20]), (2, vec![0.3])] {
            let expected = by_the_book(&gradients, 0.01);
            for v in &table.values[block * 10..(block + 1) * 10] {
                assert!((f64::from(*v) - expected).abs() < 1e-6, "block {block}: {v}, expected {expected}");
            }
        }
    }

    #[test]
    fn a_gradient_of_nothing_moves_nothing() {
        let mut table = Table::new(2, 8, || 0.5);
        let mut g = grad(&table, &[1], 0.0);
        table.step(&mut [&mut g], &Adam::new(0.01), 0);
        assert!(table.values.iter().all(|v| *v == 0.5));
    }
}
