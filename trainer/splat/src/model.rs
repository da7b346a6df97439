//! The Gaussians: base parameters, deltas per AU, gates, memberships.
//!
//! Groups of 16 Gaussians, `[group][channel][16]`, so that a vector is one channel of a group. Deformable groups come
//! first; only these carry deltas and gates:
//!
//! ```text
//! θ(a) = θ0 + Σ_k a_k g_r(k) Δθ_k        k over AUs, then over the latent code; θ: mean and colour (6 channels)
//! ```
//!
//! Units: metres, logarithms of metres, colours 0–1 (linear in the composite, not clamped before).

use serde::{Deserialize, Serialize};

/// Gaussians per group, the width of a vector.
pub const LANES: usize = 16;
/// Regions at most.
pub const REGIONS: usize = 3;
/// Numbers of a latent code.
pub const LATENT: usize = 4;
/// Channels of a Gaussian that deltas act on: mean, colour.
pub const DELTAS: usize = 6;

/// Base channels of a Gaussian.
pub mod channel {
    /// x, y, z in the frame of head and room at rest, metres.
    pub const MEAN: usize = 0;
    /// Logarithms of the standard deviations along its axes.
    pub const LOG_SCALE: usize = 3;
    /// Raw quaternion (w, x, y, z).
    pub const QUATERNION: usize = 6;
    /// Opacity before the logistic function.
    pub const OPACITY: usize = 10;
    /// Red, green, blue.
    pub const COLOR: usize = 11;
    /// Spherical harmonics of degree 1: (y, z, x) × (red, green, blue), basis-major.
    pub const SH1: usize = 14;
    /// How many there are.
    pub const COUNT: usize = 23;
}

/// Sizes that do not change during a fit.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Layout {
    /// Region of each AU.
    pub region_of: Vec<usize>,
    /// Regions that an AU acts in beside its own, a bit each; AUs that are not listed have none.
    #[serde(default)]
    pub also_in: Vec<u8>,
    /// Number of regions.
    pub regions: usize,
    /// Numbers of a latent code (0 or [`LATENT`]).
    pub latent: usize,
    /// Training images.
    pub images: usize,
}

impl Layout {
    /// AUs and numbers of the latent code: all that deltas are blended by.
    pub fn bases(&self) -> usize {
        self.region_of.len() + self.latent
    }

    /// The regions that basis `k` acts in, a bit each; 0 for the latent code, which no gate holds back.
    pub fn reach(&self, k: usize) -> u8 {
        let also = self.also_in.get(k).copied().unwrap_or(0);
        self.region_of.get(k).map_or(0, |&region| 1 << region.min(REGIONS - 1) | also & ((1 << REGIONS) - 1))
    }
}

/// All Gaussians of an avatar.
#[derive(Clone, Debug, PartialEq)]
pub struct Gaussians {
    /// AUs, regions, images.
    pub layout: Layout,
    /// Groups that carry deltas; they come first.
    pub deformable: usize,
    /// `[group][channel::COUNT][16]`. Slots of no Gaussian have an opacity of [`EMPTY`].
    pub base: Vec<f32>,
    /// `[deformable group][bases][DELTAS][16]`.
    pub deltas: Vec<f32>,
    /// Gates of the regions' AUs, 0–1, fixed: `[deformable group][REGIONS][16]`.
    pub gates: Vec<f32>,
    /// Logit of belonging to each region, learned from the 2D labels: `[group][REGIONS][16]`.
    pub membership: Vec<f32>,
    /// How much of the head's motion a Gaussian follows, 0–1: `[group][16]`.
    pub head_weight: Vec<f32>,
}

/// Opacity (before the logistic function) of a slot that holds no Gaussian.
pub const EMPTY: f32 = -30.0;

impl Gaussians {
    /// Groups of 16.
    pub fn groups(&self) -> usize {
        self.base.len() / (channel::COUNT * LANES)
    }

    /// Gaussians that are there.
    pub fn count(&self) -> usize {
        let at = |g: usize| (g * channel::COUNT + channel::OPACITY) * LANES;
        (0..self.groups()).map(|g| self.base[at(g)..at(g) + LANES].iter().filter(|&&o| o > EMPTY * 0.5).count()).sum()
    }

    /// Puts an avatar together from its arrays; says which has another length than the layout asks for.
    pub fn from_arrays(
        layout: Layout,
        base: Vec<f32>,
        deltas: Vec<f32>,
        gates: Vec<f32>,
        membership: Vec<f32>,
        head_weight: Vec<f32>,
    ) -> Result<Self, String> {
        let whole = |name: &str, len: usize, row: usize| {
            if row == 0 || !len.is_multiple_of(row) {
                return Err(format!("`{name}` holds {len} numbers, expected a multiple of {row}"));
            }
            Ok(len / row)
        };
        if layout.regions > REGIONS || layout.region_of.iter().any(|&r| r >= layout.regions) {
            return Err(format!("names regions beyond {}", layout.regions.min(REGIONS)));
        }
        let groups = whole("base", base.len(), channel::COUNT * LANES)?;
        let deformable = whole("gates", gates.len(), REGIONS * LANES)?;
        let lengths = [
            ("deltas", deltas.len(), deformable * layout.bases() * DELTAS * LANES),
            ("membership", membership.len(), groups * REGIONS * LANES),
            ("head_weight", head_weight.len(), groups * LANES),
            ("gates", deformable, deformable.min(groups)),
        ];
        if let Some((name, len, expected)) = lengths.iter().find(|(_, len, expected)| len != expected) {
            return Err(format!("`{name}` holds {len} numbers, expected {expected}"));
        }
        Ok(Self { layout, deformable, base, deltas, gates, membership, head_weight })
    }

    /// Bytes of the arrays.
    pub fn bytes(&self) -> usize {
        4 * (self.base.len() + self.deltas.len() + self.gates.len() + self.membership.len() + self.head_weight.len())
    }
}
