//! Plain twins of the fused operations: the same mathematics, layer by layer on Burn tensors.
//!
//! They run on devices and element types the fused operations do not know, and tests hold the two against each other.

#![expect(clippy::needless_pass_by_value, reason = "the same signatures as the fused operations")]

use burn::tensor::activation::relu;
use burn::tensor::{DType, Tensor};

use super::{EncodingSpec, MlpSpec, Products};

/// A matrix product in the numbers that the network wants; the result in those of `a`.
fn product<const D: usize>(a: Tensor<D>, b: Tensor<D>, spec: &MlpSpec) -> Tensor<D> {
    match spec.products {
        Products::F32 => a.matmul(b),
        Products::Bf16 => {
            let own = a.dtype();
            a.cast(DType::BF16).matmul(b.cast(DType::BF16)).cast(own)
        }
    }
}

/// Twin of [`mlp_forward`](super::mlp_forward).
pub fn mlp(x: Tensor<2>, params: Tensor<1>, spec: &MlpSpec) -> Tensor<2> {
    let [_, inputs] = x.dims();
    let mut start = 0;
    let mut hidden = x.clone();
    for (layer, (rows, cols)) in spec.layers(inputs).enumerate() {
        let weights = params.clone().narrow(0, start, rows * cols).reshape([rows, cols]);
        let bias = params.clone().narrow(0, start + rows * cols, cols).reshape([1, cols]);
        start += (rows + 1) * cols;
        if layer > 0 && spec.skip == Some(layer) {
            hidden = Tensor::cat(vec![hidden, x.clone()], 1);
        }
        hidden = product(hidden, weights, spec) + bias;
        if layer < spec.depth {
            hidden = relu(hidden);
        }
    }
    hidden
}

/// Twin of [`mlp_forward_with_ray`](super::mlp_forward_with_ray): the ray's products are done once per ray.
pub fn mlp_with_ray(x: Tensor<2>, ray: Tensor<2>, params: Tensor<1>, spec: &MlpSpec) -> Tensor<2> {
    let ([rows, a], [rays, b]) = (x.dims(), ray.dims());
    let mut start = 0;
    let mut hidden = x.clone();
    for (layer, (inputs, cols)) in spec.layers(a + b).enumerate() {
        let weights = params.clone().narrow(0, start, inputs * cols).reshape([inputs, cols]);
        let bias = params.clone().narrow(0, start + inputs * cols, cols).reshape([1, cols]);
        start += (inputs + 1) * cols;
        let skips = layer > 0 && spec.skip == Some(layer);
        hidden = if layer == 0 || skips {
            let of_rows = weights.clone().narrow(0, 0, inputs - b);
            let of_ray = product(ray.clone(), weights.narrow(0, inputs - b, b), spec) + bias;
            let rows_in = if skips { Tensor::cat(vec![hidden, x.clone()], 1) } else { hidden };
            let of_rows = product(rows_in, of_rows, spec).reshape([rays, rows / rays, cols]);
            (of_rows + of_ray.unsqueeze_dim::<3>(1)).reshape([rows, cols])
        } else {
            product(hidden, weights, spec) + bias
        };
        if layer < spec.depth {
            hidden = relu(hidden);
        }
    }
    hidden
}

/// Twin of [`grouped_mlp_forward`](super::grouped_mlp_forward): the shared input meets the weights of all networks in one
/// product, the rest is batched over the networks (fact sheet §5.4, item 3).
pub fn grouped_mlp(shared: Tensor<2>, own: Tensor<2>, params: Tensor<2>, spec: &MlpSpec) -> Tensor<2> {
    let ([rows, s], [_, own_size], [groups, _]) = (shared.dims(), own.dims(), params.dims());
    let o = own_size / groups;
    // `[G, rows, o]`, where there is something of the networks' own.
    let own = (o > 0).then(|| own.reshape([rows, groups, o]).swap_dims(0, 1));
    let mut start = 0;
    let mut hidden: Option<Tensor<3>> = None;
    for (layer, (inputs, cols)) in spec.layers(s + o).enumerate() {
        let part = |from: usize, count: usize| {
            params.clone().narrow(1, start + from * cols, count * cols).reshape([groups, count, cols])
        };
        let recurrent = if layer == 0 { 0 } else { spec.width };
        let mut sum = part(inputs, 1);
        if let Some(hidden) = hidden.take() {
            sum = product(hidden, part(0, recurrent), spec) + sum;
        }
        if inputs > recurrent {
            if s > 0 {
                let weights = part(recurrent, s).swap_dims(0, 1).reshape([s, groups * cols]);
                sum = product(shared.clone(), weights, spec).reshape([rows, groups, cols]).swap_dims(0, 1) + sum;
            }
            if let Some(own) = &own {
                sum = product(own.clone(), part(recurrent + s, o), spec) + sum;
            }
        }
        start += (inputs + 1) * cols;
        hidden = Some(if layer < spec.depth { relu(sum) } else { sum });
    }
    let columns = spec.output_size();
    hidden.map_or_else(
        || Tensor::zeros([rows, 0], (&params.device(), params.dtype())),
        |h| h.swap_dims(0, 1).reshape([rows, groups * columns]),
    )
}

/// Twin of [`positional_encoding`](super::positional_encoding).
pub fn positional_encoding(x: Tensor<2>, spec: &EncodingSpec) -> Tensor<2> {
    let mut parts = Vec::new();
    if spec.identity {
        parts.push(x.clone());
    }
    for (band, &weight) in spec.bands.clone().zip(&spec.window) {
        let scaled = x.clone() * f64::from(band).exp2();
        parts.push(scaled.clone().sin() * weight);
        parts.push(scaled.cos() * weight);
    }
    Tensor::cat(parts, 1)
}

/// Twin of [`composite`](super::composite).
pub fn composite(sigma: Tensor<2>, deltas: Tensor<2>, values: Tensor<3>) -> (Tensor<2>, Tensor<2>) {
    let [rays, samples] = sigma.dims();
    let depth = sigma * deltas;
    let mut before = vec![Tensor::zeros([rays, 1], (&depth.device(), depth.dtype()))];
    if samples > 1 {
        before.push(depth.clone().narrow(1, 0, samples - 1).cumsum(1));
    }
    let before = Tensor::cat(before, 1);
    let weights = before.neg().exp() * (depth.neg().exp().neg() + 1.0);
    let rendered = (values * weights.clone().unsqueeze_dim(2)).sum_dim(1).squeeze_dim(1);
    (rendered, weights)
}
