//! The operation as a node of Burn. Nothing but the inputs is kept between the ways: rays are sent again on the way back.

use std::sync::Arc;

use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, backend_extension};
use burn::tensor::Shape;
use burn_flex::{Flex, FlexTensor};
use risorius_brick::batch::{self, RayBatch, RayValues};
use risorius_brick::expression::MASKS;

use super::{COLUMNS, RayScene};
use crate::kernel::scalar::{Scalar as _, contiguous};

/// What a call is about besides its tensors.
#[derive(Clone, Debug)]
pub(crate) struct Call {
    pub(super) scene: Arc<RayScene>,
    pub(super) batch: Arc<RayBatch>,
}

/// The operation. Lengths are checked by [`super::render_rays`].
#[backend_extension(Autodiff, Flex)]
pub(super) trait RayKernels: Backend {
    /// `[rays, COLUMNS]`
    fn fused_rays(
        parameters: FloatTensor<Self>,
        activations: FloatTensor<Self>,
        motion: FloatTensor<Self>,
        call: Call,
    ) -> FloatTensor<Self>;
}

/// Its gradient in the three tensors, on backends without autodiff.
pub(super) trait RayGradient: RayKernels {
    fn rays_gradient(inputs: [FloatTensor<Self>; 3], call: Call, upstream: FloatTensor<Self>)
    -> [FloatTensor<Self>; 3];
}

#[derive(Debug)]
struct RaysNode;

impl<B: RayGradient> Backward<B, 3> for RaysNode {
    type State = ([FloatTensor<B>; 3], Call);

    fn backward(self, ops: Ops<Self::State, 3>, gradients: &mut Gradients, _: &mut Checkpointer) {
        let upstream = gradients.consume::<B>(&ops.node);
        let (inputs, call) = ops.state;
        let results = B::rays_gradient(inputs, call, upstream);
        for (parent, result) in ops.parents.into_iter().zip(results) {
            if let Some(parent) = parent {
                gradients.register::<B>(parent.id, result);
            }
        }
    }
}

impl<B: RayGradient, C: CheckpointStrategy> RayKernels for Autodiff<B, C> {
    fn fused_rays(
        parameters: FloatTensor<Self>,
        activations: FloatTensor<Self>,
        motion: FloatTensor<Self>,
        call: Call,
    ) -> FloatTensor<Self> {
        let nodes = [parameters.node(), activations.node(), motion.node()];
        let prepared = RaysNode.prepare::<C>(nodes).compute_bound().stateful();
        let inputs = [parameters.into_primitive(), activations.into_primitive(), motion.into_primitive()];
        let [p, a, m] = inputs.clone();
        let result = B::fused_rays(p, a, m, call.clone());
        match prepared {
            OpsKind::Tracked(prepared) => prepared.finish((inputs, call), result),
            OpsKind::UnTracked(prepared) => prepared.finish(result),
        }
    }
}

fn vector(values: Vec<f32>) -> FlexTensor {
    let shape = Shape::new([values.len()]);
    f32::tensor(values, shape)
}

/// A motion's six numbers.
fn six(values: &[f32]) -> [f32; 6] {
    std::array::from_fn(|i| values[i])
}

impl RayKernels for Flex {
    fn fused_rays(parameters: FlexTensor, activations: FlexTensor, motion: FlexTensor, call: Call) -> FlexTensor {
        let [parameters, activations, motion] = [parameters, activations, motion].map(contiguous);
        let motion = six(f32::view(&motion));
        let values = call
            .scene
            .with(f32::view(&parameters), |model| batch::forward(model, f32::view(&activations), &motion, &call.batch));
        let mut columns = Vec::with_capacity(values.len() * COLUMNS);
        for v in &values {
            columns.extend_from_slice(&v.color);
            columns.push(v.left);
            columns.extend_from_slice(&v.masks);
            columns.extend_from_slice(&v.depth);
            columns.push(v.regular);
        }
        f32::tensor(columns, Shape::new([values.len(), COLUMNS]))
    }
}

impl RayGradient for Flex {
    fn rays_gradient(inputs: [FlexTensor; 3], call: Call, upstream: FlexTensor) -> [FlexTensor; 3] {
        let [parameters, activations, motion] = inputs.map(contiguous);
        let upstream = contiguous(upstream);
        let upstream: Vec<RayValues> = f32::view(&upstream)
            .as_chunks::<COLUMNS>()
            .0
            .iter()
            .map(|row| {
                let (color, rest) = row.split_at(3);
                let (left, rest) = rest.split_at(1);
                let (masks, rest) = rest.split_at(MASKS);
                RayValues {
                    color: std::array::from_fn(|c| color[c]),
                    left: left[0],
                    masks: std::array::from_fn(|n| masks[n]),
                    depth: [rest[0], rest[1]],
                    regular: rest[2],
                }
            })
            .collect();
        let motion = six(f32::view(&motion));
        let grad = call.scene.with(f32::view(&parameters), |model| {
            batch::backward(model, f32::view(&activations), &motion, &call.batch, &upstream)
        });
        [vector(grad.tables.concat()), vector(grad.activations), vector(grad.motion.to_vec())]
    }
}
