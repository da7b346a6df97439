//! The field in f64, one Gaussian and one pixel after the other: the readable twin that the kernels are held to.
//!
//! Equations as in [`crate::project`] and [`crate::raster`], with the same cut-offs.

use glam::{DMat3, DQuat, DVec2, DVec3};
use risorius_formats::{Camera, Isometry};

use crate::model::{DELTAS, Gaussians, LANES, REGIONS, channel};
use crate::project::MOST_OPACITY;
use crate::scene::camera_from_head;

const LOW_PASS: f64 = 0.1;
const LEAST_RATIO: f64 = 1e-5;
const SH_C1: f64 = 0.488_602_511_902_919_9;

/// A Gaussian in a picture.
#[derive(Clone, Copy, Debug)]
pub struct Projected {
    /// Slot in the model.
    pub slot: usize,
    /// Middle, pixels.
    pub pixel: DVec2,
    /// Conic A, B, C: σ = ½ (A dx² + C dy²) + B dx dy.
    pub conic: [f64; 3],
    /// Compensated opacity.
    pub opacity: f64,
    /// Colour seen from the camera.
    pub color: [f64; 3],
    /// Depth, metres.
    pub depth: f64,
}

/// Base channel `c` of a slot.
pub fn value(model: &Gaussians, slot: usize, c: usize) -> f64 {
    f64::from(model.base[(slot / LANES * channel::COUNT + c) * LANES + slot % LANES])
}

/// Mean and colour of a slot with its deltas added: 6 numbers.
pub fn blended(model: &Gaussians, slot: usize, activations: &[f64]) -> [f64; DELTAS] {
    let (g, lane) = (slot / LANES, slot % LANES);
    let channels = [0, 1, 2, channel::COLOR, channel::COLOR + 1, channel::COLOR + 2];
    let mut out = channels.map(|c| value(model, slot, c));
    if g >= model.deformable {
        return out;
    }
    let layout = &model.layout;
    for (k, &a) in activations.iter().enumerate().take(layout.bases()) {
        let is_au = k < layout.region_of.len();
        if is_au && a <= f64::from(crate::project::LEAST_ACTIVATION) {
            continue;
        }
        let reach = layout.reach(k);
        let of_region = |r: usize| f64::from(model.gates[(g * REGIONS + r) * LANES + lane]);
        let gate = (0..REGIONS).filter(|r| reach >> r & 1 != 0).map(of_region).fold(0.0, f64::max);
        let gate = if is_au { gate } else { 1.0 };
        for (c, out) in out.iter_mut().enumerate() {
            *out += a * gate * f64::from(model.deltas[((g * layout.bases() + k) * DELTAS + c) * LANES + lane]);
        }
    }
    out
}

/// Projects one Gaussian; `None` where it cannot be seen at all.
pub fn project(
    model: &Gaussians,
    slot: usize,
    camera: &Camera,
    room_from_head: &Isometry,
    activations: &[f64],
) -> Option<Projected> {
    let v = |c: usize| value(model, slot, c);
    let [mx, my, mz, red, green, blue] = blended(model, slot, activations);
    let mean = DVec3::new(mx, my, mz);
    let h = f64::from(model.head_weight[slot]);
    let (room, head) = (camera.camera_from_world, camera_from_head(camera, room_from_head));
    let w = room.rotation * (1.0 - h) + head.rotation * h;
    let t = w * mean + room.translation * (1.0 - h) + head.translation * h;
    if t.z <= f64::from(crate::view::NEAR_M) {
        return None;
    }
    let i = &camera.intrinsics;
    let limits = |extent: f64, middle: f64, focal: f64| {
        let (low, high) = (-middle / focal, (extent - middle) / focal);
        ((low + high) * 0.5, (high - low).abs() * 0.65)
    };
    let clamp = |x: f64, (middle, half): (f64, f64)| x.clamp(middle - half, middle + half);
    let slope = DVec2::new(
        clamp(t.x / t.z, limits(f64::from(i.width), i.cx, i.fx)),
        clamp(t.y / t.z, limits(f64::from(i.height), i.cy, i.fy)),
    );
    // The lens' slope by central differences: the twin needs no formula of its own.
    let lens = |p: DVec2| {
        let d = i.distortion.distort(p);
        DVec2::new(i.fx * d.x + i.skew * d.y + i.cx, i.fy * d.y + i.cy)
    };
    let at = DVec2::new(t.x / t.z, t.y / t.z);
    let e = 1e-6;
    let dx = (lens(at + DVec2::X * e) - lens(at - DVec2::X * e)) / (2.0 * e);
    let dy = (lens(at + DVec2::Y * e) - lens(at - DVec2::Y * e)) / (2.0 * e);
    let row = |r: usize| w.row(r);
    let n = [(row(0) - row(2) * slope.x) / t.z, (row(1) - row(2) * slope.y) / t.z];
    let rows = [n[0] * dx.x + n[1] * dy.x, n[0] * dx.y + n[1] * dy.y];
    let q = DQuat::from_xyzw(v(7), v(8), v(9), v(6));
    if q.length_squared() <= 1e-8 {
        return None;
    }
    let m = DMat3::from_quat(q.normalize()) * DMat3::from_diagonal(DVec3::new(v(3).exp(), v(4).exp(), v(5).exp()));
    let p = rows.map(|r| m.transpose() * r);
    let (a0, b0, c0) = (p[0].dot(p[0]), p[0].dot(p[1]), p[1].dot(p[1]));
    let det0 = (a0 * c0 - b0 * b0).max(0.0);
    let (a, c) = (a0 + LOW_PASS, c0 + LOW_PASS);
    let det = a * c - b0 * b0;
    let ratio = (det0 / det).max(LEAST_RATIO);
    let opacity = (ratio.sqrt() / (1.0 + (-v(channel::OPACITY)).exp())).min(f64::from(MOST_OPACITY));
    let center = room.camera_center() * (1.0 - h) + head.camera_center() * h;
    let d = (mean - center).normalize_or_zero();
    let sh = |b: usize, c: usize| v(channel::SH1 + 3 * b + c);
    let mut color = [red, green, blue];
    for (c, color) in color.iter_mut().enumerate() {
        *color += SH_C1 * (-d.y * sh(0, c) + d.z * sh(1, c) - d.x * sh(2, c));
    }
    (opacity * 255.0 > 1.0).then(|| Projected {
        slot,
        pixel: lens(at),
        conic: [c / det, -b0 / det, a / det],
        opacity,
        color,
        depth: t.z,
    })
}

