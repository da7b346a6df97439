//! Backward pass: each tile repeats its forward pass, then runs it in reverse.

use rayon::prelude::*;

use super::forward::{FEW, Inputs, Tile, hidden_layer, multiply_shared};
use super::network::{Network, transpose};
use super::rows;
use crate::kernel::matmul::{Matrix, MatrixMut, accumulate_transposed, multiply};
use crate::kernel::scalar::Scalar;
use crate::kernel::{TILE_ROWS, chunk_rows};

/// Fewest rows of a chunk, so that its parameter gradients are worth their memory.
const CHUNK_ROWS: usize = 2 * TILE_ROWS;

/// Which gradients are asked for.
#[derive(Debug, Clone, Copy)]
pub(in crate::kernel) struct Wanted {
    pub(in crate::kernel) shared: bool,
    pub(in crate::kernel) own: bool,
    pub(in crate::kernel) params: bool,
}

/// Gradients in the shapes of the inputs; empty where not wanted.
pub(in crate::kernel) struct InputGradients<T> {
    pub(in crate::kernel) shared: Vec<T>,
    pub(in crate::kernel) own: Vec<T>,
    pub(in crate::kernel) params: Vec<T>,
}

/// Transposed weights of a call, so that the products with them read along rows.
struct Transposed<T> {
    /// All groups' parameter runs with each weight matrix transposed in place.
    params: Vec<T>,
    /// `[wide, shared]`.
    wide: Vec<T>,
}

/// Buffers of one chunk.
struct Scratch<T> {
    /// Activations of all hidden layers of the current group.
    activations: Vec<T>,
    wide: Vec<T>,
    wide_gradient: Vec<T>,
    gradient: Vec<T>,
    previous_gradient: Vec<T>,
    /// Where bias gradients go that nobody asked for.
    unwanted: Vec<T>,
}

/// One chunk of rows: where its gradients go.
struct Chunk<'a, T> {
    start: usize,
    upstream: &'a [T],
    shared: &'a mut [T],
    own: &'a mut [T],
    /// Parameter gradients, then those of the wide matrix.
    params: &'a mut [T],
}

/// Gradients of a loss whose gradient with respect to the result is `upstream`, `[rows, groups·outputs]`.
pub(in crate::kernel) fn backward<T: Scalar>(
    network: &Network,
    inputs: Inputs<'_, T>,
    upstream: &[T],
    wanted: Wanted,
) -> InputGradients<T> {
    let zeros = |wanted: bool, len: usize| vec![T::ZERO; if wanted { len } else { 0 }];
    let rows = chunk_rows(network.rows, CHUNK_ROWS);
    let chunks = network.rows.div_ceil(rows);
    let count = network.groups * network.count;
    let partial = count + network.shared * network.wide();
    let own = network.groups * network.own;
    let mut gradients = InputGradients {
        shared: zeros(wanted.shared, network.rows * network.shared),
        own: zeros(wanted.own, network.rows * own),
        params: zeros(wanted.params, partial),
    };
    let mut partials = zeros(wanted.params, chunks * partial);
    let wide_weights = network.gather_wide(inputs.params);
    let transposed = Transposed::new(network, inputs.params, &wide_weights);

    let columns = network.groups * network.output_size;
    let mut shared = gradients.shared.chunks_mut((rows * network.shared).max(1));
    let mut owns = gradients.own.chunks_mut((rows * own).max(1));
    let mut params = partials.chunks_mut(partial);
    let jobs: Vec<_> = upstream
        .chunks(rows * columns)
        .enumerate()
        .map(|(index, upstream)| Chunk {
            start: index * rows,
            upstream,
            shared: shared.next().unwrap_or_default(),
            own: owns.next().unwrap_or_default(),
            params: params.next().unwrap_or_default(),
        })
        .collect();
    jobs.into_par_iter().for_each(|chunk| chunk.run(network, inputs, &wide_weights, &transposed, wanted));

    if wanted.params {
        sum_in_order(&partials, partial, &mut gradients.params);
        let wide = gradients.params.split_off(count);
        network.scatter_wide(&wide, &mut gradients.params);
    }
    gradients
}

