//! A driver's intensities become an avatar's expressions, with an account of what did not fit.

use std::collections::BTreeSet;

use risorius_formats::curves::interpolate;
use risorius_formats::{ActionUnit, AttributeSpec, Intensity};
use serde::Serialize;

use super::{Driver, Range};
use crate::avatar::Avatar;
use crate::expression::{Expression, TOLERANCE};

/// How one AU was carried over.
#[derive(Clone, Debug, Serialize)]
pub struct DrivenUnit {
    /// The AU.
    pub unit: ActionUnit,
    /// Smallest and largest intensity of the driver, 0–5.
    pub driver: [f32; 2],
    /// Smallest and largest intensity that count as the avatar's least and most.
    pub range: [f32; 2],
    /// Share of pictures beyond the range, clamped to it.
    pub beyond_share: f64,
    /// How far the farthest of them lies beyond it.
    pub beyond_most: f32,
}

/// An avatar's expression for every picture.
pub struct Fitted {
    /// One per picture.
    pub expressions: Vec<Expression>,
    /// The AUs that drive.
    pub units: Vec<DrivenUnit>,
    /// AUs that the driver moves and the avatar never did.
    pub unknown: BTreeSet<ActionUnit>,
}

/// Expressions at the given times.
pub(super) fn fit(avatar: &Avatar, driver: &Driver, range: Range, times_secs: &[f64]) -> Fitted {
    let mut fitted =
        Fitted { expressions: vec![avatar.neutral(); times_secs.len()], units: Vec::new(), unknown: BTreeSet::new() };
    for (k, spec) in avatar.saved.table.attributes.iter().enumerate() {
        let Some(curve) = driver.intensities.get(&spec.unit) else { continue };
        let (low, high) = curve.iter().fold((f32::MAX, f32::MIN), |(l, h), &v| (l.min(v), h.max(v)));
        let own = AttributeSpec::from_range(spec.unit, spec.region, low, high, low);
        if !spec.active {
            if own.active {
                fitted.unknown.insert(spec.unit);
            }
            continue;
        }
        let used = match range {
            Range::Avatar => spec.clone(),
            Range::Driver => own,
        };
        if !used.active {
            // The driver never moves it: the avatar keeps its neutral value.
            continue;
        }
        let values: Vec<f32> = times_secs.iter().map(|t| interpolate(&driver.times_secs, curve, *t)).collect();
        let beyond: Vec<f32> =
            values.iter().map(|v| (v - used.au_max).max(used.au_min - v)).filter(|b| *b > TOLERANCE).collect();
        let (from, to) = (used.scale(), spec.scale());
        for (expression, value) in fitted.expressions.iter_mut().zip(&values) {
            expression.0[k] = from.carried_to(&to, Intensity(*value));
        }
        fitted.units.push(DrivenUnit {
            unit: spec.unit,
            driver: [low, high],
            range: [used.au_min, used.au_max],
            beyond_share: beyond.len() as f64 / values.len().max(1) as f64,
            beyond_most: beyond.iter().copied().fold(0.0, f32::max),
        });
    }
    fitted
}
