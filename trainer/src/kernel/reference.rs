//! Plain twins of the fused operations: the same mathematics, layer by layer on Burn tensors.
//!
//! They run on devices and element types the fused operations do not know, and tests hold the two against each other.

#![expect(clippy::needless_pass_by_value, reason = "the same signatures as the fused operations")]

use burn::tensor::Tensor;
use burn::tensor::activation::relu;

use super::{EncodingSpec, MlpSpec};

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
        hidden = hidden.matmul(weights) + bias;
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
            let of_ray = ray.clone().matmul(weights.narrow(0, inputs - b, b)) + bias;
            let rows_in = if skips { Tensor::cat(vec![hidden, x.clone()], 1) } else { hidden };
            let product = rows_in.matmul(of_rows).reshape([rays, rows / rays, cols]);
            (product + of_ray.unsqueeze_dim::<3>(1)).reshape([rows, cols])
        } else {
            hidden.matmul(weights) + bias
        };
        if layer < spec.depth {
            hidden = relu(hidden);
        }
    }
    hidden
}

/// Twin of [`grouped_mlp_forward`](super::grouped_mlp_forward).
pub fn grouped_mlp(shared: Tensor<2>, own: Tensor<2>, params: Tensor<2>, spec: &MlpSpec) -> Tensor<2> {
    let ([_, shared_size], [_, own_size], [groups, count]) = (shared.dims(), own.dims(), params.dims());
    let size = own_size / groups;
    let networks = (0..groups).map(|group| {
        let own = (size > 0).then(|| own.clone().narrow(1, group * size, size));
        let input = match own {
            Some(own) if shared_size > 0 => Tensor::cat(vec![shared.clone(), own], 1),
            Some(own) => own,
            None => shared.clone(),
        };
        mlp(input, params.clone().narrow(0, group, 1).reshape([count]), spec)
    });
    Tensor::cat(networks.collect(), 1)
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
