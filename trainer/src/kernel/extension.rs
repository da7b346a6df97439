//! The fused operations as nodes of Burn: routing by device, recording for autodiff, the implementation on Flex.

use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, backend_extension};
use burn::tensor::{DType, Shape};
use burn_flex::{Flex, FlexTensor};

use super::composite::{self, Rays};
use super::encoding::{self, EncodingSpec};
use super::mlp::{self, Inputs, MlpSpec, Network, Wanted};
use super::scalar::{Scalar, contiguous};

/// The differentiable operations. Shapes are checked by the public functions that call them.
#[backend_extension(Autodiff, Flex)]
pub(super) trait Kernels: Backend {
    /// See [`super::mlp_forward`].
    fn fused_mlp(x: FloatTensor<Self>, params: FloatTensor<Self>, spec: MlpSpec) -> FloatTensor<Self>;

    /// See [`super::grouped_mlp_forward`].
    fn fused_grouped_mlp(
        shared: FloatTensor<Self>,
        own: FloatTensor<Self>,
        params: FloatTensor<Self>,
        spec: MlpSpec,
    ) -> FloatTensor<Self>;

    /// See [`super::positional_encoding`].
    fn fused_encoding(x: FloatTensor<Self>, spec: EncodingSpec) -> FloatTensor<Self>;

    /// See [`super::composite`]; the rendered values and the weights side by side.
    fn fused_composite(
        sigma: FloatTensor<Self>,
        deltas: FloatTensor<Self>,
        values: FloatTensor<Self>,
    ) -> FloatTensor<Self>;
}

/// Gradients of the operations, on backends without autodiff. `wanted` says which ones are asked for.
pub(super) trait Gradient: Kernels {
    /// Of [`Kernels::fused_mlp`] in `x` and `params`.
    fn mlp_gradient(
        inputs: [FloatTensor<Self>; 2],
        spec: MlpSpec,
        upstream: FloatTensor<Self>,
        wanted: [bool; 2],
    ) -> [Option<FloatTensor<Self>>; 2];

    /// Of [`Kernels::fused_grouped_mlp`] in `shared`, `own` and `params`.
    fn grouped_mlp_gradient(
        inputs: [FloatTensor<Self>; 3],
        spec: MlpSpec,
        upstream: FloatTensor<Self>,
        wanted: [bool; 3],
    ) -> [Option<FloatTensor<Self>>; 3];

    /// Of [`Kernels::fused_encoding`] in `x`.
    fn encoding_gradient(
        inputs: [FloatTensor<Self>; 1],
        spec: EncodingSpec,
        upstream: FloatTensor<Self>,
        wanted: [bool; 1],
    ) -> [Option<FloatTensor<Self>>; 1];

    /// Of [`Kernels::fused_composite`] in `sigma`, `deltas` and `values`.
    fn composite_gradient(
        inputs: [FloatTensor<Self>; 3],
        spec: (),
        upstream: FloatTensor<Self>,
        wanted: [bool; 3],
    ) -> [Option<FloatTensor<Self>>; 3];
}

/// Defines the backward node `$node` of `$inputs` parents whose gradients `Gradient::$gradient` yields.
macro_rules! backward_node {
    ($node:ident, $inputs:literal, $spec:ty, $gradient:ident) => {
        #[derive(Debug)]
        struct $node;

        impl<B: Gradient> Backward<B, $inputs> for $node {
            type State = ([FloatTensor<B>; $inputs], $spec);

            fn backward(self, ops: Ops<Self::State, $inputs>, gradients: &mut Gradients, _: &mut Checkpointer) {
                let upstream = gradients.consume::<B>(&ops.node);
                let wanted = ops.parents.each_ref().map(Option::is_some);
                let (inputs, spec) = ops.state;
                let results = B::$gradient(inputs, spec, upstream, wanted);
                for (parent, result) in ops.parents.into_iter().zip(results) {
                    if let (Some(parent), Some(result)) = (parent, result) {
                        gradients.register::<B>(parent.id, result);
                    }
                }
            }
        }
    };
}

backward_node!(MlpNode, 2, MlpSpec, mlp_gradient);
backward_node!(GroupedMlpNode, 3, MlpSpec, grouped_mlp_gradient);
backward_node!(EncodingNode, 1, EncodingSpec, encoding_gradient);
backward_node!(CompositeNode, 3, (), composite_gradient);

/// Runs `$forward` on the inner tensors and records `$node` if a gradient can reach an input.
macro_rules! record {
    ($node:ident, [$($input:ident),+], $spec:expr, $forward:expr) => {{
        let prepared = $node.prepare::<C>([$($input.node()),+]).compute_bound().stateful();
        let ($($input,)+) = ($($input.into_primitive(),)+);
        match prepared {
            OpsKind::Tracked(prepared) => {
                let state = ([$($input.clone()),+], $spec);
                prepared.finish(state, $forward)
            }
            OpsKind::UnTracked(prepared) => prepared.finish($forward),
        }
    }};
}

