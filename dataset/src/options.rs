//! What `dataset build` is asked for.

use risorius_formats::RegionTable;
use serde::{Deserialize, Serialize};

use crate::error::{DatasetError, Result};
use crate::regions::Shape;

/// How frames are chosen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Sampling {
    /// About as many of every (AU, intensity) block as there can be.
    #[default]
    Balanced,
    /// Evenly over time: the baseline.
    Uniform,
}

/// What `dataset build` is asked for. `report/settings.toml` keeps it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct BuildOptions {
    /// How frames are chosen.
    pub sampling: Sampling,
    /// How many frames are wanted.
    pub frames: usize,
    /// The image scale that fitting uses unless told otherwise: 1, 2, 4 or 8.
    pub scale: u32,
    /// The image scales that are written.
    pub scales: Vec<u32>,
    /// Intensity levels per AU.
    pub levels: usize,
    /// Whether frames that other blocks took count against a block's quota.
    pub count_existing: bool,
    /// Rows below this confidence are not trusted, 0–1.
    pub min_confidence: f32,
    /// Whether every frame is for fitting and none is held out.
    pub no_val: bool,
    /// The regions and their AUs; those that the tracks lack are left out.
    pub regions: RegionTable,
}

impl Default for BuildOptions {
    fn default() -> Self {
        Self {
            sampling: Sampling::Balanced,
            frames: 750,
            scale: 4,
            scales: vec![4, 8],
            levels: 6,
            count_existing: false,
            min_confidence: 0.8,
            no_val: false,
            regions: RegionTable::paper(),
        }
    }
}

impl BuildOptions {
    /// The scales written unless told otherwise: `scale` and everything coarser. 1x is large and rarely needed.
    pub fn scales_from(scale: u32) -> Vec<u32> {
        SCALES.into_iter().filter(|&s| s >= scale).collect()
    }

    /// Fails, naming the option, when something makes no sense.
    pub(crate) fn check(&self) -> Result<()> {
        let fail = |message: String, hint: &str| Err(DatasetError::Option { message, hint: hint.to_owned() });
        if let Some(bad) = self.scales.iter().chain([&self.scale]).find(|s| !SCALES.contains(s)) {
            return fail(
                format!("the scale {bad} is not one that the family of loaders knows"),
                "scales are 1, 2, 4 and 8",
            );
        }
        if !self.scales.contains(&self.scale) {
            return fail(format!("scale {} is not among the scales to write", self.scale), "add it to `--scales`");
        }
        if self.frames < 2 {
            return fail(
                format!("{} frames make no dataset", self.frames),
                "ask for a few hundred, such as `--frames 750`",
            );
        }
        if !(2..=101).contains(&self.levels) {
            return fail(
                format!("{} intensity levels are out of 2 to 101", self.levels),
                "6 levels are whole steps of the 0–5 scale",
            );
        }
        if !(0.0..=1.0).contains(&self.min_confidence) {
            return fail(
                format!("the confidence limit {} is out of 0 to 1", self.min_confidence),
                "OpenFace's authors use 0.8",
            );
        }
        self.regions.validate()?;
        for (i, region) in self.regions.regions.iter().enumerate() {
            if Shape::from_name(&region.name).is_none()
                || self.regions.regions[..i].iter().any(|r| r.name == region.name)
            {
                return fail(
                    format!("the region `{}` has no outline of its own", region.name),
                    "regions are `brow`, `eye` and `mouth`, each at most once",
                );
            }
        }
        Ok(())
    }
}

/// The scales of the family.
pub const SCALES: [u32; 4] = [1, 2, 4, 8];
