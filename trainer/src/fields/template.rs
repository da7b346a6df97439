//! F: the template NeRF, `(σ, c) = F(x', W, d)` (eq. 4; fact sheet §1.10).

use burn::module::Module;
use burn::tensor::activation::{sigmoid, softplus};
use burn::tensor::{Device, Tensor};
use rand::Rng;

use crate::config::{ModelConfig, NetSize};
use crate::encoding;
use crate::kernel::MlpSpec;
use crate::mlp::{Init, Mlp, spec};

/// What the template says of each sample.
#[derive(Clone, Debug)]
pub struct TemplateOutput {
    /// σ ≥ 0, per unit of length: `[n]`.
    pub density: Tensor<1>,
    /// RGB, 0–1: `[n, 3]`.
    pub color: Tensor<2>,
}

/// The template of one level.
#[derive(Module, Debug)]
pub struct Template {
    /// To the raw density (first column) and the bottleneck (the others), both linear.
    trunk: Mlp,
    /// `[bottleneck, view]` to colour.
    color: Mlp,
}

impl Template {
    /// A fresh template for `hyper` encoded ambient coordinates.
    pub fn new(config: &ModelConfig, size: NetSize, hyper: usize, rng: &mut impl Rng, device: &Device) -> Self {
        let d_in = encoding::width(3, config.template_bands, true) + hyper;
        let trunk = Mlp::new(d_in, spec(size, Some(1 + size.width), config.products), Init::GlorotHeads, rng, device);
        let d_in = size.width + encoding::width(3, config.view_bands, true);
        let (width, products) = (config.color_width, config.products);
        let color = MlpSpec { depth: 1, width, skip: None, output: Some(3), products };
        Self { trunk, color: Mlp::new(d_in, color, Init::Glorot, rng, device) }
    }

    /// Density and colour.
    ///
    /// # Shapes
    /// `input` `[γ(x'), γ(W)]`: `[r · s, d_in]`, ray after ray; `view` γ(d): `[r, v]`
    pub fn forward(&self, input: Tensor<2>, view: &Tensor<2>) -> TemplateOutput {
        let out = self.trunk.forward(input);
        let bottleneck = out.clone().narrow(1, 1, self.trunk.d_out() - 1);
        let raw = out.narrow(1, 0, 1).squeeze_dim::<1>(1);
        TemplateOutput { density: softplus(raw, 1.0), color: sigmoid(self.color.forward_with_ray(bottleneck, view)) }
    }

    /// Where it lives.
    pub fn device(&self) -> Device {
        self.trunk.device()
    }
}
