//! One field: multi-resolution features and a tiny network that turns them into density and colour.
//!
//! ```text
//! x  ─ levels ─▶ 6 × 4 ┐
//! expression ─▶ 5     ├─▶ 32 ─▶ 32 ReLU ─▶ [density, 15] ─┐
//! 1 ───────────────────┘        direction, 1 ──────────────┴─▶ 24 ─▶ 32 ReLU ─▶ RGB
//! ```

use rand::Rng;

use crate::lattice::{BRICK, Lattice};
use crate::pages::PageGrad;
use crate::table::{Table, TableGrad};

/// Vertices of a level that are updated together: a layer of a brick. Whole bricks would move eight times as many numbers,
/// most of them with a gradient of 0.
pub const LAYER_VERTICES: usize = 64;
/// Blocks of a level's table per brick.
pub const LAYERS: usize = BRICK / LAYER_VERTICES;
/// Most levels a field can have.
pub const LEVELS: usize = 6;
/// Features per vertex.
pub const FEATURES: usize = 4;
/// Inputs of the first layer.
pub const INPUT: usize = 32;
/// Hidden units.
pub const HIDDEN: usize = 32;
/// Density and what the colour part sees.
pub const MIDDLE: usize = 16;
/// Inputs of the colour part.
pub const COLOR_INPUT: usize = 24;
/// Outputs of the colour part; the first three are used.
pub const OUTPUT: usize = 16;
/// Where the expression's features start in the input.
pub const EXPRESSION_AT: usize = LEVELS * FEATURES;
/// The input that is always 1.
pub const ONE_AT: usize = EXPRESSION_AT + 5;

/// Where each layer's weights start.
pub(crate) const LAYER: [usize; 5] = {
    let a = INPUT * HIDDEN;
    let b = a + HIDDEN * MIDDLE;
    let c = b + COLOR_INPUT * HIDDEN;
    [0, a, b, c, c + HIDDEN * OUTPUT]
};

/// A field's trainable parts.
#[derive(Clone, Debug)]
pub struct Field {
    /// Lattices from coarse to fine.
    pub levels: Vec<Lattice>,
    /// Their features.
    pub features: Vec<Table>,
    /// The network's weights, one block.
    pub net: Table,
    /// Levels in use, from the coarsest; finer ones give 0.
    pub live: usize,
}

/// Gradients of a [`Field`].
#[derive(Clone, Debug, Default)]
pub struct FieldGrad {
    /// Per level.
    pub features: Vec<PageGrad>,
    /// The network's.
    pub net: TableGrad,
}

impl Field {
    /// Lattices without numbers.
    ///
    /// # Panics
    /// With more than [`LEVELS`] levels.
    pub fn empty(levels: Vec<Lattice>) -> Self {
        assert!(levels.len() <= LEVELS, "at most {LEVELS} levels");
        let features = levels.iter().map(|_| Table::empty(LAYER_VERTICES * FEATURES)).collect();
        Self { levels, features, net: Table::empty(LAYER[4]), live: 2 }
    }

    /// Small random features, uniform weights after He.
    pub fn draw(&mut self, rng: &mut impl Rng) {
        for (level, features) in self.levels.iter().zip(&mut self.features) {
            let empty = if level.sparse { BRICK * FEATURES } else { 0 };
            let mut at = 0;
            *features = Table::new(level.slots * LAYERS, features.block, || {
                at += 1;
                if at <= empty { 0.0 } else { (rng.random::<f32>() - 0.5) * 2e-2 }
            });
        }
        let mut at = 0;
        self.net = Table::new(1, LAYER[4], || {
            let layer = LAYER.iter().rposition(|&start| start <= at).unwrap_or(0).min(3);
            at += 1;
            let fan_in = [INPUT, HIDDEN, COLOR_INPUT, HIDDEN][layer] as f32;
            let gain = if layer == 3 { 0.3 } else { 1.0 };
            (rng.random::<f32>() * 2.0 - 1.0) * (6.0 / fan_in).sqrt() * gain
        });
    }

    /// Gives small random features to the bricks that a level's lattice has taken in. All at once: a table of hundreds of
    /// megabytes that moves stands in memory twice.
    pub fn grow(&mut self, level: usize, rng: &mut impl Rng) {
        let table = &mut self.features[level];
        let from = table.values.len();
        table.grow(self.levels[level].slots * LAYERS);
        for v in &mut table.values[from..] {
            *v = (rng.random::<f32>() - 0.5) * 2e-3;
        }
    }

    /// The network's weights, transposed layer by layer, for the way back; inputs padded to 32.
    pub(crate) fn transposed(&self) -> Transposed {
        let w = &self.net.values;
        let turn = |layer: usize, rows: usize, columns: usize, padded: usize| {
            let mut out = vec![0.0; columns * padded];
            for r in 0..rows {
                for c in 0..columns {
                    out[c * padded + r] = w[LAYER[layer] + r * columns + c];
                }
            }
            out
        };
        Transposed([
            turn(0, INPUT, HIDDEN, 32),
            turn(1, HIDDEN, MIDDLE, 32),
            turn(2, COLOR_INPUT, HIDDEN, 32),
            turn(3, HIDDEN, OUTPUT, 32),
        ])
    }
}

/// Weights for the way back.
#[derive(Clone, Debug)]
pub struct Transposed(pub(crate) [Vec<f32>; 4]);

impl FieldGrad {
    /// Makes room for `field`, and forgets what was gathered for features.
    pub fn fit(&mut self, field: &Field) {
        self.features.resize_with(field.features.len(), PageGrad::default);
        for (g, t) in self.features.iter_mut().zip(&field.features) {
            g.clear();
            g.fit(t);
        }
        self.net.fit(&field.net);
    }
}

/// The direction's part of the colour input: 8 monomials of a unit vector.
#[inline(always)]
pub(crate) fn monomials([x, y, z]: [f32; 3]) -> [f32; 8] {
    [x, y, z, x * y, y * z, x * z, x * x, y * y]
}
