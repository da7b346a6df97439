//! One pass over the groups that a picture shows: backward through projection and blending, Adam, gradients of the
//! image's own numbers.

use rayon::prelude::*;

use crate::backward::{Gradients, backward, gather};
use crate::bin::{Bins, Line};
use crate::model::{DELTAS, Gaussians, LANES, REGIONS, channel};
use crate::project::{Active, blend, gate_of, geometry};
use crate::simd::{self, F, M, Simd, Task, prefetch, rows, rows_mut};
use crate::view::View;

/// Groups are updated in this many chunks; what they sum up is added in their order.
const CHUNKS: usize = 32;
/// Adam's first and second decay, and ε (against gradients summed over pixels).
const BETA: [f32; 2] = [0.9, 0.99];
const EPSILON: f32 = 1e-4;
/// Channels of the Gaussians' own that Adam moves: all.
const MEAN: std::ops::Range<usize> = channel::MEAN..channel::LOG_SCALE;

/// Learning rates of a step.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rates {
    /// Mean: metres per step and metre of distance (pixels per step over the focal length).
    pub mean: f32,
    /// How many times faster the depth axis moves, per metre of distance; at least 1 is taken.
    pub depth: f32,
    /// Mean's deltas against the mean.
    pub delta: f32,
    pub log_scale: f32,
    pub quaternion: f32,
    pub opacity: f32,
    pub color: f32,
    pub sh1: f32,
}

/// Moments of Adam, in the layout of the arrays they belong to.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Moments {
    pub first: Vec<f32>,
    pub second: Vec<f32>,
}

impl Moments {
    pub(crate) fn zero(len: usize) -> Self {
        Self { first: vec![0.0; len], second: vec![0.0; len] }
    }
}

/// What the groups say about the picture as a whole.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Whole {
    /// ∂L/∂activation, per active basis.
    pub activations: Vec<f32>,
    /// ∂L of a shift and a turn of everything in camera axes (turn about the camera).
    pub camera: [f32; 6],
    /// The same of what is bound to the head.
    pub head: [f32; 6],
    /// Gaussians whose gradient was not finite; they were left as they were.
    pub not_finite: usize,
}

impl Whole {
    fn add(&mut self, other: &Self) {
        self.activations.resize(other.activations.len(), 0.0);
        let pairs = [
            (&mut self.activations[..], &other.activations[..]),
            (&mut self.camera[..], &other.camera[..]),
            (&mut self.head[..], &other.head[..]),
        ];
        for (sum, own) in pairs {
            sum.iter_mut().zip(own).for_each(|(a, b)| *a += b);
        }
        self.not_finite += other.not_finite;
    }
}

/// Everything a step changes.
pub(crate) struct Update<'a> {
    pub model: &'a mut Gaussians,
    pub base: &'a mut Moments,
    pub deltas: &'a mut Moments,
    /// Σ |∂L/∂(u, v)| per slot since the last densification.
    pub movement: &'a mut [f32],
}

/// What it is changed by.
pub(crate) struct Evidence<'a> {
    pub view: &'a View,
    pub active: &'a [Active],
    pub bins: &'a Bins,
    pub sums: &'a [Line],
    pub rates: Rates,
    /// Corrections of Adam's bias: √(1 − β₂ᵗ)/(1 − β₁ᵗ) of the base, then of each active basis.
    pub base_correction: f32,
    pub correction: &'a [f32],
    /// Whether the image's pose gradients are wanted.
    pub poses: bool,
}

/// The arrays of a chunk of groups.
struct Part<'a> {
    first_group: usize,
    base: &'a mut [f32],
    base_moments: [&'a mut [f32]; 2],
    deltas: &'a mut [f32],
    delta_moments: [&'a mut [f32]; 2],
    movement: &'a mut [f32],
}

impl Update<'_> {
    /// Moves every Gaussian that the picture shows; returns what concerns the picture as a whole.
    pub(crate) fn apply(self, evidence: &Evidence<'_>) -> Whole {
        let groups = self.model.groups();
        let per_chunk = groups.div_ceil(CHUNKS).max(1);
        let bases = self.model.layout.bases();
        let deformable = self.model.deformable;
        // What is read of the model while chunks write their own part of it.
        let Gaussians { base, deltas, gates, head_weight, .. } = self.model;
        let fixed = Fixed { gates, head_weight, bases, deformable };
        let row = channel::COUNT * LANES;
        let delta_row = bases * DELTAS * LANES;
        let mut cuts = Cuts {
            base,
            first: &mut self.base.first,
            second: &mut self.base.second,
            deltas,
            delta_first: &mut self.deltas.first,
            delta_second: &mut self.deltas.second,
            movement: self.movement,
        };
        let mut parts = Vec::with_capacity(CHUNKS);
        let mut g = 0;
        while g < groups {
            let count = per_chunk.min(groups - g);
            let deforming = deformable.saturating_sub(g).min(count);
            parts.push(cuts.take(g, count * row, deforming * delta_row, count * LANES));
            g += count;
        }
        let wholes: Vec<Whole> =
            parts.into_par_iter().map(|part| simd::run(UpdateChunk { part, fixed: &fixed, evidence })).collect();
        let mut whole = Whole { activations: vec![0.0; evidence.active.len()], ..Whole::default() };
        for part in &wholes {
            whole.add(part);
        }
        whole
    }
}