/// The visible Gaussians, nearest first (ties by slot).
pub fn project_all(
    model: &Gaussians,
    camera: &Camera,
    room_from_head: &Isometry,
    activations: &[f64],
) -> Vec<Projected> {
    let mut list: Vec<Projected> = (0..model.groups() * LANES)
        .filter_map(|slot| project(model, slot, camera, room_from_head, activations))
        .collect();
    list.sort_by(|a, b| a.depth.total_cmp(&b.depth));
    list
}

/// Colour and transmittance of one pixel.
pub fn composite(list: &[Projected], pixel: DVec2, backdrop: [f64; 3]) -> ([f64; 3], f64) {
    let (mut color, mut t) = ([0.0; 3], 1.0);
    for p in list {
        let d = pixel - p.pixel;
        let sigma = 0.5 * (p.conic[0] * d.x * d.x + p.conic[2] * d.y * d.y) + p.conic[1] * d.x * d.y;
        let alpha = p.opacity * (-sigma).exp();
        if alpha * 255.0 <= 1.0 {
            continue;
        }
        (0..3).for_each(|c| color[c] += t * alpha * p.color[c]);
        t *= 1.0 - alpha;
    }
    (std::array::from_fn(|c| color[c] + t * backdrop[c]), t)
}

/// A whole picture, row by row.
pub fn picture(
    model: &Gaussians,
    camera: &Camera,
    room_from_head: &Isometry,
    activations: &[f64],
    backdrop: [f64; 3],
) -> Vec<[f64; 3]> {
    let list = project_all(model, camera, room_from_head, activations);
    let (w, h) = (camera.intrinsics.width, camera.intrinsics.height);
    (0..h)
        .flat_map(|y| (0..w).map(move |x| DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)))
        .map(|p| composite(&list, p, backdrop).0)
        .collect()
}

/// The loss of a picture against bytes: Σ √(d² + 0.1²) over pixels and channels.
pub fn loss(picture: &[[f64; 3]], wanted: &[u8]) -> f64 {
    let charbonnier = f64::from(crate::raster::CHARBONNIER);
    picture
        .iter()
        .zip(wanted.chunks_exact(3))
        .flat_map(|(p, w)| (0..3).map(move |c| p[c] - f64::from(w[c]) / 255.0))
        .map(|d| d.hypot(charbonnier))
        .sum()
}

/// ∂L of what a pixel shows with regard to a projected Gaussian: u, v, A, B, C, opacity, red, green, blue.
pub type ProjectedGradient = [f64; 9];

/// Adds the gradient of one pixel, whose colour has the gradient `g`, to those of the Gaussians.
///
/// `∂C/∂α_i = T_i c_i − (what is behind i)/(1 − α_i)`, see `splats.md` §3; cut-offs pass nothing.
pub fn composite_backward(
    list: &[Projected],
    pixel: DVec2,
    backdrop: [f64; 3],
    g: [f64; 3],
    gradients: &mut [ProjectedGradient],
) {
    let (color, _) = composite(list, pixel, backdrop);
    let mut behind = color;
    let mut t = 1.0;
    for (p, out) in list.iter().zip(gradients) {
        let d = pixel - p.pixel;
        let [a, b, c] = p.conic;
        let sigma = 0.5 * (a * d.x * d.x + c * d.y * d.y) + b * d.x * d.y;
        let alpha = p.opacity * (-sigma).exp();
        if alpha * 255.0 <= 1.0 {
            continue;
        }
        let mut d_alpha = 0.0;
        for k in 0..3 {
            behind[k] -= t * alpha * p.color[k];
            d_alpha += g[k] * (t * p.color[k] - behind[k] / (1.0 - alpha));
            out[6 + k] += g[k] * t * alpha;
        }
        t *= 1.0 - alpha;
        let q = alpha * d_alpha;
        out[0] += q * (a * d.x + b * d.y);
        out[1] += q * (c * d.y + b * d.x);
        out[2] -= 0.5 * q * d.x * d.x;
        out[3] -= q * d.x * d.y;
        out[4] -= 0.5 * q * d.y * d.y;
        out[5] += q / p.opacity;
    }
}

impl Projected {
    /// The nine numbers that [`ProjectedGradient`] belongs to.
    pub fn numbers(&self) -> [f64; 9] {
        let [a, b, c] = self.conic;
        let [red, green, blue] = self.color;
        [self.pixel.x, self.pixel.y, a, b, c, self.opacity, red, green, blue]
    }
}
