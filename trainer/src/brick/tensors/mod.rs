//! The brick field in Burn: its numbers as a module with records, and "render these rays" as one differentiable operation.
//!
//! A fit by `trainer fit` does not come by here: it updates what rays touched in place, and whole tensors of gradients would
//! cost it more than all it does (decision 6). This is for what has a loss of its own: a perceptual loss, fitting an
//! expression or a camera to a picture, learning on with Burn's optimisers.
//!
//! ```text
//! BrickParameters ─▶ flat ─┐
//! activations, code ───────┼─▶ render_rays ─▶ colour, transmittance, masks, depth, regulariser ─▶ a loss
//! turn and shift ──────────┘
//! ```
//!
//! [`render_rays`] runs the kernels of `risorius-brick` for f32 tensors on the CPU, and its plain twin, [`twin::render`],
//! for all others; tests hold the two against each other, value and gradient.

mod op;
mod parameters;
pub mod twin;

#[cfg(test)]
mod tests;

use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};

use burn::backend::Dispatch;
use burn::tensor::{DType, Tensor};
use risorius_brick::Brick;
use risorius_brick::batch::RayBatch;
use risorius_brick::expression::MASKS;
use risorius_brick::model::LATENT;

use crate::kernel::is_on_flex;

pub use self::parameters::{BlockSteps, BrickMoments, BrickParameters, FieldParameters, FieldSteps};

/// Numbers per ray that the operation gives: colour, transmittance, masks, depth, regulariser.
pub(crate) const COLUMNS: usize = 3 + 1 + MASKS + 2 + 1;

/// Where an avatar's numbers belong: bricks, occupied parts, regions. The numbers themselves come with each call.
pub struct RayScene {
    /// Holds whatever numbers the last call brought.
    model: Mutex<Brick>,
    shown_by: usize,
    activations: usize,
}

impl fmt::Debug for RayScene {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("RayScene").field("shown_by", &self.shown_by).finish_non_exhaustive()
    }
}

impl RayScene {
    /// The scene of a model.
    pub fn new(mut model: Brick) -> Arc<Self> {
        for table in model.shown_by_mut() {
            // Moments and counts are the optimiser's; a residual acts from its first update on, and here by its numbers.
            (table.first, table.second) = (Vec::new(), Vec::new());
            table.steps.fill(1);
        }
        let shown_by = model.shown_by().iter().map(|t| t.values.len()).sum();
        let activations = model.layout.region_of.len() + LATENT;
        Arc::new(Self { model: Mutex::new(model), shown_by, activations })
    }

    /// Numbers that rays depend on: the length of [`BrickParameters::flat`].
    pub fn shown_by(&self) -> usize {
        self.shown_by
    }

    /// Runs `f` on the model with the numbers of `flat`.
    pub(crate) fn with<T>(&self, flat: &[f32], f: impl FnOnce(&Brick) -> T) -> T {
        let mut model = self.model.lock().unwrap_or_else(PoisonError::into_inner);
        let mut rest = flat;
        for table in model.shown_by_mut() {
            let (own, others) = rest.split_at(table.values.len());
            table.values.copy_from_slice(own);
            rest = others;
        }
        f(&model)
    }

    /// Runs `f` on the model with whatever numbers it holds.
    fn shape<T>(&self, f: impl FnOnce(&Brick) -> T) -> T {
        f(&self.model.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

/// What rays show.
#[derive(Clone, Debug)]
pub struct Rendered {
    /// `[rays, 3]`, 0–1: without what lies behind everything.
    pub color: Tensor<2>,
    /// `[rays, 1]`: how much of what lies behind everything shows.
    pub left: Tensor<2>,
    /// `[rays, 4]`, 0–1: masks of the regions, then of the bricks. They have no gradient in the density (stop-gradient).
    pub masks: Tensor<2>,
    /// `[rays, 2]`: Σ weight · distance (world units) and Σ weight, of the head.
    pub depth: Tensor<2>,
    /// `[rays, 1]`: what the batch's haze and spread hold against the ray.
    pub regular: Tensor<2>,
}

/// Renders the rays of one image, differentiably in all three tensors.
///
/// `parameters` are [`BrickParameters::flat`], `activations` `[K + 8]` those of the AUs (0 at an AU's least, 1 at its most) and
/// the latent code, `motion` `[6]` a small turn (rotation vector) and shift of the camera in the head's box, box units. Its
/// gradient is that of a further turn and shift after this one, with each sample's distance along its ray and what the
/// expression does to it kept.
///
/// # Panics
/// If the tensors' lengths are not the scene's, or they lie on several devices.
pub fn render_rays(
    scene: &Arc<RayScene>,
    parameters: Tensor<1>,
    activations: Tensor<1>,
    motion: Tensor<1>,
    batch: &Arc<RayBatch>,
) -> Rendered {
    assert_eq!(parameters.dims(), [scene.shown_by], "numbers of the scene");
    assert_eq!(activations.dims(), [scene.activations], "activations and the code");
    assert_eq!(motion.dims(), [6], "a turn and a shift");
    let columns = if is_on_flex(&parameters) && parameters.dtype() == DType::F32 {
        let call = op::Call { scene: Arc::clone(scene), batch: Arc::clone(batch) };
        Tensor::<2>::from_dispatch(<Dispatch as op::RayKernels>::fused_rays(
            parameters.into_dispatch(),
            activations.into_dispatch(),
            motion.into_dispatch(),
            call,
        ))
    } else {
        twin::render(scene, &parameters, &activations, &motion, batch)
    };
    split(&columns)
}

/// `[rays, COLUMNS]` as what it is.
fn split(columns: &Tensor<2>) -> Rendered {
    let mut at = 0;
    let mut next = |width: usize| {
        at += width;
        columns.clone().narrow(1, at - width, width)
    };
    Rendered { color: next(3), left: next(1), masks: next(MASKS), depth: next(2), regular: next(1) }
}
