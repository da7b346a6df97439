//! What a scene does not need and the kernels therefore leave out. Each skip can be switched off, to measure what it saves
//! and what it costs.

use serde::{Deserialize, Serialize};

/// Which skips are on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Skips {
    /// Groups of Gaussians that no pixel shows.
    pub invisible: bool,
    /// Deltas of AUs that rest, and their updates.
    pub untouched: bool,
    /// Gaussians behind what is opaque.
    pub hidden: bool,
    /// Tiles that an edit of an expression does not meet.
    pub unchanged: bool,
}

impl Default for Skips {
    fn default() -> Self {
        Self { invisible: true, untouched: true, hidden: true, unchanged: true }
    }
}

impl Skips {
    /// The names of all skips, as commands take them.
    pub const NAMES: [&'static str; 4] = ["invisible", "untouched", "hidden", "unchanged"];

    /// Switches one off by its name; false if there is none of that name.
    pub fn switch_off(&mut self, name: &str) -> bool {
        let Self { invisible, untouched, hidden, unchanged } = self;
        let all = [invisible, untouched, hidden, unchanged];
        let found = Self::NAMES.iter().zip(all).find(|(n, _)| **n == name);
        found.is_some_and(|(_, skip)| {
            *skip = false;
            true
        })
    }
}
