//! M: the region masks, `m_n = sigmoid(M_n(x', w_n1 … w_np, w_0))` (eq. 9; fact sheet §1.7).
//!
//! Net n sees the ambient coordinates of its own group only: changing an AU of another region cannot change its logits,
//! not even by a bit.

use std::ops::Range;

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use rand::Rng;

use crate::config::ModelConfig;
use crate::encoding;
use crate::mlp::BranchedNets;

/// One mask net per region.
#[derive(Module, Debug)]
pub struct MaskNets {
    nets: Vec<BranchedNets>,
    /// Attributes of each region.
    #[module(skip)]
    groups: Vec<Range<usize>>,
    /// Columns of one encoded ambient component.
    #[module(skip)]
    component: usize,
}

impl MaskNets {
    /// Fresh nets for these groups of attributes.
    pub fn new(config: &ModelConfig, groups: &[Range<usize>], rng: &mut impl Rng, device: &Device) -> Self {
        let component = encoding::width(config.hyper_dims, config.hyper_bands, false);
        let position = encoding::width(3, config.template_bands, true);
        let nets = groups
            .iter()
            .map(|g| BranchedNets::new(1, position + component * (g.len() + 1), config.mask, rng, device))
            .collect();
        Self { nets, groups: groups.to_vec(), component }
    }

    /// The mask logits.
    ///
    /// # Shapes
    /// `position` γ(x'): `[n, p]`, `ambient` γ(w_1 … w_K): `[n, K · component]`, `rest` γ(w_0): `[n, component]`;
    /// result: `[n, N]`
    pub fn forward(&self, position: &Tensor<2>, ambient: &Tensor<2>, rest: &Tensor<2>) -> Tensor<2> {
        let logits = self.nets.iter().zip(&self.groups).map(|(net, group)| {
            let mut own = Vec::new();
            if !group.is_empty() {
                own.push(ambient.clone().narrow(1, group.start * self.component, group.len() * self.component));
            }
            own.push(rest.clone());
            net.forward(position.clone(), Tensor::cat(own, 1))
        });
        Tensor::cat(logits.collect(), 1)
    }
}
