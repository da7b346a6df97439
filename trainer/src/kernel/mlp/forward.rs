//! Forward pass, tile by tile.

use rayon::prelude::*;

use super::network::Network;
use super::rows;
use crate::kernel::matmul::{Matrix, MatrixMut, multiply};
use crate::kernel::scalar::Scalar;
use crate::kernel::{TILE_ROWS, chunk_rows};

/// Own inputs up to which walking the rows beats a matrix product, whose fixed costs dominate such thin shapes.
pub(super) const FEW: usize = 4;

/// Inputs of a pass: `shared` is `[rows, shared]`, `own` `[rows, groups·own]`, `params` `[groups, count]`.
#[derive(Clone, Copy)]
pub(in crate::kernel) struct Inputs<'a, T> {
    pub(in crate::kernel) shared: &'a [T],
    pub(in crate::kernel) own: &'a [T],
    pub(in crate::kernel) params: &'a [T],
}

/// One tile of the inputs with the weights that meet the shared part.
#[derive(Clone, Copy)]
pub(super) struct Tile<'a, T> {
    pub(super) rows: usize,
    pub(super) shared: &'a [T],
    pub(super) own: &'a [T],
}

impl<'a, T: Scalar> Tile<'a, T> {
    /// Rows `start..start + rows` of the inputs.
    pub(super) fn new(network: &Network, inputs: Inputs<'a, T>, start: usize, rows: usize) -> Self {
        let own = network.groups * network.own;
        Self {
            rows,
            shared: &inputs.shared[start * network.shared..][..rows * network.shared],
            own: &inputs.own[start * own..][..rows * own],
        }
    }

    /// The shared part of the input.
    pub(super) fn shared(&self, network: &Network) -> Matrix<'a, T> {
        Matrix::dense(self.shared, self.rows, network.shared)
    }

    /// The part of the input that is one group's own.
    pub(super) fn own(&self, network: &Network, group: usize) -> Matrix<'a, T> {
        let values = &self.own[(group * network.own).min(self.own.len())..];
        Matrix::new(values, self.rows, network.own, network.groups * network.own)
    }
}

/// Result `[rows, groups·outputs]`.
pub(in crate::kernel) fn forward<T: Scalar>(network: &Network, inputs: Inputs<'_, T>) -> Vec<T> {
    let columns = network.groups * network.output_size;
    let mut result = vec![T::ZERO; network.rows * columns];
    let wide_weights = network.gather_wide(inputs.params);
    let chunk = chunk_rows(network.rows, TILE_ROWS);
    result.par_chunks_mut(chunk * columns).enumerate().for_each(|(index, result)| {
        let mut wide = vec![T::ZERO; TILE_ROWS * network.wide()];
        // Two layers' activations, used in turn.
        let mut activations = vec![T::ZERO; 2 * TILE_ROWS * network.width];
        for (tile, result) in result.chunks_mut(TILE_ROWS * columns).enumerate() {
            let rows = result.len() / columns;
            let tile = Tile::new(network, inputs, index * chunk + tile * TILE_ROWS, rows);
            multiply_shared(network, tile, &wide_weights, &mut wide);
            for group in 0..network.groups {
                let params = &inputs.params[group * network.count..][..network.count];
                let (mut previous, mut current) = activations.split_at_mut(TILE_ROWS * network.width);
                for layer in 0..network.depth {
                    (previous, current) = (current, previous);
                    hidden_layer(network, tile, group, params, layer, &wide, previous, current);
                }
                let result = &mut result[group * network.output_size..];
                output_layer(
                    network,
                    rows,
                    params,
                    current,
                    MatrixMut::new(result, rows, network.output_size, columns),
                );
            }
        }
    });
    result
}

/// The shared input's share of every group's input-taking layers, in one product.
pub(super) fn multiply_shared<T: Scalar>(network: &Network, tile: Tile<T>, weights: &[T], wide: &mut [T]) {
    let columns = network.wide();
    if columns > 0 {
        let weights = Matrix::dense(weights, network.shared, columns);
        multiply(tile.shared(network), weights, MatrixMut::dense(wide, tile.rows, columns), false);
    }
}

/// One hidden layer of one group: `current = relu([previous, input] · weights + bias)`.
#[expect(clippy::too_many_arguments, reason = "the whole state of a tile; a struct would only rename it")]
pub(super) fn hidden_layer<T: Scalar>(
    network: &Network,
    tile: Tile<T>,
    group: usize,
    params: &[T],
    layer: usize,
    wide: &[T],
    previous: &[T],
    current: &mut [T],
) {
    let (layer, width, own) = (network.layers[layer], network.width, network.own);
    let current = &mut current[..tile.rows * width];
    let mut written = layer.recurrent > 0;
    if written {
        let weights = Matrix::dense(&params[layer.weight..], width, width);
        let result = MatrixMut::dense(&mut *current, tile.rows, width);
        multiply(Matrix::dense(previous, tile.rows, width), weights, result, false);
    }
    if let Some((start, block)) = layer.input {
        if network.shared > 0 {
            let (stride, column) = (network.wide(), network.wide_column(block, group));
            let shared = Matrix::new(&wide[column..], tile.rows, width, stride);
            rows::add_rows(current, width, shared, !written);
            written = true;
        }
        let input = tile.own(network, group);
        let weights = &params[start + network.shared * width..];
        if own > FEW || !written {
            let weights = Matrix::dense(weights, own, width);
            multiply(input, weights, MatrixMut::dense(&mut *current, tile.rows, width), written);
        } else if own > 0 {
            rows::add_thin_product(current, width, input, weights);
        }
    }
    rows::add_bias_relu(current, &params[layer.bias..layer.bias + width]);
}

/// The output layer of one group, or a copy of the last hidden layer where there is none.
fn output_layer<T: Scalar>(network: &Network, rows: usize, params: &[T], hidden: &[T], result: MatrixMut<T>) {
    let width = network.width;
    let MatrixMut { values, stride, .. } = result;
    let Some((start, units)) = network.output else {
        for (result, hidden) in values.chunks_mut(stride).zip(hidden.chunks_exact(width)).take(rows) {
            result[..width].copy_from_slice(hidden);
        }
        return;
    };
    let weights = Matrix::dense(&params[start..], width, units);
    multiply(Matrix::dense(hidden, rows, width), weights, MatrixMut::new(&mut *values, rows, units, stride), false);
    let bias = &params[start + width * units..][..units];
    for row in values.chunks_mut(stride) {
        for (value, &bias) in row.iter_mut().zip(bias) {
            *value += bias;
        }
    }
}
