//! T: the SE(3) deformation field, `x' = T(x, ω)` (eq. 8; fact sheet §1.5).

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use rand::Rng;

use crate::config::ModelConfig;
use crate::encoding;
use crate::mlp::{Init, Mlp, spec};
use crate::se3;

/// The deformation field.
#[derive(Module, Debug)]
pub struct DeformationField {
    /// `[γ(x), ω]` to the screw `(w, v)`.
    net: Mlp,
}

impl DeformationField {
    /// A fresh field that moves nothing by more than about 1e-3.
    pub fn new(config: &ModelConfig, rng: &mut impl Rng, device: &Device) -> Self {
        let d_in = encoding::width(3, config.warp_bands, true) + config.latent_dims;
        Self { net: Mlp::new(d_in, spec(config.warp, Some(6), config.products), Init::Uniform(1e-4), rng, device) }
    }

    /// The warped points.
    ///
    /// # Shapes
    /// `x`: `[r · s, 3]`, ray after ray; `omega`: `[r, latent]`, `window`: `warp_bands` weights, result: `[r · s, 3]`
    pub fn forward(&self, x: Tensor<2>, omega: &Tensor<2>, window: &[f32]) -> Tensor<2> {
        let screw = self.net.forward_with_ray(encoding::encode(x.clone(), window, true), omega);
        se3::transform(&screw.clone().narrow(1, 0, 3), &screw.narrow(1, 3, 3), x)
    }
}