impl<B: Gradient, C: CheckpointStrategy> Kernels for Autodiff<B, C> {
    fn fused_mlp(x: FloatTensor<Self>, params: FloatTensor<Self>, spec: MlpSpec) -> FloatTensor<Self> {
        record!(MlpNode, [x, params], spec, B::fused_mlp(x, params, spec))
    }

    fn fused_grouped_mlp(
        shared: FloatTensor<Self>,
        own: FloatTensor<Self>,
        params: FloatTensor<Self>,
        spec: MlpSpec,
    ) -> FloatTensor<Self> {
        record!(GroupedMlpNode, [shared, own, params], spec, B::fused_grouped_mlp(shared, own, params, spec))
    }

    fn fused_encoding(x: FloatTensor<Self>, spec: EncodingSpec) -> FloatTensor<Self> {
        record!(EncodingNode, [x], spec.clone(), B::fused_encoding(x, spec))
    }

    fn fused_composite(
        sigma: FloatTensor<Self>,
        deltas: FloatTensor<Self>,
        values: FloatTensor<Self>,
    ) -> FloatTensor<Self> {
        record!(CompositeNode, [sigma, deltas, values], (), B::fused_composite(sigma, deltas, values))
    }
}

/// Calls `$function::<f32>` or `::<f64>` by the tensor's type.
macro_rules! by_dtype {
    ($tensor:expr, $function:ident($($argument:expr),* $(,)?)) => {
        match $tensor.dtype() {
            DType::F32 => $function::<f32>($($argument),*),
            DType::F64 => $function::<f64>($($argument),*),
            other => panic!("no fused kernel for elements of type {other:?}"),
        }
    };
}

impl Kernels for Flex {
    fn fused_mlp(x: FlexTensor, params: FlexTensor, spec: MlpSpec) -> FlexTensor {
        by_dtype!(x, mlp_on_flex([None, Some(x), Some(params)], spec))
    }

    fn fused_grouped_mlp(shared: FlexTensor, own: FlexTensor, params: FlexTensor, spec: MlpSpec) -> FlexTensor {
        by_dtype!(shared, mlp_on_flex([Some(shared), Some(own), Some(params)], spec))
    }

    fn fused_encoding(x: FlexTensor, spec: EncodingSpec) -> FlexTensor {
        by_dtype!(x, encoding_on_flex(x, &spec))
    }

    fn fused_composite(sigma: FlexTensor, deltas: FlexTensor, values: FlexTensor) -> FlexTensor {
        by_dtype!(sigma, composite_on_flex([sigma, deltas, values]))
    }
}

impl Gradient for Flex {
    fn mlp_gradient(
        [x, params]: [FlexTensor; 2],
        spec: MlpSpec,
        upstream: FlexTensor,
        [x_wanted, params_wanted]: [bool; 2],
    ) -> [Option<FlexTensor>; 2] {
        let wanted = Wanted { shared: false, own: x_wanted, params: params_wanted };
        let [_, x, params] =
            by_dtype!(upstream, mlp_gradient_on_flex([None, Some(x), Some(params)], spec, upstream, wanted));
        [x, params]
    }

    fn grouped_mlp_gradient(
        [shared, own, params]: [FlexTensor; 3],
        spec: MlpSpec,
        upstream: FlexTensor,
        [shared_wanted, own_wanted, params_wanted]: [bool; 3],
    ) -> [Option<FlexTensor>; 3] {
        let wanted = Wanted { shared: shared_wanted, own: own_wanted, params: params_wanted };
        by_dtype!(upstream, mlp_gradient_on_flex([Some(shared), Some(own), Some(params)], spec, upstream, wanted))
    }

    fn encoding_gradient(
        [x]: [FlexTensor; 1],
        spec: EncodingSpec,
        upstream: FlexTensor,
        [wanted]: [bool; 1],
    ) -> [Option<FlexTensor>; 1] {
        [wanted.then(|| by_dtype!(upstream, encoding_gradient_on_flex(x, &spec, upstream)))]
    }

    fn composite_gradient(
        inputs: [FlexTensor; 3],
        (): (),
        upstream: FlexTensor,
        wanted: [bool; 3],
    ) -> [Option<FlexTensor>; 3] {
        by_dtype!(upstream, composite_gradient_on_flex(inputs, upstream, wanted))
    }
}

