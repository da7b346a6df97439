//! What a scene does not need and the kernels therefore leave out. Each skip can be switched off, to measure what it saves
//! and what it costs.

use serde::{Deserialize, Serialize};

/// Which skips are on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Skips {
    /// Parts of the boxes that hold nothing, and what has not been seen lately.
    pub empty_space: bool,
    /// Samples behind what is opaque.
    pub hidden: bool,
    /// Fine levels and short steps while a fit is young.
    pub coarse_first: bool,
    /// Updates of bricks that no ray touched.
    pub untouched: bool,
    /// On the way back, most of the samples whose gradients are faint; in pictures, colours of samples that hardly show.
    pub faint: bool,
    /// Pixels that an edit of an expression cannot change.
    pub unchanged: bool,
}

impl Default for Skips {
    fn default() -> Self {
        Self { empty_space: true, hidden: true, coarse_first: true, untouched: true, faint: true, unchanged: true }
    }
}

impl Skips {
    /// The names of all skips, as commands take them.
    pub const NAMES: [&'static str; 6] = ["empty-space", "hidden", "coarse-first", "untouched", "faint", "unchanged"];

    /// Switches one off by its name; false if there is none of that name.
    pub fn switch_off(&mut self, name: &str) -> bool {
        let Self { empty_space, hidden, coarse_first, untouched, faint, unchanged } = self;
        let all = [empty_space, hidden, coarse_first, untouched, faint, unchanged];
        let found = Self::NAMES.iter().zip(all).find(|(n, _)| **n == name);
        found.is_some_and(|(_, skip)| {
            *skip = false;
            true
        })
    }
}