/// Adds the chunks' parameter gradients, always in the order of the chunks.
fn sum_in_order<T: Scalar>(partials: &[T], len: usize, sum: &mut [T]) {
    const BLOCK: usize = 16_384;
    sum.par_chunks_mut(BLOCK).enumerate().for_each(|(block, sum)| {
        for partial in partials.chunks_exact(len) {
            for (sum, &value) in sum.iter_mut().zip(&partial[block * BLOCK..]) {
                *sum += value;
            }
        }
    });
}

impl<T: Scalar> Transposed<T> {
    fn new(network: &Network, params: &[T], wide_weights: &[T]) -> Self {
        let width = network.width;
        let mut transposed = vec![T::ZERO; params.len()];
        transposed.par_chunks_mut(network.count).zip(params.par_chunks(network.count)).for_each(|(to, from)| {
            let mut turn = |start: usize, rows: usize, cols: usize| {
                transpose(&from[start..start + rows * cols], cols, &mut to[start..start + rows * cols]);
            };
            for layer in &network.layers {
                turn(layer.weight, layer.recurrent, width);
                if let Some((start, _)) = layer.input {
                    turn(start + network.shared * width, network.own, width);
                }
            }
            if let Some((start, units)) = network.output {
                turn(start, width, units);
            }
        });
        let mut wide = vec![T::ZERO; wide_weights.len()];
        transpose(wide_weights, network.wide(), &mut wide);
        Self { params: transposed, wide }
    }
}

impl<T: Scalar> Scratch<T> {
    fn new(network: &Network) -> Self {
        let layer = TILE_ROWS * network.width;
        let wide = TILE_ROWS * network.wide();
        Self {
            activations: vec![T::ZERO; network.depth * layer],
            wide: vec![T::ZERO; wide],
            wide_gradient: vec![T::ZERO; wide],
            gradient: vec![T::ZERO; layer],
            previous_gradient: vec![T::ZERO; layer],
            unwanted: vec![T::ZERO; network.width],
        }
    }
}