struct Cuts<'a> {
    base: &'a mut [f32],
    first: &'a mut [f32],
    second: &'a mut [f32],
    deltas: &'a mut [f32],
    delta_first: &'a mut [f32],
    delta_second: &'a mut [f32],
    movement: &'a mut [f32],
}

/// The first `len` numbers, which are taken off.
#[allow(clippy::mut_mut, reason = "what is left of a slice is put back")]
fn cut<'a>(from: &mut &'a mut [f32], len: usize) -> &'a mut [f32] {
    from.split_off_mut(..len).unwrap_or_default()
}

impl<'a> Cuts<'a> {
    fn take(&mut self, first_group: usize, base: usize, deltas: usize, slots: usize) -> Part<'a> {
        Part {
            first_group,
            base: cut(&mut self.base, base),
            base_moments: [cut(&mut self.first, base), cut(&mut self.second, base)],
            deltas: cut(&mut self.deltas, deltas),
            delta_moments: [cut(&mut self.delta_first, deltas), cut(&mut self.delta_second, deltas)],
            movement: cut(&mut self.movement, slots),
        }
    }
}

/// What is only read.
struct Fixed<'a> {
    gates: &'a [f32],
    head_weight: &'a [f32],
    bases: usize,
    deformable: usize,
}

struct UpdateChunk<'a> {
    part: Part<'a>,
    fixed: &'a Fixed<'a>,
    evidence: &'a Evidence<'a>,
}

/// A group's own arrays.
struct Own<'a> {
    base: &'a mut [f32],
    first: &'a mut [f32],
    second: &'a mut [f32],
}

impl Task for UpdateChunk<'_> {
    type Output = Whole;
    #[inline(always)]
    fn run<S: Simd>(self) -> Whole {
        let Self { part, fixed, evidence } = self;
        let mut whole = Whole { activations: vec![0.0; evidence.active.len()], ..Whole::default() };
        let row = channel::COUNT * LANES;
        let delta_row = fixed.bases * DELTAS * LANES;
        let [first, second] = part.base_moments;
        let [delta_first, delta_second] = part.delta_moments;
        let groups = part.base.len() / row;
        for i in 0..groups {
            let g = part.first_group + i;
            let slots = g * LANES..(g + 1) * LANES;
            let count = &evidence.bins.count[slots.clone()];
            let mut seen = 0u16;
            for (lane, &c) in count.iter().enumerate() {
                seen |= u16::from(c > 0) << lane;
            }
            if seen == 0 {
                continue;
            }
            prefetch_sums::<S>(evidence, g + 2);
            let at = i * row..(i + 1) * row;
            let mut own =
                Own { base: &mut part.base[at.clone()], first: &mut first[at.clone()], second: &mut second[at] };
            let mut deltas = (g < fixed.deformable).then(|| {
                let at = i * delta_row..(i + 1) * delta_row;
                Own {
                    base: &mut part.deltas[at.clone()],
                    first: &mut delta_first[at.clone()],
                    second: &mut delta_second[at],
                }
            });
            let movement = &mut part.movement[i * LANES..(i + 1) * LANES];
            group::<S>(fixed, evidence, g, seen, &mut own, deltas.as_mut(), movement, &mut whole);
        }
        whole
    }
}

/// Fetches the sums of a group that comes later.
#[inline(always)]
fn prefetch_sums<S: Simd>(evidence: &Evidence<'_>, g: usize) {
    let bins = evidence.bins;
    let slots = g * LANES..(g + 1) * LANES;
    let (Some(first), Some(count)) = (bins.first.get(slots.clone()), bins.count.get(slots)) else { return };
    for (&first, &count) in first.iter().zip(count) {
        let from = first as usize;
        for &at in bins.position.get(from..from + (count as usize).min(4)).unwrap_or_default() {
            prefetch::<S, Line>(evidence.sums, at as usize);
        }
    }
}

