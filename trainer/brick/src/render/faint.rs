//! Where a region's mask in the picture rounds to nothing, its AUs change nothing.
//!
//! Towards a region's end its mask and what its AUs do fall together; but a jaw's share of some centimetres still moves
//! a sharp edge by more than a level of 255 where the mask has long rounded to 0. So a ray whose mask is nothing, with the
//! AUs of that region and without them (activation 0), shows the head without them, and one whose mask is faint shows a
//! mixture. A ray that looks past parted lips is neither: without the AUs there is skin.

use std::collections::BTreeMap;

use rayon::prelude::*;

use super::{Face, FacePicture, Shown};
use crate::expression::{CHANNELS, HARD, QUIET, REST};
use crate::lattice::BRICK;

/// A mask in the picture below this is 0 of 255 levels.
pub const NOTHING: f32 = 0.5 / 255.0;
/// From here on AUs show in full: what is less at a vertex is none.
const FULL: f32 = HARD;

/// What a ray shows instead: sets of regions, a bit each, whose AUs are left out.
#[derive(Clone, Copy, Debug)]
struct Faint {
    ray: usize,
    /// Those whose masks are nothing.
    nothing: u8,
    /// Those and the faint ones.
    all: u8,
    /// How much of the first it shows; the rest is of the second.
    share: f32,
}

/// What rays show without the AUs of each set of regions.
pub(super) type Without = [BTreeMap<usize, Shown>; 1 << REST];

impl Face<'_> {
    /// Takes from rays (all, if none are named) what AUs do where their regions' masks are nothing.
    pub(super) fn hush(&self, picture: &mut FacePicture, rays: Option<&[usize]>) {
        let FacePicture { origin, directions, shown, without } = picture;
        let acting = self.acting_regions();
        // Who asks for what rays show without a region alone: those with a faint mask of it.
        let low = |shown: &Shown, n: usize| shown.touched & acting & 1 << n != 0 && shown.masks[n] < FULL;
        let some = |ray: &usize| (0..REST).any(|n| low(&shown[*ray], n));
        let rays: Vec<usize> = match rays {
            Some(rays) => rays.iter().copied().filter(some).collect(),
            None => (0..shown.len()).into_par_iter().filter(some).collect(),
        };
        let low = |ray: usize, n: usize| low(&shown[ray], n);
        for n in 0..REST {
            let wanted = rays.iter().copied().filter(|&ray| low(ray, n));
            self.complete(1 << n, *origin, directions, wanted, &mut without[1 << n]);
        }
        let faint: Vec<Faint> = rays
            .iter()
            .filter_map(|&ray| {
                let alone = [0, 1, 2].map(|n| without[1 << n].get(&ray).filter(|_| low(ray, n)));
                Faint::of(ray, &shown[ray], alone)
            })
            .collect();
        for set in (0..1u8 << REST).filter(|set| set.count_ones() > 1) {
            let wanted = faint.iter().filter(|f| f.nothing == set || f.all == set).map(|f| f.ray);
            self.complete(set, *origin, directions, wanted, &mut without[usize::from(set)]);
        }
        for f in faint {
            let main = &mut shown[f.ray];
            let of = |set: u8| without[usize::from(set)].get(&f.ray).filter(|_| set != 0);
            let (first, second) = (*of(f.nothing).unwrap_or(main), *of(f.all).unwrap_or(main));
            for n in (0..REST).filter(|n| f.all >> n & 1 == 1) {
                main.masks[n] = main.masks[n].max(of(1 << n).map_or(0.0, |s| s.masks[n]));
            }
            main.mix(&first, &second, f.share);
        }
    }

    /// Sends those of `wanted` that are not known yet, without the AUs of the regions in `set`.
    fn complete(
        &self,
        set: u8,
        origin: [f32; 3],
        directions: &[[f32; 3]],
        wanted: impl Iterator<Item = usize>,
        known: &mut BTreeMap<usize, Shown>,
    ) {
        let rays: Vec<usize> = wanted.filter(|ray| !known.contains_key(ray)).collect();
        if rays.is_empty() {
            return;
        }
        let wanted: Vec<[f32; 3]> = rays.iter().map(|&ray| directions[ray]).collect();
        let blend = self.without[usize::from(set)].get_or_init(|| self.blend_without(set));
        let mut shown = vec![Shown::default(); rays.len()];
        self.render_with(blend, origin, &wanted, &mut shown);
        known.extend(rays.into_iter().zip(shown));
    }

    /// A bit for each region with an AU that acts.
    fn acting_regions(&self) -> u8 {
        let units = self.activations.iter().zip(&self.model.expression.region_of);
        units.filter(|(a, n)| a.abs() >= QUIET && **n < REST).fold(0, |bits, (_, n)| bits | 1 << n)
    }

    /// B without the AUs of the regions in `set`.
    fn blend_without(&self, set: u8) -> Vec<f32> {
        let expression = &self.model.expression;
        let left_out = |n: usize| n < REST && set >> n & 1 == 1;
        let activations: Vec<f32> = self
            .activations
            .iter()
            .zip(&expression.region_of)
            .map(|(&a, &n)| if left_out(n) { 0.0 } else { a })
            .collect();
        let stale = expression.slots_in(set);
        let mut blend = self.blend.clone();
        blend
            .par_chunks_exact_mut(BRICK * CHANNELS)
            .enumerate()
            .filter(|(slot, _)| stale[*slot])
            .for_each(|(slot, out)| expression.blend_slot(&self.gates, &activations, slot, out));
        blend
    }
}

impl Faint {
    /// What a ray shows instead, if a region's mask is faint in it and in what it shows without that region.
    fn of(ray: usize, shown: &Shown, alone: [Option<&Shown>; REST]) -> Option<Self> {
        let mut faint = Self { ray, nothing: 0, all: 0, share: 1.0 };
        for (n, alone) in alone.into_iter().enumerate() {
            let Some(alone) = alone else { continue };
            let mask = shown.masks[n].max(alone.masks[n]);
            if mask < FULL {
                faint.all |= 1 << n;
            }
            if mask < NOTHING {
                faint.nothing |= 1 << n;
            } else if mask < FULL {
                faint.share = faint.share.min((mask - NOTHING) / (FULL - NOTHING));
            }
        }
        (faint.all != 0).then_some(faint)
    }
}

impl Shown {
    /// Becomes a mixture of two, but for its masks.
    fn mix(&mut self, first: &Self, second: &Self, share: f32) {
        let mix = |a: f32, b: f32| share * a + (1.0 - share) * b;
        self.color = std::array::from_fn(|c| mix(first.color[c], second.color[c]));
        self.left = mix(first.left, second.left);
        self.head = std::array::from_fn(|c| mix(first.head[c], second.head[c]));
        self.depth = if share >= 0.5 { first.depth } else { second.depth };
        self.touched |= first.touched | second.touched;
    }
}