impl<T: Scalar> Chunk<'_, T> {
    fn run(
        mut self,
        network: &Network,
        inputs: Inputs<T>,
        wide_weights: &[T],
        transposed: &Transposed<T>,
        wanted: Wanted,
    ) {
        let mut scratch = Scratch::new(network);
        let columns = network.groups * network.output_size;
        let wide = network.wide();
        for (index, upstream) in self.upstream.chunks(TILE_ROWS * columns).enumerate() {
            let rows = upstream.len() / columns;
            let first = index * TILE_ROWS;
            let tile = Tile::new(network, inputs, self.start + first, rows);
            multiply_shared(network, tile, wide_weights, &mut scratch.wide);
            for group in 0..network.groups {
                self.group(network, tile, first, group, inputs.params, transposed, upstream, &mut scratch, wanted);
            }
            if wide == 0 {
                continue;
            }
            let gradient = Matrix::dense(&scratch.wide_gradient, rows, wide);
            if wanted.params {
                let start = network.groups * network.count;
                let result = MatrixMut::dense(&mut self.params[start..], network.shared, wide);
                accumulate_transposed(tile.shared(network), gradient, result);
            }
            if wanted.shared {
                let result = &mut self.shared[first * network.shared..];
                let weights = Matrix::dense(&transposed.wide, wide, network.shared);
                multiply(gradient, weights, MatrixMut::dense(result, rows, network.shared), false);
            }
        }
    }

    /// One group's share of a tile.
    #[expect(clippy::too_many_arguments, reason = "the whole state of a tile; a struct would only rename it")]
    fn group(
        &mut self,
        network: &Network,
        tile: Tile<T>,
        first: usize,
        group: usize,
        params: &[T],
        transposed: &Transposed<T>,
        upstream: &[T],
        scratch: &mut Scratch<T>,
        wanted: Wanted,
    ) {
        let (rows, width, own) = (tile.rows, network.width, network.own);
        let run = group * network.count..(group + 1) * network.count;
        let (params, transposed) = (&params[run.clone()], &transposed.params[run.clone()]);
        let sums = if wanted.params { &mut self.params[run] } else { &mut [] };
        let plane = TILE_ROWS * width;

        for layer in 0..network.depth {
            let (previous, current) = scratch.activations.split_at_mut(layer * plane);
            let previous = &previous[layer.saturating_sub(1) * plane..];
            hidden_layer(network, tile, group, params, layer, &scratch.wide, previous, current);
        }

        let columns = network.groups * network.output_size;
        let upstream = Matrix::new(&upstream[group * network.output_size..], rows, network.output_size, columns);
        let last = Matrix::dense(&scratch.activations[(network.depth - 1) * plane..], rows, width);
        if let Some((start, units)) = network.output {
            if wanted.params {
                accumulate_transposed(last, upstream, MatrixMut::dense(&mut sums[start..], width, units));
                let bias_sums = &mut sums[start + width * units..][..units];
                rows::sum_columns(upstream, bias_sums);
            }
            let weights = Matrix::dense(&transposed[start..], units, width);
            multiply(upstream, weights, MatrixMut::dense(&mut scratch.gradient, rows, width), false);
        } else {
            for (to, from) in scratch.gradient.chunks_exact_mut(width).zip(upstream.values.chunks(columns)) {
                to.copy_from_slice(&from[..width]);
            }
        }

        // Whether an input-taking layer has written the own gradient already; later ones add to it.
        let mut own_written = false;
        for (index, layer) in network.layers.iter().enumerate().rev() {
            let activations = &scratch.activations[index * plane..][..rows * width];
            let bias_sums =
                if wanted.params { &mut sums[layer.bias..layer.bias + width] } else { &mut scratch.unwanted };
            rows::mask_and_sum(&mut scratch.gradient[..rows * width], activations, bias_sums);
            let gradient = Matrix::dense(&scratch.gradient, rows, width);
            if let Some((start, block)) = layer.input {
                if network.shared > 0 {
                    let (stride, column) = (network.wide(), network.wide_column(block, group));
                    let wide = scratch.wide_gradient.chunks_exact_mut(stride);
                    for (to, from) in wide.zip(scratch.gradient.chunks_exact(width)).take(rows) {
                        to[column..column + width].copy_from_slice(from);
                    }
                }
                let start = start + network.shared * width;
                if own > 0 && wanted.params {
                    let (input, sums) = (tile.own(network, group), &mut sums[start..start + own * width]);
                    if own > FEW {
                        accumulate_transposed(input, gradient, MatrixMut::dense(sums, own, width));
                    } else {
                        rows::add_thin_transposed(sums, input, gradient);
                    }
                }
                if own > 0 && wanted.own {
                    let stride = network.groups * own;
                    let result = &mut self.own[first * stride + group * own..];
                    if own > FEW {
                        let weights = Matrix::dense(&transposed[start..], width, own);
                        multiply(gradient, weights, MatrixMut::new(result, rows, own, stride), own_written);
                    } else {
                        let weights = Matrix::dense(&params[start..], own, width);
                        rows::thin_back_product(result, stride, gradient, weights, own_written);
                    }
                    own_written = true;
                }
            }
            if layer.recurrent > 0 {
                let previous = Matrix::dense(&scratch.activations[(index - 1) * plane..], rows, width);
                if wanted.params {
                    accumulate_transposed(
                        previous,
                        gradient,
                        MatrixMut::dense(&mut sums[layer.weight..], width, width),
                    );
                }
                let weights = Matrix::dense(&transposed[layer.weight..], width, width);
                let result = MatrixMut::dense(&mut scratch.previous_gradient, rows, width);
                multiply(gradient, weights, result, false);
                std::mem::swap(&mut scratch.gradient, &mut scratch.previous_gradient);
            }
        }
    }
}
