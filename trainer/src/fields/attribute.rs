//! A: latent code to attributes, `α = tanh(A(ω))` (eq. 5; fact sheet §1.4).

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use rand::Rng;

use crate::config::ModelConfig;
use crate::mlp::{Init, Mlp, spec};

/// The attribute network.
#[derive(Module, Debug)]
pub struct AttributeNet {
    net: Mlp,
    #[module(skip)]
    has_tanh: bool,
}

impl AttributeNet {
    /// A fresh network for `attributes` outputs.
    pub fn new(config: &ModelConfig, attributes: usize, rng: &mut impl Rng, device: &Device) -> Self {
        let net = Mlp::new(
            config.latent_dims,
            spec(config.attribute, Some(attributes), config.products),
            Init::Glorot,
            rng,
            device,
        );
        Self { net, has_tanh: config.kind.has_tanh() }
    }

    /// α, in −1..1 where the model has a tanh.
    ///
    /// # Shapes
    /// `omega`: `[r, latent]`, result: `[r, K]`
    pub fn forward(&self, omega: Tensor<2>) -> Tensor<2> {
        let raw = self.net.forward(omega);
        if self.has_tanh { raw.tanh() } else { raw }
    }
}
