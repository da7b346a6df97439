//! Norms of gradients, part by part of the model.

use std::collections::BTreeMap;

use burn::module::{Module as _, ModuleVisitor, Param};
use burn::optim::GradientsParams;
use burn::tensor::Tensor;

use super::step::host;
use crate::error::{Result, TrainerError};
use crate::model::ConfiesModel;

/// ‖∇‖₂ of each part of the model that has a gradient: `latent`, `deformation`, `fine.template` …
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GradientNorms {
    /// By part.
    pub parts: BTreeMap<String, f64>,
}

impl GradientNorms {
    /// The norms of `gradients`.
    pub fn of(model: &ConfiesModel, gradients: &GradientsParams) -> Self {
        let mut squares = Squares { gradients, path: Vec::new(), names: Vec::new(), sums: Vec::new() };
        model.visit(&mut squares);
        if squares.sums.is_empty() {
            return Self::default();
        }
        let mut parts = BTreeMap::new();
        for (name, sum) in squares.names.into_iter().zip(host(Tensor::cat(squares.sums, 0))) {
            *parts.entry(name).or_insert(0.0) += f64::from(sum);
        }
        for norm in parts.values_mut() {
            *norm = f64::sqrt(*norm);
        }
        Self { parts }
    }

    /// The norm of the whole gradient.
    pub fn total(&self) -> f64 {
        self.parts.values().map(|v| v * v).sum::<f64>().sqrt()
    }

    /// Fails where a norm is not a finite number, naming the part.
    pub fn check_finite(&self, step: u64) -> Result<()> {
        match self.parts.iter().find(|(_, v)| !v.is_finite()) {
            Some((part, _)) => Err(TrainerError::NotFinite { step, what: format!("the gradient of `{part}`") }),
            None => Ok(()),
        }
    }
}

struct Squares<'a> {
    gradients: &'a GradientsParams,
    path: Vec<String>,
    names: Vec<String>,
    sums: Vec<Tensor<1>>,
}

impl ModuleVisitor for Squares<'_> {
    fn enter_module(&mut self, name: &str, _: &str) {
        self.path.push(name.to_owned());
    }

    fn exit_module(&mut self, _: &str, _: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let Some(gradient) = self.gradients.get::<D>(param.id) else { return };
        let parts = match self.path.first().map(String::as_str) {
            Some("coarse" | "fine") => 2,
            _ => 1,
        };
        self.names.push(self.path[..parts.min(self.path.len())].join("."));
        self.sums.push(gradient.powi_scalar(2).sum());
    }
}
