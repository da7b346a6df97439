//! From seeds to Gaussians: order, parameters, AU deltas of the face from the landmarks' motion.

use glam::{DMat3, DQuat, DVec3};

use crate::init::{LandmarkMotion, MouthSeeds, Seed};
use crate::model::{DELTAS, EMPTY, Gaussians, LANES, Layout, REGIONS, channel};

/// A landmark's weight at a distance d is (d² + this²)⁻², metres.
const NEAR_M: f64 = 0.004;
/// Its motion fades beyond this distance from the nearest landmark, metres.
const FADE_M: f64 = 0.03;
/// The landmarks of the chin.
const CHIN: [usize; 3] = [7, 8, 9];
/// An AU acts where more than this share of the masks hold the point, and fully from a quarter above.
const GATE_FROM: f32 = 0.05;

/// How much the AUs of a region act on a point that so large a share of its masks hold.
pub fn gate(share: f32) -> f32 {
    (4.0 * (share - GATE_FROM)).clamp(0.0, 1.0)
}

/// The logit of a probability.
pub(super) fn logit(p: f32) -> f32 {
    let p = p.clamp(1e-4, 1.0 - 1e-4);
    (p / (1.0 - p)).ln()
}

/// Leaves every so many seeds where there are more than `most`, each as much larger; whether it did.
pub(super) fn thin_out(seeds: &mut Vec<Seed>, most: usize) -> bool {
    let count = seeds.len();
    if count <= most.max(1) {
        return false;
    }
    let grow = (count as f32 / most.max(1) as f32).sqrt();
    let mut taken = 0;
    seeds.retain_mut(|seed| {
        let keep = (taken + 1) * most.max(1) / count > taken * most.max(1) / count;
        taken += 1;
        seed.sigma *= grow;
        keep
    });
    true
}

/// The order of seeds: deformable ones first, each part along a Morton curve, so that groups are compact.
pub(super) fn order(means: &[[f32; 3]], deformable: &[bool]) -> Vec<u32> {
    let mut keys: Vec<(bool, u64, u32)> =
        means.iter().zip(deformable).enumerate().map(|(i, (m, &d))| (!d, morton(*m), i as u32)).collect();
    keys.sort_unstable();
    keys.into_iter().map(|k| k.2).collect()
}

/// Interleaved bits of a point in steps of 2 mm.
fn morton(p: [f32; 3]) -> u64 {
    let spread = |v: f32| {
        let v = ((v / 0.002) as i64 + (1 << 20)).clamp(0, (1 << 21) - 1) as u64;
        (0..21).fold(0u64, |sum, b| sum | (v >> b & 1) << (3 * b))
    };
    spread(p[0]) | spread(p[1]) << 1 | spread(p[2]) << 2
}

/// An empty model with room for `deformable` and `rest` Gaussians.
pub(super) fn empty(layout: Layout, deformable: usize, rest: usize) -> Gaussians {
    let deformable_groups = deformable.div_ceil(LANES);
    let groups = deformable_groups + rest.div_ceil(LANES);
    let mut base = vec![0.0; groups * channel::COUNT * LANES];
    for g in 0..groups {
        for lane in 0..LANES {
            base[(g * channel::COUNT + channel::OPACITY) * LANES + lane] = EMPTY;
            base[(g * channel::COUNT + channel::QUATERNION) * LANES + lane] = 1.0;
            for c in 0..3 {
                base[(g * channel::COUNT + channel::LOG_SCALE + c) * LANES + lane] = -8.0;
            }
        }
    }
    let bases = layout.bases();
    Gaussians {
        layout,
        deformable: deformable_groups,
        base,
        deltas: vec![0.0; deformable_groups * bases * DELTAS * LANES],
        gates: vec![0.0; deformable_groups * REGIONS * LANES],
        membership: vec![-9.0; groups * REGIONS * LANES],
        head_weight: vec![0.0; groups * LANES],
    }
}

/// The slot that Gaussian number `i` of an order takes, where `deformable` of them come first.
pub(super) fn slot(i: usize, deformable: usize) -> usize {
    if i < deformable { i } else { deformable.next_multiple_of(LANES) + i - deformable }
}

/// Sets channel `c` of a slot.
pub(super) fn set(base: &mut [f32], slot: usize, c: usize, value: f32) {
    base[(slot / LANES * channel::COUNT + c) * LANES + slot % LANES] = value;
}

