//! Where everything lies: parameter offsets, and weights rearranged for the products of one call.

use super::MlpSpec;
use crate::kernel::scalar::Scalar;

/// One hidden layer's place in a network's parameter run.
#[derive(Debug, Clone, Copy)]
pub(in crate::kernel) struct Layer {
    /// Rows of the weights that meet the previous layer (0 for the first layer).
    pub(super) recurrent: usize,
    /// Start of the weights that meet the previous layer.
    pub(super) weight: usize,
    /// If the layer takes the network's input: where those weights start and its column block in the wide matrix.
    pub(super) input: Option<(usize, usize)>,
    /// Start of the bias.
    pub(super) bias: usize,
}

/// Shapes and offsets of `groups` equal networks over a batch.
#[derive(Debug, Clone)]
pub(in crate::kernel) struct Network {
    pub(in crate::kernel) rows: usize,
    pub(in crate::kernel) shared: usize,
    pub(in crate::kernel) own: usize,
    pub(in crate::kernel) groups: usize,
    pub(super) depth: usize,
    pub(super) width: usize,
    pub(super) layers: Vec<Layer>,
    /// Start of the output layer's weights and its units.
    pub(super) output: Option<(usize, usize)>,
    /// Units of the result of one network.
    pub(in crate::kernel) output_size: usize,
    /// Parameters of one network.
    pub(in crate::kernel) count: usize,
}

impl Network {
    pub(in crate::kernel) fn new(rows: usize, shared: usize, own: usize, groups: usize, spec: &MlpSpec) -> Self {
        let inputs = shared + own;
        let mut start = 0;
        let mut layers = Vec::with_capacity(spec.depth);
        let mut blocks = 0;
        for (index, (layer_inputs, units)) in spec.layers(inputs).enumerate().take(spec.depth) {
            let recurrent = if index == 0 { 0 } else { spec.width };
            let input = (layer_inputs > recurrent).then_some((start + recurrent * units, blocks));
            blocks += usize::from(input.is_some());
            let bias = start + layer_inputs * units;
            layers.push(Layer { recurrent, weight: start, input, bias });
            start = bias + units;
        }
        Self {
            rows,
            shared,
            own,
            groups,
            depth: spec.depth,
            width: spec.width,
            layers,
            output: spec.output.map(|units| (start, units)),
            output_size: spec.output_size(),
            count: spec.parameter_count(inputs),
        }
    }

    /// Columns of the wide matrix: a block of all groups' units for each layer that takes the input.
    pub(super) fn wide(&self) -> usize {
        if self.shared == 0 {
            0
        } else {
            self.layers.iter().filter(|l| l.input.is_some()).count() * self.groups * self.width
        }
    }

    /// First column of a group's units in an input-taking layer's block of the wide matrix.
    pub(super) fn wide_column(&self, block: usize, group: usize) -> usize {
        (block * self.groups + group) * self.width
    }

    /// The weights that meet the shared input, of all groups and layers side by side: `[shared, wide]`.
    pub(super) fn gather_wide<T: Scalar>(&self, params: &[T]) -> Vec<T> {
        let wide = self.wide();
        let mut gathered = vec![T::ZERO; self.shared * wide];
        for (param, column) in self.wide_runs() {
            for row in 0..self.shared {
                let from = param + row * self.width;
                gathered[row * wide + column..][..self.width].copy_from_slice(&params[from..from + self.width]);
            }
        }
        gathered
    }

    /// Writes a gradient of the wide matrix back to the places of the parameters.
    pub(super) fn scatter_wide<T: Scalar>(&self, gathered: &[T], params: &mut [T]) {
        let wide = self.wide();
        for (param, column) in self.wide_runs() {
            for row in 0..self.shared {
                let to = param + row * self.width;
                params[to..to + self.width].copy_from_slice(&gathered[row * wide + column..][..self.width]);
            }
        }
    }

    /// First parameter and first wide column of each group's and layer's shared weights.
    fn wide_runs(&self) -> impl Iterator<Item = (usize, usize)> {
        let inputs = self.layers.iter().filter_map(|layer| layer.input);
        let inputs = if self.shared == 0 { None } else { Some(inputs) };
        inputs.into_iter().flatten().flat_map(move |(start, block)| {
            (0..self.groups).map(move |group| (group * self.count + start, self.wide_column(block, group)))
        })
    }
}

/// Row-major `[rows, cols]` to `[cols, rows]`.
pub(super) fn transpose<T: Scalar>(values: &[T], cols: usize, transposed: &mut [T]) {
    if cols == 0 {
        return;
    }
    let rows = values.len() / cols;
    for (row, values) in values.chunks_exact(cols).enumerate() {
        for (col, &value) in values.iter().enumerate() {
            transposed[col * rows + row] = value;
        }
    }
}