#[allow(clippy::too_many_arguments, reason = "one group's arrays and where its sums go")]
#[inline(always)]
fn group<S: Simd>(
    fixed: &Fixed<'_>,
    evidence: &Evidence<'_>,
    g: usize,
    seen: u16,
    own: &mut Own<'_>,
    deltas: Option<&mut Own<'_>>,
    movement: &mut [f32],
    whole: &mut Whole,
) {
    let bins = evidence.bins;
    let slots = g * LANES..(g + 1) * LANES;
    let sums = gather::<S>(&bins.first[slots.clone()], &bins.count[slots], &bins.position, evidence.sums);
    let gates = if deltas.is_some() { &rows(fixed.gates)[g * REGIONS..(g + 1) * REGIONS] } else { &[] };
    let head = F::<S>::load(&rows(fixed.head_weight)[g]);
    let b = blend::<S>(own.base, deltas.as_ref().map(|d| &*d.base), gates, head, evidence.active);
    let geo = geometry(evidence.view, &b);
    let sh = &rows(own.base)[channel::SH1..channel::COUNT];
    let gradients: Gradients<S> = backward(evidence.view, &b, &geo, sh, &sums);
    // A gradient that is not finite moves nothing.
    let mut size = F::splat(0.0);
    for value in gradients.base {
        size += value.max(-value);
    }
    let finite = size.lt(F::splat(f32::MAX)).bits();
    whole.not_finite += (seen & !finite).count_ones() as usize;
    let seen = M::<S>::from_bits(seen & finite);
    let zero = F::splat(0.0);

    let rates = &evidence.rates;
    let distance = geo.t[2].max(zero);
    let mean = distance * rates.mean;
    let deep = mean * (distance * rates.depth).max(F::splat(1.0));
    let rate = |c: usize| match c {
        0 | 1 => mean,
        2 => deep,
        channel::LOG_SCALE..channel::QUATERNION => F::splat(rates.log_scale),
        channel::QUATERNION..channel::OPACITY => F::splat(rates.quaternion),
        channel::OPACITY => F::splat(rates.opacity),
        channel::COLOR..channel::SH1 => F::splat(rates.color),
        _ => F::splat(rates.sh1),
    };
    let correction = F::splat(evidence.base_correction);
    for c in 0..channel::COUNT {
        adam(own.base, own.first, own.second, c, seen, gradients.base[c], rate(c) * correction);
    }
    if let Some(d) = deltas {
        for (i, active) in evidence.active.iter().enumerate() {
            let gate = gate_of::<S>(gates, active.reach);
            let share = gate * active.value;
            let correction = F::splat(evidence.correction[i]);
            let mut along = zero;
            for c in 0..DELTAS {
                let (from, rate) = match c {
                    0 | 1 => (c, mean * rates.delta),
                    2 => (c, deep * rates.delta),
                    _ => (channel::COLOR + c - MEAN.len(), F::splat(rates.color)),
                };
                let at = active.basis * DELTAS + c;
                along = gradients.base[from].fma(F::load(&rows(d.base)[at]), along);
                adam(d.base, d.first, d.second, at, seen, gradients.base[from] * share, rate * correction);
            }
            whole.activations[i] += seen.select(along * gate, zero).sum();
        }
    }
    let [u, v] = gradients.pixel;
    let moved = seen.select(u.fma(u, v * v).sqrt(), zero) + F::load(&rows(movement)[0]);
    moved.store(&mut rows_mut(movement)[0]);
    if evidence.poses {
        poses(evidence.view, &b.head, &geo.t, &gradients, seen, whole);
    }
}

/// One step of Adam on channel `c` of the lanes in `seen`.
#[inline(always)]
fn adam<S: Simd>(
    values: &mut [f32],
    first: &mut [f32],
    second: &mut [f32],
    c: usize,
    seen: M<S>,
    gradient: F<S>,
    rate: F<S>,
) {
    let (value, first, second) = (&mut rows_mut(values)[c], &mut rows_mut(first)[c], &mut rows_mut(second)[c]);
    let (p, m, v) = (F::<S>::load(value), F::load(first), F::load(second));
    let m_next = m.fma(F::splat(BETA[0]), gradient * (1.0 - BETA[0]));
    let v_next = v.fma(F::splat(BETA[1]), gradient * gradient * (1.0 - BETA[1]));
    let step = rate * m_next * (v_next.sqrt() + F::splat(EPSILON)).reciprocal();
    seen.select(p - step, p).store(value);
    seen.select(m_next, m).store(first);
    seen.select(v_next, v).store(second);
}

/// Gradients of the poses, in camera axes.
#[inline(always)]
fn poses<S: Simd>(view: &View, head: &F<S>, t: &[F<S>; 3], g: &Gradients<S>, seen: M<S>, whole: &mut Whole) {
    let zero = F::<S>::splat(0.0);
    let cross = |a: &[F<S>; 3], b: &[F<S>; 3]| {
        [a[2].fnma(b[1], a[1] * b[2]), a[0].fnma(b[2], a[2] * b[0]), a[1].fnma(b[0], a[0] * b[1])]
    };
    let turned = cross(t, &g.t);
    // The head turns about the room's origin.
    let mut arm = *t;
    for c in 0..3 {
        arm[c] = t[c] - F::splat(view.room.translation[c]);
    }
    let about = cross(&arm, &g.t);
    for c in 0..3 {
        whole.camera[c] += seen.select(g.t[c], zero).sum();
        whole.camera[3 + c] += seen.select(turned[c] + g.turn[c], zero).sum();
        whole.head[c] += seen.select(*head * g.t[c], zero).sum();
        whole.head[3 + c] += seen.select(*head * (about[c] + g.turn[c]), zero).sum();
    }
}