/// Gaussians of the seeds.
pub(super) fn model(
    layout: Layout,
    seeds: &[Seed],
    motion: Option<&LandmarkMotion>,
    mouth: Option<&MouthSeeds>,
) -> Gaussians {
    let means: Vec<[f32; 3]> = seeds.iter().map(|s| s.mean).collect();
    let flags: Vec<bool> = seeds.iter().map(|s| s.deformable).collect();
    let deformable = flags.iter().filter(|d| **d).count();
    let mut out = empty(layout, deformable, seeds.len() - deformable);
    for (i, &from) in order(&means, &flags).iter().enumerate() {
        let seed = &seeds[from as usize];
        let at = slot(i, deformable);
        let (g, lane) = (at / LANES, at % LANES);
        for c in 0..3 {
            set(&mut out.base, at, channel::MEAN + c, seed.mean[c]);
            set(&mut out.base, at, channel::COLOR + c, seed.color[c]);
        }
        let scales = [seed.sigma, seed.sigma, seed.thickness];
        for (k, s) in scales.iter().enumerate() {
            set(&mut out.base, at, channel::LOG_SCALE + k, s.max(1e-5).ln());
        }
        for (k, v) in rotation_to(seed.normal).into_iter().enumerate() {
            set(&mut out.base, at, channel::QUATERNION + k, v);
        }
        set(&mut out.base, at, channel::OPACITY, logit(seed.opacity));
        out.head_weight[at] = seed.head_weight;
        for n in 0..REGIONS {
            out.membership[(g * REGIONS + n) * LANES + lane] = logit(seed.regions[n].clamp(0.003, 0.997));
            if seed.deformable {
                out.gates[(g * REGIONS + n) * LANES + lane] = gate(seed.regions[n]);
            }
        }
        let Some(motion) = motion.filter(|_| seed.deformable) else { continue };
        match mouth.filter(|m| m.all().contains(&(from as usize))) {
            Some(m) if m.follows_jaw(from as usize) => deltas_of_jaw(&mut out, at, motion),
            // Upper teeth and what is behind them stay with the head.
            Some(_) => {}
            None => deltas_from_landmarks(&mut out, at, seed.mean, motion),
        }
    }
    out
}

/// The quaternion (w, x, y, z) that turns z to `normal`.
fn rotation_to(normal: [f32; 3]) -> [f32; 4] {
    let n = DVec3::from_array(normal.map(f64::from)).try_normalize().unwrap_or(DVec3::Z);
    let side = if n.x.abs() < 0.9 { DVec3::X } else { DVec3::Y };
    let x = (side - n * side.dot(n)).normalize();
    let q = DQuat::from_mat3(&DMat3::from_cols(x, n.cross(x), n));
    [q.w, q.x, q.y, q.z].map(|v| v as f32)
}

/// Deltas of the mean: the chin's motion, that of the jaw.
fn deltas_of_jaw(model: &mut Gaussians, at: usize, motion: &LandmarkMotion) {
    for (k, deltas) in motion.deltas.iter().enumerate().take(model.layout.region_of.len()) {
        for c in 0..3 {
            let mean = CHIN.map(|l| deltas[l][c]).iter().sum::<f64>() / CHIN.len() as f64;
            set_delta(model, at, k, c, mean);
        }
    }
}

/// Sets a delta of the mean; what is not finite is none.
fn set_delta(model: &mut Gaussians, at: usize, k: usize, c: usize, value: f64) {
    let row = (at / LANES * model.layout.bases() + k) * DELTAS + c;
    model.deltas[row * LANES + at % LANES] = if value.is_finite() { value as f32 } else { 0.0 };
}

/// Deltas of the mean: the landmarks' motion nearby, fading away from the face.
fn deltas_from_landmarks(model: &mut Gaussians, at: usize, mean: [f32; 3], motion: &LandmarkMotion) {
    let p = DVec3::from_array(mean.map(f64::from));
    let (mut weights, mut sum, mut nearest) = ([0.0f64; 68], 0.0, f64::INFINITY);
    for (w, x) in weights.iter_mut().zip(&motion.rest) {
        let d2 = (DVec3::from_array(*x) - p).length_squared();
        nearest = nearest.min(d2);
        *w = (d2 + NEAR_M * NEAR_M).powi(-2);
        sum += *w;
    }
    let fade = (-nearest / (FADE_M * FADE_M)).exp();
    for (k, deltas) in motion.deltas.iter().enumerate().take(model.layout.region_of.len()) {
        for c in 0..3 {
            let d: f64 = weights.iter().zip(deltas).map(|(w, d)| w * d[c]).sum();
            set_delta(model, at, k, c, d / sum * fade);
        }
    }
}
