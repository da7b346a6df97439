//! Fused multilayer perceptrons.

mod backward;
mod forward;
mod network;
mod rows;

use burn::backend::Dispatch;
use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

use super::{is_fused, reference};

pub(super) use backward::{Wanted, backward};
pub(super) use forward::{Inputs, forward};
pub(super) use network::Network;

/// Shape of a multilayer perceptron: `depth` hidden layers of `width` with ReLU, then an optional linear layer.
///
/// Parameters arrive as one flat run: for each layer in order its weights, row-major `[in, out]`, then its bias
/// `[out]`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MlpSpec {
    /// Hidden layers, at least 1.
    pub depth: usize,
    /// Units per hidden layer, at least 1.
    pub width: usize,
    /// Hidden layer, counted from 0, that takes `[h, input]` instead of `h`: the network's input is appended after
    /// the activation before it. Between 1 and `depth - 1`.
    pub skip: Option<usize>,
    /// Units of the linear output layer; `None` returns the last hidden layer's activations.
    pub output: Option<usize>,
    /// The numbers of its matrix products.
    pub products: Products,
}

/// The numbers that matrix products are made of; their sums, and all else, keep the tensors' own type.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Products {
    /// The tensors' own numbers.
    #[default]
    F32,
    /// Factors rounded to bfloat16 (8 bits of precision), there and back: tensor cores are up to 16 times as fast with
    /// them. The fused CPU kernels do not know it: plain operations take their place.
    Bf16,
}

impl MlpSpec {
    /// Units of the result.
    pub fn output_size(&self) -> usize {
        self.output.unwrap_or(self.width)
    }

    /// Inputs and outputs of each layer, the output layer last.
    pub fn layers(&self, inputs: usize) -> impl Iterator<Item = (usize, usize)> {
        let Self { width, skip, .. } = *self;
        let hidden = (0..self.depth).map(move |layer| match layer {
            0 => (inputs, width),
            _ if skip == Some(layer) => (width + inputs, width),
            _ => (width, width),
        });
        hidden.chain(self.output.map(|output| (width, output)))
    }

    /// Length of the flat parameter run for a network of `inputs` inputs.
    pub fn parameter_count(&self, inputs: usize) -> usize {
        self.layers(inputs).map(|(rows, cols)| (rows + 1) * cols).sum()
    }

    /// Whether the fused operation does it where `tensor` lives.
    fn is_fused<const D: usize>(&self, tensor: &Tensor<D>) -> bool {
        self.products == Products::F32 && is_fused(tensor)
    }

    /// Panics on a shape that is no network.
    fn check(&self) {
        assert!(self.depth > 0 && self.width > 0, "an MLP needs a hidden layer and a width: {self:?}");
        assert!(self.output != Some(0), "an MLP's output layer needs units: {self:?}");
        if let Some(skip) = self.skip {
            assert!((1..self.depth).contains(&skip), "an MLP's skip layer lies behind the first layer: {self:?}");
        }
    }
}

/// One MLP over a batch: `x` is `[n, inputs]`, `params` the flat run described at [`MlpSpec`], the result
/// `[n, outputs]`.
///
/// Differentiable in `x` and `params`. Nothing is recorded for inputs without autodiff.
///
/// # Panics
///
/// Panics if `params` does not have the length the shapes ask for, as Burn does on shape mismatch.
pub fn mlp_forward(x: Tensor<2>, params: Tensor<1>, spec: &MlpSpec) -> Tensor<2> {
    spec.check();
    let ([_, inputs], [count]) = (x.dims(), params.dims());
    assert_eq!(count, spec.parameter_count(inputs), "parameters of an MLP of {inputs} inputs and {spec:?}");
    if !spec.is_fused(&x) {
        return reference::mlp(x, params, spec);
    }
    Tensor::from_dispatch(<Dispatch as super::extension::Kernels>::fused_mlp(
        x.into_dispatch(),
        params.into_dispatch(),
        *spec,
    ))
}

/// `G` MLPs of one shape over a batch; network `g` takes `[shared, own_g]`.
///
/// `shared` is `[n, s]` (s may be 0), `own` is `[n, G·o]` with the part of each network side by side (o may be 0),
/// `params` is `[G, count]`, one flat run per network (see [`MlpSpec`]). The result is `[n, G·outputs]`. The shared
/// part of the first and the skip layer is one product for all networks.
///
/// Differentiable in all three.
///
/// # Panics
///
/// Panics if the shapes do not fit each other, as Burn does.
pub fn grouped_mlp_forward(shared: Tensor<2>, own: Tensor<2>, params: Tensor<2>, spec: &MlpSpec) -> Tensor<2> {
    spec.check();
    let ([rows, shared_size], [own_rows, own_size], [groups, count]) = (shared.dims(), own.dims(), params.dims());
    assert_eq!(rows, own_rows, "rows of the shared and the own input");
    assert!(groups > 0 && own_size.is_multiple_of(groups), "{own_size} own inputs for {groups} networks");
    let inputs = shared_size + own_size / groups;
    assert_eq!(count, spec.parameter_count(inputs), "parameters of an MLP of {inputs} inputs and {spec:?}");
    if !spec.is_fused(&shared) {
        return reference::grouped_mlp(shared, own, params, spec);
    }
    Tensor::from_dispatch(<Dispatch as super::extension::Kernels>::fused_grouped_mlp(
        shared.into_dispatch(),
        own.into_dispatch(),
        params.into_dispatch(),
        *spec,
    ))
}

/// What is constant along a ray, for each of its samples: `[r, c]` to `[r · s, c]`.
pub fn per_sample(ray: &Tensor<2>, samples: usize) -> Tensor<2> {
    let [rays, columns] = ray.dims();
    ray.clone().unsqueeze_dim::<3>(1).expand([rays, samples, columns]).reshape([rays * samples, columns])
}

/// [`mlp_forward`] of `[x, ray]`, where `ray`, `[r, b]`, belongs to all of a ray's rows in `x`, `[r · s, a]`.
///
/// # Panics
///
/// As [`mlp_forward`].
pub fn mlp_forward_with_ray(x: Tensor<2>, ray: &Tensor<2>, params: Tensor<1>, spec: &MlpSpec) -> Tensor<2> {
    let ([rows, a], [rays, b], [count]) = (x.dims(), ray.dims(), params.dims());
    assert!(rows.is_multiple_of(rays), "{rows} rows of {rays} rays");
    if spec.is_fused(&x) {
        return mlp_forward(Tensor::cat(vec![x, per_sample(ray, rows / rays)], 1), params, spec);
    }
    spec.check();
    assert_eq!(count, spec.parameter_count(a + b), "parameters of an MLP of {a} + {b} inputs and {spec:?}");
    reference::mlp_with_ray(x, ray.clone(), params, spec)
}
