//! A field at many samples, and the way back. One call works on one chunk of samples that fits the cache.

mod backward;
mod forward;

use self::backward::Backward;
pub use self::backward::Lot;
use self::forward::{Colors, Forward, Which};
use crate::expression::{BlendGrad, MASKS};
use crate::field::{Field, FieldGrad, MIDDLE, OUTPUT, Transposed};
use crate::lattice::Lattice;
use crate::sixteen::Each;

/// What an image's expression does to the field.
#[derive(Clone, Copy, Debug)]
pub struct Deformation<'a> {
    /// The bricks of the regions.
    pub lattice: &'a Lattice,
    /// B, see [`crate::expression`].
    pub blend: &'a [f32],
    /// The masks at the vertices.
    pub gates: &'a [f32],
    /// The image's own displacement, 4 numbers per vertex (the last unused).
    pub latent: Option<(&'a Lattice, &'a [f32])>,
}

/// Gradients of a [`Deformation`] and of where the samples lie.
#[derive(Debug)]
pub struct DeformationGrad<'a> {
    /// Of B.
    pub blend: &'a mut BlendGrad,
    /// Of the masks at the vertices.
    pub gates: &'a mut [f32],
    /// Of the image's own displacement.
    pub latent: &'a mut [f32],
    /// Of a small turn and shift of all points: Σ p × g, Σ g.
    pub motion: &'a mut [f32; 6],
    /// Whether latent displacement and motion are learned at all.
    pub moves: bool,
}

/// The samples of a chunk and everything that was computed for them.
#[derive(Clone, Debug, Default)]
pub struct Samples {
    /// Where, in the box.
    pub point: Vec<[f32; 3]>,
    /// The ray of each sample, an index into `directions`.
    pub ray: Vec<u32>,
    /// The direction's monomials of each ray.
    pub directions: Vec<[f32; 8]>,
    /// Where the features were looked up.
    warped: Vec<[f32; 3]>,
    /// Whether a region's brick holds the sample.
    in_region: Vec<bool>,
    /// A bit for each region whose AUs can change the sample, where [`Self::tells_acts`].
    acts: Vec<u8>,
    /// Whether [`Self::acts`] is wanted: a fit asks for none.
    pub(crate) tells_acts: bool,
    x1: Vec<f32>,
    h1: Vec<f32>,
    middle: Vec<f32>,
    x3: Vec<f32>,
    h3: Vec<f32>,
    out: Vec<f32>,
    /// The masks at the samples.
    pub masks: Vec<[f32; MASKS]>,
    /// Gradient of the raw density.
    pub d_density: Vec<f32>,
    /// Gradient of the raw colour.
    pub d_color: Vec<[f32; 3]>,
    /// Gradient of the masks.
    pub d_masks: Vec<[f32; MASKS]>,
    kept: Vec<u32>,
    d_out: Vec<f32>,
    d_h3: Vec<f32>,
    d_x3: Vec<f32>,
    d_middle: Vec<f32>,
    d_h1: Vec<f32>,
    d_x1: Vec<f32>,
}

fn room(v: &mut Vec<f32>, n: usize) {
    if v.len() < n {
        v.resize(n, 0.0);
    }
}

impl Samples {
    /// Forgets all samples, keeps the memory.
    pub fn clear(&mut self) {
        self.point.clear();
        self.ray.clear();
        self.directions.clear();
    }

    /// Number of samples.
    pub fn len(&self) -> usize {
        self.point.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.point.is_empty()
    }

    /// Raw density of sample `i`.
    #[inline(always)]
    pub fn density(&self, i: usize) -> f32 {
        self.middle[i * MIDDLE]
    }

    /// Makes sample `i` show nothing.
    pub fn silence(&mut self, i: usize) {
        self.middle[i * MIDDLE] = -1e9;
    }

    /// Whether a region's brick holds sample `i`.
    #[inline(always)]
    pub(crate) fn in_region(&self, i: usize) -> bool {
        self.in_region[i]
    }

    /// A bit for each region whose AUs can change sample `i`: those that act at one of its corners.
    #[inline(always)]
    pub(crate) fn acts(&self, i: usize) -> u8 {
        self.acts[i]
    }

    /// Raw colour of sample `i`.
    #[inline(always)]
    pub fn color(&self, i: usize) -> [f32; 3] {
        [self.out[i * OUTPUT], self.out[i * OUTPUT + 1], self.out[i * OUTPUT + 2]]
    }

    /// Densities (and masks) of `field` at the samples from `from` on.
    pub fn forward(&mut self, field: &Field, deformation: Option<&Deformation<'_>>, from: usize) {
        if from < self.len() {
            crate::simd::run(Forward { samples: self, field, deformation, from });
        }
    }

    /// Colours of the samples from `from` on, after [`Self::forward`].
    pub fn color_all(&mut self, field: &Field, from: usize) {
        if from < self.len() {
            crate::simd::run(Colors { samples: self, field, which: Which::From(from) });
        }
    }

    /// Colours of some samples, after [`Self::forward`]; the way back does not know of them.
    pub fn color_some(&mut self, field: &Field, some: &[u32]) {
        if !some.is_empty() {
            crate::simd::run(Colors { samples: self, field, which: Which::Some(some) });
        }
    }

    /// As [`Self::forward`] and [`Self::color_all`] from the first sample on, with the instructions of `level`.
    #[cfg(test)]
    pub(crate) fn forward_at(
        &mut self,
        level: crate::simd::Level,
        field: &Field,
        deformation: Option<&Deformation<'_>>,
    ) {
        crate::simd::run_at(level, Forward { samples: self, field, deformation, from: 0 });
        crate::simd::run_at(level, Colors { samples: self, field, which: Which::From(0) });
    }

    /// Adds the gradients that `d_density`, `d_color` and `d_masks` cause; `lot` decides which samples take part. Returns how
    /// many did.
    pub fn backward(
        &mut self,
        field: &Field,
        transposed: &Transposed,
        deformation: Option<&Deformation<'_>>,
        lot: Lot,
        grad: &mut FieldGrad,
        deformation_grad: Option<&mut DeformationGrad<'_>>,
    ) -> usize {
        crate::simd::run(Backward { samples: self, field, transposed, deformation, lot, grad, deformation_grad })
    }
}

/// x, y, z of up to 16 points; the rest are 0.
#[inline(always)]
fn split(points: impl ExactSizeIterator<Item = [f32; 3]>) -> [Each<f32>; 3] {
    let mut out = [[0.0; 16]; 3];
    for (s, p) in points.enumerate() {
        for a in 0..3 {
            out[a][s] = p[a];
        }
    }
    out
}
