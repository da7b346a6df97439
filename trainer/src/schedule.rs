//! Values that change with the step (fact sheet §2.5).

use serde::{Deserialize, Serialize};

/// A number by step; steps count from 1, and a value is asked for with the number of the step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", tag = "kind", deny_unknown_fields)]
pub enum Schedule {
    /// Always `value`.
    Constant {
        /// The value.
        value: f64,
    },
    /// `from · (max(to, 1e-10) / from)^(t / (steps − 1))` before `steps`, exactly `to` from there on.
    Exponential {
        /// Value at step 0; above `to`.
        from: f64,
        /// Final value; may be 0.
        to: f64,
        /// When it is reached.
        steps: u64,
    },
    /// `from` until `delay`, then linear to `to` over `steps`.
    Ramp {
        /// Steps before the ramp.
        delay: u64,
        /// Value before the ramp.
        from: f64,
        /// Value after it.
        to: f64,
        /// Length of the ramp.
        steps: u64,
    },
}

impl Schedule {
    /// The value at `step`.
    pub fn at(&self, step: u64) -> f64 {
        match *self {
            Self::Constant { value } => value,
            Self::Exponential { from, to, steps } => {
                if step >= steps || steps < 2 {
                    return to;
                }
                from * (to.max(1e-10) / from).powf(step as f64 / (steps - 1) as f64)
            }
            // The step at the border belongs to the ramp, with local time 0 (fact sheet §8.23).
            Self::Ramp { delay, from, to, steps } => {
                let t = step.saturating_sub(delay);
                if t >= steps { to } else { from + (to - from) * t as f64 / steps as f64 }
            }
        }
    }

    /// The same curve over `ratio` times as many steps.
    #[must_use]
    pub fn stretched(&self, ratio: f64) -> Self {
        let scale = |steps: u64| (steps as f64 * ratio).round() as u64;
        match *self {
            Self::Constant { value } => Self::Constant { value },
            Self::Exponential { from, to, steps } => Self::Exponential { from, to, steps: scale(steps) },
            Self::Ramp { delay, from, to, steps } => Self::Ramp { delay: scale(delay), from, to, steps: scale(steps) },
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::config::FitSettings;

    #[test]
    fn the_papers_schedules_match_the_check_values() {
        let (s, code) = (FitSettings::paper(), FitSettings::code());
        for (step, lr, attr) in [
            (1, 9.9999e-4, 0.099_991_7),
            (1_000, 9.908_32e-4, 0.092_044_9),
            (50_000, 6.309_56e-4, 1.584_87e-3),
            (125_000, 3.162_26e-4, 3.162_15e-6),
            (249_999, 1e-4, 1e-10),
            (250_000, 1e-4, 0.0),
        ] {
            let close = |got: f64, want: f64| (got - want).abs() <= 2e-5 * want.abs();
            assert!(close(code.learning_rate.at(step), lr), "lr at {step}: {}", code.learning_rate.at(step));
            assert!(close(s.learning_rate.at(step), lr / 10.0), "lr at {step}: {}", s.learning_rate.at(step));
            assert!(close(s.attribute_weight.at(step), attr), "w_attr at {step}: {}", s.attribute_weight.at(step));
        }
        for (step, hyper, warp) in [
            (1, 0.0, 7.5e-5),
            (1_000, 0.0, 0.075),
            (6_000, 0.5, 0.45),
            (11_000, 1.0, 0.825),
            (50_000, 1.0, 3.75),
            (125_000, 1.0, 6.0),
        ] {
            assert!((s.hyper_window.at(step) - hyper).abs() < 1e-12, "hyper at {step}");
            assert!((s.warp_window.at(step) - warp).abs() < 1e-12, "warp at {step}");
        }
    }
}
