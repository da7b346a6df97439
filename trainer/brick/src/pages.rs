//! Gradients of a level's features, in pages that exist while something was written to them.
//!
//! A step reaches a small part of a fine level. An array as long as the level would cost every thread as much memory as
//! the features themselves, and every write a miss of the address cache; pages of one block each, handed out in the order
//! of their first write, lie close together and are cleared with one short fill.

use rayon::prelude::*;

use crate::field::{FEATURES, LAYER_VERTICES};
use crate::lattice::Corners;
use crate::table::{Adam, Table, Update};

/// Numbers of a page: a block of a level's table.
const PAGE: usize = LAYER_VERTICES * FEATURES;

/// Gradients of a level's features, gathered by one thread.
#[derive(Clone, Debug, Default)]
pub struct PageGrad {
    /// Page of each block, from 1; 0 for none.
    page_of: Vec<u32>,
    /// The block of each page.
    blocks: Vec<u32>,
    /// The pages' numbers; what lies beyond the pages in use is 0.
    values: Vec<f32>,
}

impl PageGrad {
    /// Makes room for `table`.
    pub fn fit(&mut self, table: &Table) {
        debug_assert_eq!(table.block, PAGE, "a level's table");
        if self.page_of.len() < table.blocks() {
            self.page_of.resize(table.blocks(), 0);
        }
    }

    /// Gives all pages back.
    pub fn clear(&mut self) {
        self.values[..self.blocks.len() * PAGE].fill(0.0);
        for block in self.blocks.drain(..) {
            self.page_of[block as usize] = 0;
        }
    }

    /// Gives every block a page.
    pub fn touch_all(&mut self) {
        (0..self.page_of.len()).for_each(|block| {
            self.page(block);
        });
    }

    /// The page of a block, from 0.
    #[inline(always)]
    fn page(&mut self, block: usize) -> usize {
        match self.page_of[block] {
            0 => self.open(block),
            page => page as usize - 1,
        }
    }

    #[cold]
    fn open(&mut self, block: usize) -> usize {
        let page = self.blocks.len();
        self.blocks.push(block as u32);
        self.page_of[block] = page as u32 + 1;
        if self.values.len() < self.blocks.len() * PAGE {
            self.values.resize(self.blocks.len() * PAGE, 0.0);
        }
        page
    }

    /// The corners as places in the pages' numbers.
    #[inline(always)]
    pub(crate) fn places(&mut self, corners: &Corners) -> Corners {
        const LAYER: u32 = LAYER_VERTICES as u32;
        let mut places = *corners;
        let (mut block, mut page) = (u32::MAX, 0);
        for i in &mut places.index {
            // Corners lie in one or two blocks mostly.
            if *i / LAYER != block {
                block = *i / LAYER;
                page = self.page(block as usize) as u32;
            }
            *i = page * LAYER + *i % LAYER;
        }
        places
    }

    /// The pages' numbers.
    #[inline(always)]
    pub(crate) fn values(&mut self) -> &mut [f32] {
        &mut self.values
    }

    /// What was gathered for a block.
    fn of(&self, block: usize) -> Option<&[f32]> {
        let page = (*self.page_of.get(block)? as usize).checked_sub(1)?;
        Some(&self.values[page * PAGE..(page + 1) * PAGE])
    }

    /// Adds what was gathered to an array of all blocks.
    pub(crate) fn add_to(&self, whole: &mut [f32]) {
        for (page, &block) in self.blocks.iter().enumerate() {
            let sum = &mut whole[block as usize * PAGE..(block as usize + 1) * PAGE];
            sum.iter_mut().zip(&self.values[page * PAGE..]).for_each(|(a, b)| *a += b);
        }
    }

    /// As one array of all blocks.
    #[cfg(test)]
    pub(crate) fn dense(&self) -> Vec<f32> {
        (0..self.page_of.len())
            .flat_map(|block| self.of(block).map_or_else(|| vec![0.0; PAGE], <[f32]>::to_vec))
            .collect()
    }
}

