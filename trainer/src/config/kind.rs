//! Which model: CoNFies, or one of the models of the paper's Table 2, as ablations of the same code.

use std::str::FromStr;

use risorius_formats::{ErrorKind, FormatError};
use serde::{Deserialize, Serialize};

/// A model of the family.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ModelKind {
    /// A slice per attribute, a mask net per region that sees its own slices only, an uncertainty net per attribute.
    #[default]
    Confies,
    /// A slice per attribute, one mask net that sees all slices and gives a mask per attribute, no uncertainty, the
    /// attribute net without tanh.
    Conerf,
    /// CoNeRF without masks.
    ConerfM,
    /// One slice of x and ω, a bendy sheet; nothing is steered.
    Hypernerf,
    /// The code ω itself as ambient coordinates, an axis-aligned plane, with a deformation field.
    HypernerfAp,
    /// The deformation field only.
    Nerfies,
    /// The code ω as ambient coordinates, without a deformation field.
    NerfLatent,
    /// A static scene.
    Nerf,
}

/// Where ambient coordinates come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SliceKind {
    /// H_i(x, α_i) and H_0(x, ω).
    PerAttribute,
    /// H_0(x, ω) only.
    Rest,
    /// ω itself.
    Code,
    /// There are none.
    None,
}

/// What masks the ambient coordinates.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MaskKind {
    /// A net per region on the slices of its own attributes.
    PerRegion,
    /// One net on all slices, with a mask per attribute.
    Joint,
    /// Nothing.
    None,
}

impl ModelKind {
    /// All, in the order of the paper's Table 2 (from its last row up to its first).
    pub const ALL: [Self; 8] = [
        Self::Confies,
        Self::Conerf,
        Self::ConerfM,
        Self::Hypernerf,
        Self::HypernerfAp,
        Self::Nerfies,
        Self::NerfLatent,
        Self::Nerf,
    ];

    /// Its name in settings and on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Confies => "confies",
            Self::Conerf => "conerf",
            Self::ConerfM => "conerf-m",
            Self::Hypernerf => "hypernerf",
            Self::HypernerfAp => "hypernerf-ap",
            Self::Nerfies => "nerfies",
            Self::NerfLatent => "nerf-latent",
            Self::Nerf => "nerf",
        }
    }

    /// Whether there is a code ω per frame.
    pub const fn has_latent(self) -> bool {
        !matches!(self, Self::Nerf)
    }

    /// Whether points are warped.
    pub const fn has_warp(self) -> bool {
        !matches!(self, Self::NerfLatent | Self::Nerf)
    }

    /// Whether attributes steer it.
    pub const fn has_attributes(self) -> bool {
        matches!(self, Self::Confies | Self::Conerf | Self::ConerfM)
    }

    /// Whether the attribute net ends in a tanh.
    pub const fn has_tanh(self) -> bool {
        matches!(self, Self::Confies)
    }

    /// Whether each attribute's error is weighed by a learned uncertainty.
    pub const fn has_uncertainty(self) -> bool {
        matches!(self, Self::Confies)
    }

    /// Where ambient coordinates come from.
    pub const fn slices(self) -> SliceKind {
        match self {
            Self::Confies | Self::Conerf | Self::ConerfM => SliceKind::PerAttribute,
            Self::Hypernerf => SliceKind::Rest,
            Self::HypernerfAp | Self::NerfLatent => SliceKind::Code,
            Self::Nerfies | Self::Nerf => SliceKind::None,
        }
    }

    /// What masks them.
    pub const fn masks(self) -> MaskKind {
        match self {
            Self::Confies => MaskKind::PerRegion,
            Self::Conerf => MaskKind::Joint,
            _ => MaskKind::None,
        }
    }
}

impl FromStr for ModelKind {
    type Err = FormatError;

    fn from_str(name: &str) -> Result<Self, FormatError> {
        Self::ALL.into_iter().find(|k| k.name() == name).ok_or_else(|| {
            FormatError::new(ErrorKind::Unsupported, format!("there is no model `{name}`"))
                .with_hint(format!("models: {}", Self::ALL.map(Self::name).join(", ")))
        })
    }
}
