//! Trainable numbers in blocks, with Adam's moments and a step count per block.
//!
//! Only blocks that received a gradient are updated (nothing else moves), and bias correction uses a block's own count:
//! with the global one, the first touch of a late block would take a full-size step in a random direction.

use std::sync::LazyLock;

use rayon::prelude::*;

use crate::simd::{Simd, Task};

/// A table of trainable numbers.
#[derive(Clone, Debug, Default)]
pub struct Table {
    /// The numbers.
    pub values: Vec<f32>,
    /// First moments; none in a finished avatar, which would take three times the memory.
    pub first: Vec<f32>,
    /// Second moments; none in a finished avatar.
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

/// Decay of the first moment.
const BETA1: f32 = 0.9;
/// Decay of the second moment, as usual for grids.
const BETA2: f32 = 0.99;
/// Updates after which neither moment is corrected any more: 0.99^2048 is below a rounding of 1.
const SETTLED: usize = 2048;

/// How Adam steps.
#[derive(Clone, Copy, Debug)]
pub struct Adam {
    /// Learning rates of each 8 consecutive numbers.
    pub rates: [f32; 8],
    /// Floor of the denominator.
    pub epsilon: f32,
}

impl Adam {
    /// One rate for all.
    pub fn new(rate: f32) -> Self {
        Self { rates: [rate; 8], epsilon: 1e-12 }
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

    /// A table without numbers, for blocks of `block`.
    pub fn empty(block: usize) -> Self {
        Self { block, ..Self::default() }
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

/// Zeros up to `n` numbers. Room is held for a quarter more, which takes no memory before it is used: a table that grows a
/// little does not move.
fn lengthen(values: &mut Vec<f32>, n: usize) {
    if values.capacity() < n {
        values.reserve_exact(n + n / 4 - values.len());
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
        static CORRECTIONS: LazyLock<Vec<[f32; 2]>> = LazyLock::new(|| {
            (0..=SETTLED as i32).map(|t| [BETA1, BETA2].map(|beta| 1.0 / (1.0 - beta.powi(t)))).collect()
        });
        let [correct1, correct2] = CORRECTIONS.get(steps as usize).copied().unwrap_or([1.0; 2]);
        Self { correct1, correct2, adam: *adam }
    }

    /// As it reads: the twin of [`Self::sixteen`] and [`Self::eight`], for what is left over.
    #[inline(always)]
    fn one(&self, g: f32, m: &mut f32, v: &mut f32, value: &mut f32, rate: f32) {
        *m = BETA1 * *m + (1.0 - BETA1) * g;
        *v = BETA2 * *v + (1.0 - BETA2) * g * g;
        // The corrected rate first: the corrected moment of a huge gradient would overflow, and inf/inf is no number.
        *value -= (rate * self.correct1) * *m / ((*v * self.correct2).sqrt() + self.adam.epsilon);
    }

    /// Updates numbers of one block, and clears their gradients.
    pub(crate) fn all(self, grads: &mut [f32], first: &mut [f32], second: &mut [f32], values: &mut [f32]) {
        crate::simd::run(UpdateTask { update: self, told: &[&*grads], values, first, second });
        grads.fill(0.0);
    }

    /// Updates numbers of one block with the sum of what `told` says, in its order.
    pub(crate) fn told(self, told: &[&[f32]], first: &mut [f32], second: &mut [f32], values: &mut [f32]) {
        crate::simd::run(UpdateTask { update: self, told, values, first, second });
    }

    /// Rates of 16 numbers, corrected for the first moment.
    #[inline(always)]
    fn rates(&self) -> [f32; 16] {
        let mut rates = [0.0; 16];
        for (i, rate) in rates.iter_mut().enumerate() {
            *rate = self.adam.rates[i % 8] * self.correct1;
        }
        rates
    }

    /// Updates 16 numbers side by side. Compilers leave the plain loop scalar, which took a third of a fit.
    ///
    /// # Safety
    /// The pointers are valid for 16 numbers.
    #[allow(unsafe_code, reason = "vectors")]
    #[inline(always)]
    unsafe fn sixteen<S: Simd>(&self, g: S::V, m: *mut f32, v: *mut f32, value: *mut f32, rates: S::V) {
        // SAFETY: the caller's promise.
        unsafe {
            let first = S::add(S::mul(S::splat(BETA1), S::load(m)), S::mul(S::splat(1.0 - BETA1), g));
            let square = S::mul(S::mul(S::splat(1.0 - BETA2), g), g);
            let second = S::add(S::mul(S::splat(BETA2), S::load(v)), square);
            S::store(m, first);
            S::store(v, second);
            let root = S::sqrt(S::mul(second, S::splat(self.correct2)));
            let step = S::div(S::mul(rates, first), S::add(root, S::splat(self.adam.epsilon)));
            S::store(value, S::sub(S::load(value), step));
        }
    }

    /// Updates 8 numbers, each with its own rate.
    ///
    /// # Safety
    /// The pointers are valid for 8 numbers.
    #[allow(unsafe_code, reason = "vectors")]
    #[inline(always)]
    pub(crate) unsafe fn eight<S: Simd>(&self, g: [S::Q; 2], m: *mut f32, v: *mut f32, value: *mut f32) {
        // SAFETY: the caller's promise.
        unsafe {
            for (half, g) in g.into_iter().enumerate() {
                let (m, v, value) = (m.add(4 * half), v.add(4 * half), value.add(4 * half));
                let rates = S::q_mul(S::q_load(self.adam.rates.as_ptr().add(4 * half)), S::q_splat(self.correct1));
                let first = S::q_add(S::q_mul(S::q_splat(BETA1), S::q_load(m)), S::q_mul(S::q_splat(1.0 - BETA1), g));
                let square = S::q_mul(S::q_mul(S::q_splat(1.0 - BETA2), g), g);
                let second = S::q_add(S::q_mul(S::q_splat(BETA2), S::q_load(v)), square);
                S::q_store(m, first);
                S::q_store(v, second);
                let root = S::q_sqrt(S::q_mul(second, S::q_splat(self.correct2)));
                let step = S::q_div(S::q_mul(rates, first), S::q_add(root, S::q_splat(self.adam.epsilon)));
                S::q_store(value, S::q_sub(S::q_load(value), step));
            }
        }
    }
}

struct UpdateTask<'a> {
    update: Update,
    told: &'a [&'a [f32]],
    values: &'a mut [f32],
    first: &'a mut [f32],
    second: &'a mut [f32],
}

impl Task for UpdateTask<'_> {
    type Output = ();

