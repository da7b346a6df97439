//! H: the ambient slices, `w_i = H_i(x, α_i)` and `w_0 = H_0(x, ω)` (eq. 7, 8; fact sheet §1.6).

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use rand::Rng;

use crate::config::{ModelConfig, SliceKind};
use crate::encoding;
use crate::kernel::per_sample;
use crate::mlp::{GroupedMlp, Init, Mlp, spec};

/// Ambient coordinates of every sample.
#[derive(Clone, Debug)]
pub struct Slices {
    /// `[w_1 … w_K]`: `[n, K · dims]`; `None` where there are no slices of attributes.
    pub attributes: Option<Tensor<2>>,
    /// w_0: `[n, dims]`; `None` where there are no ambient coordinates.
    pub rest: Option<Tensor<2>>,
}

/// One slicing surface per attribute and one for the rest, as far as the model has them.
#[derive(Module, Debug)]
pub struct AmbientSlices {
    per_attribute: Option<GroupedMlp>,
    rest: Option<Mlp>,
    #[module(skip)]
    bands: usize,
    #[module(skip)]
    is_code: bool,
}

impl AmbientSlices {
    /// Fresh surfaces for `attributes` attributes, almost flat.
    pub fn new(config: &ModelConfig, attributes: usize, rng: &mut impl Rng, device: &Device) -> Self {
        let position = encoding::width(3, config.sheet_bands, false);
        let out = Some(config.hyper_dims);
        let init = Init::Normal(1e-5);
        let kind = config.kind.slices();
        let per_attribute = (kind == SliceKind::PerAttribute).then(|| {
            GroupedMlp::new(attributes, position + 1, spec(config.sheet, out, config.products), init, rng, device)
        });
        let rest = matches!(kind, SliceKind::PerAttribute | SliceKind::Rest).then(|| {
            Mlp::new(position + config.latent_dims, spec(config.sheet, out, config.products), init, rng, device)
        });
        Self { per_attribute, rest, bands: config.sheet_bands, is_code: kind == SliceKind::Code }
    }

    /// The ambient coordinates at the un-warped points.
    ///
    /// # Shapes
    /// `x`: `[r · s, 3]`, ray after ray; `alpha`: `[r, K]`, `omega`: `[r, latent]`
    pub fn forward(&self, x: Tensor<2>, alpha: &Tensor<2>, omega: &Tensor<2>) -> Slices {
        let samples = x.dims()[0] / omega.dims()[0];
        if self.is_code {
            return Slices { attributes: None, rest: Some(per_sample(omega, samples)) };
        }
        let Some(rest) = &self.rest else { return Slices { attributes: None, rest: None } };
        let position = encoding::encode(x, &encoding::open_window(self.bands), false);
        Slices {
            rest: Some(rest.forward_with_ray(position.clone(), omega)),
            attributes: self.per_attribute.as_ref().map(|nets| nets.forward(position, per_sample(alpha, samples))),
        }
    }
}
