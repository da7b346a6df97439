//! What is stated about a table of curves.

use risorius_console::Failure;
use risorius_formats::TableScale;
use risorius_formats::curves::CurveOptions;

/// Options of every command that takes `--curves`.
#[derive(clap::Args, Clone, Copy, Debug, Default)]
pub(super) struct CurvesArgs {
    /// Frames per second of the curves' timecodes or frame numbers [default: as they tell]
    #[arg(long, value_name = "RATE", requires = "curves")]
    curves_fps: Option<f64>,
    /// Largest value of the scale of the curves' AUs: 1 for probabilities, 5, or 100 for percent [default: as they tell]
    #[arg(long, value_name = "N", requires = "curves")]
    curves_scale: Option<TableScale>,
}

impl CurvesArgs {
    pub(super) fn options(&self) -> Result<CurveOptions, Failure> {
        if self.curves_fps.is_some_and(|fps| !(fps.is_finite() && fps > 0.0 && fps <= 1000.0)) {
            return Err(Failure::usage("`--curves-fps` must be above 0, and at most 1000"));
        }
        Ok(CurveOptions { fps: self.curves_fps, scale: self.curves_scale })
    }
}
