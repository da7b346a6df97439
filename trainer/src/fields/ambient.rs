//! H: the ambient slices, `w_i = H_i(x, α_i)` and `w_0 = H_0(x, ω)` (eq. 7, 8; fact sheet §1.6).

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use rand::Rng;

use crate::config::ModelConfig;
use crate::encoding;
use crate::mlp::{GroupedMlp, Init, Mlp, spec};

/// One slicing surface per attribute and one for the rest.
#[derive(Module, Debug)]
pub struct AmbientSlices {
    per_attribute: GroupedMlp,
    rest: Mlp,
    #[module(skip)]
    bands: usize,
}

impl AmbientSlices {
    /// Fresh surfaces for `attributes` attributes, almost flat.
    pub fn new(config: &ModelConfig, attributes: usize, rng: &mut impl Rng, device: &Device) -> Self {
        let position = encoding::width(3, config.sheet_bands, false);
        let out = Some(config.hyper_dims);
        let init = Init::Normal(1e-5);
        Self {
            per_attribute: GroupedMlp::new(attributes, position + 1, spec(config.sheet, out), init, rng, device),
            rest: Mlp::new(position + config.latent_dims, spec(config.sheet, out), init, rng, device),
            bands: config.sheet_bands,
        }
    }

    /// `([w_1 … w_K], w_0)` at the un-warped points.
    ///
    /// # Shapes
    /// `x`: `[n, 3]`, `alpha`: `[n, K]`, `omega`: `[n, latent]`; results: `[n, K · dims]`, `[n, dims]`
    pub fn forward(&self, x: Tensor<2>, alpha: Tensor<2>, omega: Tensor<2>) -> (Tensor<2>, Tensor<2>) {
        let position = encoding::encode(x, &encoding::open_window(self.bands), false);
        let rest = self.rest.forward(Tensor::cat(vec![position.clone(), omega], 1));
        (self.per_attribute.forward(position, alpha), rest)
    }
}
