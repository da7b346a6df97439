//! B: the uncertainty of each attribute, `β_i = softplus(B_i(x', w_0, w_i)) + 0.03` (eq. 12; fact sheet §1.9).

use burn::module::Module;
use burn::tensor::activation::softplus;
use burn::tensor::{Device, Tensor};
use rand::Rng;

use crate::config::ModelConfig;
use crate::encoding;
use crate::mlp::BranchedNets;

/// The smallest β.
pub const BETA_FLOOR: f64 = 0.03;

/// One uncertainty net per attribute.
#[derive(Module, Debug)]
pub struct UncertaintyNets {
    nets: BranchedNets,
}

impl UncertaintyNets {
    /// Fresh nets for `attributes` attributes.
    pub fn new(config: &ModelConfig, attributes: usize, rng: &mut impl Rng, device: &Device) -> Self {
        let component = encoding::width(config.hyper_dims, config.hyper_bands, false);
        let d_in = encoding::width(3, config.template_bands, true) + 2 * component;
        Self { nets: BranchedNets::new(attributes, d_in, (config.uncertainty, config.products), 1, rng, device) }
    }

    /// β ≥ 0.03.
    ///
    /// # Shapes
    /// As [`MaskNets::forward`](super::MaskNets::forward); result: `[n, K]`
    pub fn forward(&self, position: Tensor<2>, ambient: Tensor<2>, rest: Tensor<2>) -> Tensor<2> {
        softplus(self.nets.forward(Tensor::cat(vec![position, rest], 1), ambient), 1.0) + BETA_FLOOR
    }
}
