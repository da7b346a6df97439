//! Linear AU models: support vector regressors for intensities, support vector machines for presences.
//!
//! A file, little-endian: i32 kind (0 and 1: static and dynamic regressor; 4 and 5: static and dynamic machine); kind 1 only:
//! f64 cut-off; matrix mean (1 × n), matrix w (n × AUs), f64 bias; machines only: f64 value where y > 0, f64 value elsewhere.
//! y = (x − mean)·w + bias; of dynamic ones the person's median of x is subtracted too.

use std::path::{Path, PathBuf};

use risorius_formats::ActionUnit;

use super::HOG_NUMBERS;
use super::matrix::{self, Binary, damaged};
use crate::error::Result;

/// What y means.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Purpose {
    /// An intensity; of dynamic ones the value at this quantile of the clip is rest.
    Intensity {
        /// 0–1; `None` where nothing is subtracted.
        cutoff: Option<f64>,
    },
    /// A presence.
    Presence {
        /// Value where y > 0.
        positive: f64,
        /// Value elsewhere.
        negative: f64,
    },
}

/// One linear function.
#[derive(Clone, Debug, PartialEq)]
pub struct Predictor {
    /// The AU.
    pub unit: ActionUnit,
    /// What its value means.
    pub purpose: Purpose,
    /// Whether the person's median is subtracted from x.
    pub is_dynamic: bool,
    /// Weights of the first numbers of x: all, or those of the skin.
    pub weights: Vec<f64>,
    /// bias − mean·w.
    pub constant: f64,
}

impl Predictor {
    /// x·w.
    pub fn product(&self, x: &[f32]) -> f64 {
        const LANES: usize = 8;
        let (w, x) = (self.weights.chunks_exact(LANES), x[..self.weights.len().min(x.len())].chunks_exact(LANES));
        let rest: f64 = w.remainder().iter().zip(x.remainder()).map(|(w, x)| w * f64::from(*x)).sum();
        let mut sums = [0.0f64; LANES];
        for (w, x) in w.zip(x) {
            for i in 0..LANES {
                sums[i] += w[i] * f64::from(x[i]);
            }
        }
        sums.iter().sum::<f64>() + rest
    }
}

/// All predictors of an install.
#[derive(Clone, Debug, Default)]
pub struct Predictors(pub Vec<Predictor>);

impl Predictors {
    /// Reads the files; x has `numbers` numbers.
    pub fn read(files: &[(PathBuf, Vec<ActionUnit>)], numbers: usize) -> Result<Self> {
        let mut all = Vec::new();
        for (path, units) in files {
            all.extend(read(path, units, numbers)?);
        }
        Ok(Self(all))
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// x·w of each.
    pub fn products(&self, x: &[f32]) -> Vec<f32> {
        self.0.iter().map(|p| p.product(x) as f32).collect()
    }
}

fn read(path: &Path, units: &[ActionUnit], numbers: usize) -> Result<Vec<Predictor>> {
    let bytes = matrix::read(path)?;
    let mut file = Binary::new(path, &bytes);
    let kind = file.i32()?;
    let (is_dynamic, is_machine) = match kind {
        0 => (false, false),
        1 => (true, false),
        4 => (false, true),
        5 => (true, true),
        _ => return Err(damaged(path, format!("is of the kind {kind}; linear models are 0, 1, 4 and 5")).into()),
    };
    let cutoff = if kind == 1 { Some(file.f64()?) } else { None };
    if let Some(cutoff) = cutoff.filter(|c| *c != -1.0 && !(0.0..=1.0).contains(c)) {
        return Err(damaged(path, format!("has the cut-off {cutoff}, which is no share")).into());
    }
    let mean = file.matrix()?;
    let weights = file.matrix()?;
    let bias = file.f64()?;
    let purpose = if is_machine {
        Purpose::Presence { positive: file.f64()?, negative: file.f64()? }
    } else {
        Purpose::Intensity { cutoff: cutoff.filter(|c| *c >= 0.0) }
    };
    let count = weights.rows;
    if mean.values.len() != count || weights.columns != units.len() || ![numbers, HOG_NUMBERS].contains(&count) {
        let what = format!(
            "has a mean of {} and weights of {} × {} numbers; {} AU of {numbers} or {HOG_NUMBERS} numbers should be in it",
            mean.values.len(),
            count,
            weights.columns,
            units.len()
        );
        return Err(damaged(path, what).into());
    }
    let one = |(k, unit): (usize, &ActionUnit)| {
        let weights: Vec<f64> = weights.values.iter().skip(k).step_by(units.len()).copied().collect();
        let constant = bias - mean.values.iter().zip(&weights).map(|(m, w)| m * w).sum::<f64>();
        Predictor { unit: *unit, purpose, is_dynamic, weights, constant }
    };
    Ok(units.iter().enumerate().map(one).collect())
}
