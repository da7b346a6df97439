//! M: the masks, `m_n = sigmoid(M_n(x', w_n1 … w_np, w_0))` (eq. 9; fact sheet §1.7).
//!
//! Net n sees the ambient coordinates of its own group only: changing an AU of another region cannot change its logits,
//! not even by a bit. CoNeRF's one net sees all of them and gives a mask per attribute.

use std::ops::Range;

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use rand::Rng;

use crate::config::{BranchedSize, MaskKind, ModelConfig};
use crate::encoding;
use crate::mlp::BranchedNets;

/// The mask nets of one level.
#[derive(Module, Debug)]
pub struct MaskNets {
    nets: Vec<BranchedNets>,
    /// Attributes that each net sees.
    #[module(skip)]
    groups: Vec<Range<usize>>,
    /// Columns of one encoded ambient component.
    #[module(skip)]
    component: usize,
}

impl MaskNets {
    /// Fresh nets for these groups of attributes.
    pub fn new(
        config: &ModelConfig,
        size: BranchedSize,
        groups: &[Range<usize>],
        rng: &mut impl Rng,
        device: &Device,
    ) -> Self {
        let component = encoding::width(config.hyper_dims, config.hyper_bands, false);
        let position = encoding::width(3, config.template_bands, true);
        let all = groups.last().map_or(0, |g| g.end);
        let (groups, outputs) = match config.kind.masks() {
            MaskKind::PerRegion => (groups.to_vec(), 1),
            MaskKind::Joint => (std::iter::once(0..all).collect(), all),
            MaskKind::None => (Vec::new(), 0),
        };
        let nets = groups
            .iter()
            .map(|g| {
                let size = (size, config.products);
                BranchedNets::new(1, position + component * (g.len() + 1), size, outputs, rng, device)
            })
            .collect();
        Self { nets, groups, component }
    }

    /// The mask logits; `None` where there are no masks.
    ///
    /// # Shapes
    /// `position` γ(x'): `[n, p]`, `ambient` γ(w_1 … w_K): `[n, K · component]`, `rest` γ(w_0): `[n, component]`;
    /// result: `[n, masks]`
    pub fn forward(&self, position: &Tensor<2>, ambient: &Tensor<2>, rest: &Tensor<2>) -> Option<Tensor<2>> {
        let logits = self.nets.iter().zip(&self.groups).map(|(net, group)| {
            let mut own = Vec::new();
            if !group.is_empty() {
                own.push(ambient.clone().narrow(1, group.start * self.component, group.len() * self.component));
            }
            own.push(rest.clone());
            net.forward(position.clone(), Tensor::cat(own, 1))
        });
        let logits: Vec<_> = logits.collect();
        (!logits.is_empty()).then(|| Tensor::cat(logits, 1))
    }
}