    #[allow(unsafe_code, reason = "vectors; lengths are asserted")]
    #[inline(always)]
    fn run<S: Simd>(self) {
        let Self { update, told, values, first, second } = self;
        let n = values.len();
        assert!(first.len() >= n && second.len() >= n && told.iter().all(|g| g.len() >= n), "a block");
        let whole = n / 16 * 16;
        // SAFETY: i + 16 ≤ n, which none of the slices falls short of.
        unsafe {
            let rates = S::load(update.rates().as_ptr());
            for i in (0..whole).step_by(16) {
                let mut g = S::splat(0.0);
                for told in told {
                    g = S::add(g, S::load(told.as_ptr().add(i)));
                }
                let (m, v) = (first.as_mut_ptr().add(i), second.as_mut_ptr().add(i));
                update.sixteen::<S>(g, m, v, values.as_mut_ptr().add(i), rates);
            }
        }
        for i in whole..n {
            let g = told.iter().fold(0.0, |sum, told| sum + told[i]);
            update.one(g, &mut first[i], &mut second[i], &mut values[i], update.adam.rates[i % 8]);
        }
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
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

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

    /// Sixteen and eight side by side are one after the other, to the bit; blocks of any length.
    #[test]
    fn updates_side_by_side_are_those_one_by_one() {
        struct Eights<'a>(Update, &'a [f32], [&'a mut [f32]; 3]);
        impl Task for Eights<'_> {
            type Output = ();
            #[allow(unsafe_code, reason = "the slices hold whole eights")]
            #[inline(always)]
            fn run<S: Simd>(self) {
                let Self(update, g, [m, v, values]) = self;
                for i in (0..g.len() / 8 * 8).step_by(8) {
                    // SAFETY: i + 8 ≤ their length.
                    unsafe {
                        let at = |s: &mut [f32]| s.as_mut_ptr().add(i);
                        let g = [S::q_load(g.as_ptr().add(i)), S::q_load(g.as_ptr().add(i + 4))];
                        update.eight::<S>(g, at(m), at(v), at(values));
                    }
                }
            }
        }
        let mut rng = ChaCha8Rng::seed_from_u64(9);
        let mut numbers =
            |n: usize, size: f32| -> Vec<f32> { (0..n).map(|_| (rng.random::<f32>() - 0.5) * size).collect() };
        let adam = Adam { rates: std::array::from_fn(|i| 0.01 * (i + 1) as f32), ..Adam::new(0.0) };
        for n in [8, 16, 21, 256, 277] {
            let start = numbers(n, 2.0);
            let [mut plain, mut side, mut eight] = [0; 3].map(|_| [vec![0.0; n], vec![0.0; n], start.clone()]);
            for steps in [1, 2, 3, 2047, 2048, 2049, 90_000] {
                let (a, b) = (numbers(n, 1e-3), numbers(n, 1e3));
                let update = Update::new(&adam, steps);
                let sum: Vec<f32> = a.iter().zip(&b).map(|(a, b)| a + b).collect();
                let [m, v, values] = &mut plain;
                for i in 0..n {
                    update.one(sum[i], &mut m[i], &mut v[i], &mut values[i], adam.rates[i % 8]);
                }
                let [m, v, values] = &mut side;
                update.told(&[&a, &b], m, v, values);
                let [m, v, values] = &mut eight;
                crate::simd::run(Eights(update, &sum, [m, v, values]));
            }
            assert_eq!(side, plain, "{n}");
            for (found, expected) in eight.iter().zip(&plain) {
                assert_eq!(found[..n / 8 * 8], expected[..n / 8 * 8], "{n}");
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