/// Shape of a tensor of two dimensions.
fn matrix_shape(tensor: &FlexTensor) -> [usize; 2] {
    tensor.layout().shape().dims()
}

/// The network and the contiguous inputs of an operation; a single network has no shared input.
fn mlp_inputs(inputs: [Option<FlexTensor>; 3], spec: &MlpSpec) -> (Network, [Option<FlexTensor>; 3]) {
    let inputs = inputs.map(|input| input.map(contiguous));
    let columns = |input: &Option<FlexTensor>| input.as_ref().map_or([0, 0], matrix_shape);
    let ([_, shared], [rows, own]) = (columns(&inputs[0]), columns(&inputs[1]));
    let groups = match &inputs[2] {
        Some(params) if params.layout().num_dims() == 2 => matrix_shape(params)[0],
        _ => 1,
    };
    (Network::new(rows, shared, own / groups, groups, spec), inputs)
}

fn mlp_views<T: Scalar>(inputs: &[Option<FlexTensor>; 3]) -> Inputs<'_, T> {
    let [shared, own, params] = inputs.each_ref().map(|input| input.as_ref().map_or_else(Default::default, T::view));
    Inputs { shared, own, params }
}

fn mlp_on_flex<T: Scalar>(inputs: [Option<FlexTensor>; 3], spec: MlpSpec) -> FlexTensor {
    let (network, inputs) = mlp_inputs(inputs, &spec);
    let result = mlp::forward(&network, mlp_views::<T>(&inputs));
    T::tensor(result, Shape::new([network.rows, network.groups * network.output_size]))
}

fn mlp_gradient_on_flex<T: Scalar>(
    inputs: [Option<FlexTensor>; 3],
    spec: MlpSpec,
    upstream: FlexTensor,
    wanted: Wanted,
) -> [Option<FlexTensor>; 3] {
    let (network, inputs) = mlp_inputs(inputs, &spec);
    let upstream = contiguous(upstream);
    let gradients = mlp::backward(&network, mlp_views::<T>(&inputs), T::view(&upstream), wanted);
    let tensor = |wanted: bool, values: Vec<T>, input: &Option<FlexTensor>| {
        let shape = input.as_ref().map(|input| input.layout().shape().clone());
        shape.filter(|_| wanted).map(|shape| T::tensor(values, shape))
    };
    [
        tensor(wanted.shared, gradients.shared, &inputs[0]),
        tensor(wanted.own, gradients.own, &inputs[1]),
        tensor(wanted.params, gradients.params, &inputs[2]),
    ]
}

fn encoding_on_flex<T: Scalar>(x: FlexTensor, spec: &EncodingSpec) -> FlexTensor {
    let [rows, channels] = matrix_shape(&x);
    let x = contiguous(x);
    T::tensor(encoding::forward(T::view(&x), channels, spec), Shape::new([rows, spec.columns(channels)]))
}

fn encoding_gradient_on_flex<T: Scalar>(x: FlexTensor, spec: &EncodingSpec, upstream: FlexTensor) -> FlexTensor {
    let [rows, channels] = matrix_shape(&x);
    let (x, upstream) = (contiguous(x), contiguous(upstream));
    let gradient = encoding::backward(T::view(&x), channels, spec, T::view(&upstream));
    T::tensor(gradient, Shape::new([rows, channels]))
}

fn composite_on_flex<T: Scalar>(inputs: [FlexTensor; 3]) -> FlexTensor {
    let [rays, samples, channels] = inputs[2].layout().shape().dims();
    let [sigma, deltas, values] = inputs.map(contiguous);
    let rays_in =
        Rays { samples, channels, sigma: T::view(&sigma), deltas: T::view(&deltas), values: T::view(&values) };
    T::tensor(composite::forward(rays_in), Shape::new([rays, channels + samples]))
}

fn composite_gradient_on_flex<T: Scalar>(
    inputs: [FlexTensor; 3],
    upstream: FlexTensor,
    wanted: [bool; 3],
) -> [Option<FlexTensor>; 3] {
    let [rays, samples, channels] = inputs[2].layout().shape().dims();
    let [sigma, deltas, values] = inputs.map(contiguous);
    let upstream = contiguous(upstream);
    let rays_in =
        Rays { samples, channels, sigma: T::view(&sigma), deltas: T::view(&deltas), values: T::view(&values) };
    let [sigma, deltas, values] = composite::backward(rays_in, T::view(&upstream));
    let matrix = Shape::new([rays, samples]);
    [
        wanted[0].then(|| T::tensor(sigma, matrix.clone())),
        wanted[1].then(|| T::tensor(deltas, matrix)),
        wanted[2].then(|| T::tensor(values, Shape::new([rays, samples, channels]))),
    ]
}
