//! What `dataset build` is asked for.

use risorius_formats::RegionTable;
use serde::{Deserialize, Serialize};

use crate::balance::{BalanceOptions, Bins, Quota};
use crate::entropy::EntropyOptions;
use crate::error::{DatasetError, Result};
use crate::regions::Shape;
use crate::split::{SplitKind, SplitOptions};

/// How frames are chosen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Sampling {
    /// The paper's balance: about as many of every (AU, intensity) block as there can be.
    #[default]
    Balanced,
    /// Most entropy over AU levels, camera directions and time together; sharp frames first.
    Entropy,
    /// Evenly over time: the baseline.
    Uniform,
}

impl Sampling {
    /// The name that the command line uses.
    pub fn name(self) -> &'static str {
        match self {
            Self::Balanced => "paper",
            Self::Entropy => "entropy",
            Self::Uniform => "uniform",
        }
    }
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
    /// What the levels span.
    pub bins: Bins,
    /// How many frames a block may take.
    pub quota: Quota,
    /// Whether frames that other blocks took count against a block's quota.
    pub count_existing: bool,
    /// Rows below this confidence are not trusted, 0–1.
    pub min_confidence: f32,
    /// Whether every frame is for fitting and none is held out.
    pub no_val: bool,
    /// Which frames are held out.
    pub split: SplitKind,
    /// The share of frames that is held out, where the split leaves a choice.
    pub val_share: f64,
    /// Frames closer in time than this to a held-out block are left out, seconds.
    pub guard_secs: f64,
    /// Whether takes that state different subjects, or whose faces differ, are one person all the same.
    pub same_subject: bool,
    /// Whether AUs that some takes lack are left out instead of refused.
    pub common_aus: bool,
    /// Whether masks of the head are written.
    pub head_masks: bool,
    /// The regions and their AUs; those that the tracks lack are left out.
    pub regions: RegionTable,
    /// What the entropy objective weighs.
    pub entropy: EntropyOptions,
}

impl Default for BuildOptions {
    fn default() -> Self {
        Self {
            sampling: Sampling::Balanced,
            frames: 750,
            scale: 4,
            scales: vec![4, 8],
            levels: 6,
            bins: Bins::Scale,
            quota: Quota::Running,
            count_existing: false,
            min_confidence: 0.8,
            no_val: false,
            split: SplitKind::Periodic,
            val_share: 0.1,
            guard_secs: 0.25,
            same_subject: false,
            common_aus: false,
            head_masks: true,
            regions: RegionTable::paper(),
            entropy: EntropyOptions::default(),
        }
    }
}

impl BuildOptions {
    /// The scales written unless told otherwise: `scale` and everything coarser. 1x is large and rarely needed.
    pub fn scales_from(scale: u32) -> Vec<u32> {
        SCALES.into_iter().filter(|&s| s >= scale).collect()
    }

    /// What the balanced choice is asked for.
    pub(crate) fn balance(&self) -> BalanceOptions {
        BalanceOptions { levels: self.levels, quota: self.quota, count_existing: self.count_existing }
    }

    /// Which frames are held out.
    pub(crate) fn split(&self) -> SplitOptions {
        let kind = if self.no_val { SplitKind::None } else { self.split };
        SplitOptions { kind, val_share: self.val_share, guard_secs: self.guard_secs }
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
        if !(self.val_share > 0.0 && self.val_share <= 0.5) {
            return fail(
                format!("a held-out share of {} is out of 0 to 0.5", self.val_share),
                "a tenth is `--val-share 0.1`; `--split none` holds nothing out",
            );
        }
        if !(self.guard_secs >= 0.0 && self.guard_secs.is_finite()) {
            return fail(format!("a guard of {} seconds makes no sense", self.guard_secs), "try `--guard-secs 0.25`");
        }
        self.entropy.check()?;
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