/// Updates the blocks that any of `grads` has a page for, from `from_block` on, with their sum in the order of `grads`.
pub(crate) fn step(table: &mut Table, grads: &[&PageGrad], adam: &Adam, from_block: usize) {
    /// Blocks that one thread takes at a time.
    const SHARE: usize = 128;
    let Table { values, first, second, steps, .. } = table;
    let numbers = SHARE * PAGE;
    values
        .par_chunks_mut(numbers)
        .zip(first.par_chunks_mut(numbers))
        .zip(second.par_chunks_mut(numbers))
        .zip(steps.par_chunks_mut(SHARE))
        .enumerate()
        .for_each(|(share, (((values, first), second), steps))| {
            let rows =
                values.chunks_exact_mut(PAGE).zip(first.chunks_exact_mut(PAGE)).zip(second.chunks_exact_mut(PAGE));
            let mut told = Vec::with_capacity(grads.len());
            for (i, (((values, first), second), steps)) in rows.zip(steps).enumerate() {
                let block = share * SHARE + i;
                told.clear();
                told.extend(grads.iter().filter_map(|grad| grad.of(block)));
                if block < from_block || told.is_empty() {
                    continue;
                }
                *steps += 1;
                Update::new(adam, *steps).told(&told, first, second, values);
            }
        });
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::table::TableGrad;

    fn corners(vertices: [u32; 8]) -> Corners {
        Corners { index: vertices, t: [0.25, 0.5, 0.75] }
    }

    /// Pages are what whole arrays are, to the bit: gathered by two threads, over steps, with blocks that come late.
    #[test]
    fn pages_update_a_table_as_whole_arrays_do() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let mut paged = Table::new(300, PAGE, || rng.random::<f32>());
        let mut whole = paged.clone();
        let adam = Adam::new(0.01);
        let mut grads = [PageGrad::default(), PageGrad::default()];
        for step_number in 0..4 {
            let mut arrays = [TableGrad::default(), TableGrad::default()];
            for (pages, array) in grads.iter_mut().zip(&mut arrays) {
                pages.clear();
                pages.fit(&paged);
                array.fit(&whole);
                for _ in 0..200 {
                    let blocks = 300 - 60 * (3 - step_number);
                    let vertex = |rng: &mut ChaCha8Rng| rng.random_range(0..blocks * LAYER_VERTICES) as u32;
                    let c = corners(std::array::from_fn(|_| vertex(&mut rng)));
                    let value = rng.random::<f32>() - 0.5;
                    let places = pages.places(&c);
                    let values = pages.values();
                    for (place, vertex) in places.index.into_iter().zip(c.index) {
                        values[place as usize * FEATURES + 1] += value;
                        array.values[vertex as usize * FEATURES + 1] += value;
                        array.touched[vertex as usize / LAYER_VERTICES] = true;
                    }
                }
                assert_eq!(pages.dense(), array.values);
            }
            step(&mut paged, &[&grads[0], &grads[1]], &adam, 8);
            let [a, b] = &mut arrays;
            whole.step(&mut [a, b], &adam, 8);
            assert_eq!(paged.values, whole.values, "step {step_number}");
            assert_eq!(paged.steps, whole.steps);
        }
        assert!(paged.steps[..8].iter().all(|&s| s == 0) && paged.steps[8..].iter().any(|&s| s > 1));
    }

    #[test]
    fn all_blocks_can_be_touched() {
        let table = Table::new(5, PAGE, || 1.0);
        let mut grad = PageGrad::default();
        grad.fit(&table);
        grad.touch_all();
        assert!((0..5).all(|block| grad.of(block).is_some()));
        grad.clear();
        assert!((0..5).all(|block| grad.of(block).is_none()) && grad.dense().iter().all(|&v| v == 0.0));
    }
}
