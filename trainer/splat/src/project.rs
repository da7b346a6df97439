//! Blending of AU deltas and projection of groups of Gaussians, forward.
//!
//! Equations: `θ(a)` of [`crate::model`]; EWA splatting with an antialiasing low-pass of 0.1 px² and compensated opacity
//! (Mip-Splatting); J is the slope of the lens, distortion included. One vector is one channel of a group.

use crate::model::{DELTAS, Gaussians, LANES, REGIONS, channel};
use crate::simd::{F, M, Row, Simd, exp2, log2, rows, transpose};
use crate::view::{NEAR_M, View};

/// Added to the 2D covariance, px².
pub(crate) const LOW_PASS: f32 = 0.1;
/// Least share of the opacity that the low-pass leaves, squared.
pub(crate) const LEAST_RATIO: f32 = 1e-5;
/// Greatest opacity of a Gaussian, after the low-pass.
pub(crate) const MOST_OPACITY: f32 = 0.99;
/// log2 of it.
const LOG2_MOST: f32 = -0.014_499_57;
/// First constant of the spherical harmonics of degree 1.
pub(crate) const SH_C1: f32 = 0.488_602_52;
/// Half of log2 e, and log2 e.
const HALF_LOG2_E: f32 = 0.5 * std::f32::consts::LOG2_E;
pub(crate) const LOG2_E: f32 = std::f32::consts::LOG2_E;
/// ln 255: below an opacity of 1/255 nothing is drawn.
const LN_255: f32 = 5.541_263_5;

/// An activation that acts: which basis, how much.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Active {
    pub basis: usize,
    /// Regions whose gates let it act, see [`crate::Layout::reach`].
    pub reach: u8,
    pub value: f32,
}

/// The activations that are not negligible; with `all`, those too, with the value 0.
pub(crate) fn active_bases(layout: &crate::Layout, activations: &[f32], all: bool) -> Vec<Active> {
    let aus = layout.region_of.len();
    let mut list: Vec<Active> = activations
        .iter()
        .take(layout.bases())
        .enumerate()
        .map(|(k, &a)| (k, if k < aus && a <= LEAST_ACTIVATION { 0.0 } else { a }))
        .filter(|(_, a)| all || *a != 0.0)
        .map(|(basis, value)| Active { basis, reach: layout.reach(basis), value })
        .collect();
    list.sort_by_key(|a| a.reach);
    list
}

/// How much of an AU with this reach acts on the Gaussians of a group with these gates: the most that one of its regions lets.
#[inline(always)]
pub(crate) fn gate_of<S: Simd>(gates: &[Row], reach: u8) -> F<S> {
    if reach == 0 {
        return F::splat(1.0);
    }
    let mut most = F::splat(0.0);
    for (region, gate) in gates.iter().enumerate() {
        if reach >> region & 1 != 0 {
            most = most.max(F::load(gate));
        }
    }
    most
}

/// Activations up to this are noise of the table.
pub(crate) const LEAST_ACTIVATION: f32 = 0.02;

/// The numbers of a group after blending.
#[derive(Clone, Copy)]
pub(crate) struct Blended<S: Simd> {
    pub mean: [F<S>; 3],
    pub log_scale: [F<S>; 3],
    pub quaternion: [F<S>; 4],
    pub opacity: F<S>,
    pub color: [F<S>; 3],
    pub head: F<S>,
}

/// The numbers of one group (its base rows, its deltas and gates where it has some) with its deltas added.
#[inline(always)]
pub(crate) fn blend<S: Simd>(
    base: &[f32],
    deltas: Option<&[f32]>,
    gates: &[Row],
    head: F<S>,
    active: &[Active],
) -> Blended<S> {
    let base = rows(base);
    let l = |c: usize| F::<S>::load(&base[c]);
    let mut out = Blended {
        mean: [l(0), l(1), l(2)],
        log_scale: [l(3), l(4), l(5)],
        quaternion: [l(6), l(7), l(8), l(9)],
        opacity: l(10),
        color: [l(11), l(12), l(13)],
        head,
    };
    let Some(deltas) = deltas.map(rows) else { return out };
    let mut i = 0;
    while i < active.len() {
        let reach = active[i].reach;
        let mut sum = [F::<S>::splat(0.0); DELTAS];
        while i < active.len() && active[i].reach == reach {
            let a = F::splat(active[i].value);
            let d = &deltas[active[i].basis * DELTAS..(active[i].basis + 1) * DELTAS];
            for c in 0..DELTAS {
                sum[c] = a.fma(F::load(&d[c]), sum[c]);
            }
            i += 1;
        }
        let gate = gate_of::<S>(gates, reach);
        for c in 0..3 {
            out.mean[c] = gate.fma(sum[c], out.mean[c]);
            out.color[c] = gate.fma(sum[3 + c], out.color[c]);
        }
    }
    out
}

/// [`blend`] of group `g`.
#[inline(always)]
pub(crate) fn blend_group<S: Simd>(model: &Gaussians, active: &[Active], g: usize) -> Blended<S> {
    const ROW: usize = channel::COUNT * LANES;
    let row = model.layout.bases() * DELTAS * LANES;
    let deforms = g < model.deformable && !active.is_empty();
    blend(
        &model.base[g * ROW..(g + 1) * ROW],
        deforms.then(|| &model.deltas[g * row..(g + 1) * row]),
        if deforms { &rows(&model.gates)[g * REGIONS..(g + 1) * REGIONS] } else { &[] },
        F::load(&rows(&model.head_weight)[g]),
        active,
    )
}

/// Everything between the parameters of a group and its 2D Gaussians.
#[derive(Clone, Copy)]
pub(crate) struct Geometry<S: Simd> {
    /// Rows of the rotation into the camera, blended between room and head.
    pub w: [F<S>; 9],
    /// Camera coordinates.
    pub t: [F<S>; 3],
    /// The head's part of them: position in camera space as head-bound.
    pub z_inverse: F<S>,
    /// x/z, y/z as the slope sees them (clamped), and whether each was clamped.
    pub slope: [F<S>; 2],
    pub free: [M<S>; 2],
    /// ∂(u, v)/∂(x/z, y/z), rows.
    pub lens: [F<S>; 4],
    /// The rows of ∂(x/z, y/z)/∂p.
    pub n: [[F<S>; 3]; 2],
    pub scale: [F<S>; 3],
    pub q_length_inverse: F<S>,
    pub q: [F<S>; 4],
    /// R · diag(s), columns k: m[3r + k].
    pub m: [F<S>; 9],
    /// Rows of lens · n · m: the 2D Gaussian is p · pᵀ.
    pub p: [[F<S>; 3]; 2],
    pub t_rows: [[F<S>; 3]; 2],
    /// Covariance before the low-pass.
    pub covariance: [F<S>; 3],
    pub det0: F<S>,
    pub det: F<S>,
    pub ratio: F<S>,
    pub pixel: [F<S>; 2],
    pub opacity: F<S>,
    pub inside: M<S>,
}

/// Projects a blended group.
#[inline(always)]
pub(crate) fn geometry<S: Simd>(view: &View, b: &Blended<S>) -> Geometry<S> {
    let one = F::<S>::splat(1.0);
    let (room, head) = (&view.room, &view.head);
    let mix = |a: f32, c: f32| b.head.fma(F::splat(c - a), F::splat(a));
    let mut w = [one; 9];
    for i in 0..9 {
        w[i] = mix(room.rotation[i], head.rotation[i]);
    }
    let mut t = [one; 3];
    for r in 0..3 {
        let translation = mix(room.translation[r], head.translation[r]);
        t[r] = w[3 * r].fma(b.mean[0], w[3 * r + 1].fma(b.mean[1], w[3 * r + 2].fma(b.mean[2], translation)));
    }
    let z_inverse = one.over(t[2]);
    let (x, y) = (t[0] * z_inverse, t[1] * z_inverse);
    let lens = &view.lens;
    let [x0, x1, y0, y1] = lens.slope_limits.map(F::<S>::splat);
    let free = [x0.lt(x).and(x.lt(x1)), y0.lt(y).and(y.lt(y1))];
    let slope = [x.max(x0).min(x1), y.max(y0).min(y1)];
    let [fx, fy] = lens.focal.map(F::<S>::splat);
    let skew = F::<S>::splat(lens.skew);
    let zero = F::<S>::splat(0.0);
    let (mut jacobian, mut distorted) = ([fx, skew, zero, fy], [x, y]);
    let mut inside = F::splat(NEAR_M).lt(t[2]);
    if let Some(coefficients) = &lens.distortion {
        let (d, at) = distort::<S>(coefficients, x, y);
        distorted = at;
        jacobian = [fx.fma(d[0], skew * d[2]), fx.fma(d[1], skew * d[3]), fy * d[2], fy * d[3]];
        inside = inside.and(x.fma(x, y * y).lt(F::splat(lens.largest_r2)));
    }
    let pixel = [
        fx.fma(distorted[0], skew.fma(distorted[1], F::splat(lens.middle[0]))),
        fy.fma(distorted[1], F::splat(lens.middle[1])),
    ];
    // Quaternion to rotation; one that is (nearly) zero belongs to no Gaussian.
    let [qw, qx, qy, qz] = b.quaternion;
    let length2 = qw.fma(qw, qx.fma(qx, qy.fma(qy, qz * qz)));
    inside = inside.and(F::splat(1e-8).lt(length2));
    let q_length_inverse = one.over(length2.max(F::splat(1e-20)).sqrt());
    let q = [qw * q_length_inverse, qx * q_length_inverse, qy * q_length_inverse, qz * q_length_inverse];
    let rotation = rotation_of(q);
    let mut scale = [one; 3];
    for k in 0..3 {
        scale[k] = exp2(b.log_scale[k] * LOG2_E);
    }
    let mut m = [one; 9];
    for r in 0..3 {
        for k in 0..3 {
            m[3 * r + k] = rotation[3 * r + k] * scale[k];
        }
    }
    let (mut n, mut t_rows, mut p) = ([[one; 3]; 2], [[one; 3]; 2], [[one; 3]; 2]);
    for i in 0..2 {
        for c in 0..3 {
            n[i][c] = slope[i].fnma(w[6 + c], w[3 * i + c]) * z_inverse;
        }
    }
    for i in 0..2 {
        for c in 0..3 {
            t_rows[i][c] = jacobian[2 * i].fma(n[0][c], jacobian[2 * i + 1] * n[1][c]);
        }
        for k in 0..3 {
            p[i][k] = t_rows[i][0].fma(m[k], t_rows[i][1].fma(m[3 + k], t_rows[i][2] * m[6 + k]));
        }
    }
    let dot = |a: &[F<S>; 3], b: &[F<S>; 3]| a[0].fma(b[0], a[1].fma(b[1], a[2] * b[2]));
    let covariance = [dot(&p[0], &p[0]), dot(&p[0], &p[1]), dot(&p[1], &p[1])];
    let low = F::splat(LOW_PASS);
    // det(p pᵀ) as the sum of squared minors (Cauchy–Binet): no cancellation for needles.
    let minor = |i: usize, j: usize| p[0][j].fnma(p[1][i], p[0][i] * p[1][j]);
    let minors = [minor(0, 1), minor(0, 2), minor(1, 2)];
    let det0 = dot(&minors, &minors);
    let det = low.fma(covariance[0] + covariance[2] + low, det0);
    let ratio = det0.over(det).max(F::splat(LEAST_RATIO));
    let opacity = one.over(one + exp2(-b.opacity * LOG2_E));
    Geometry {
        w,
        t,
        z_inverse,
        slope,
        free,
        lens: jacobian,
        n,
        scale,
        q_length_inverse,
        q,
        m,
        p,
        t_rows,
        covariance,
        det0,
        det,
        ratio,
        pixel,
        opacity,
        inside,
    }
}

/// Rows of the rotation of a unit quaternion (w, x, y, z).
#[inline(always)]
fn rotation_of<S: Simd>([w, x, y, z]: [F<S>; 4]) -> [F<S>; 9] {
    let one = F::<S>::splat(1.0);
    let (x2, y2, z2) = (x + x, y + y, z + z);
    let (xx, yy, zz) = (x * x2, y * y2, z * z2);
    let (xy, xz, yz) = (x * y2, x * z2, y * z2);
    let (wx, wy, wz) = (w * x2, w * y2, w * z2);
    [one - yy - zz, xy - wz, xz + wy, xy + wz, one - xx - zz, yz - wx, xz - wy, yz + wx, one - xx - yy]
}

/// OpenCV's lens model: its slope (rows) and the distorted coordinates. See [`risorius_formats::camera`].
#[inline(always)]
fn distort<S: Simd>(coefficients: &[f32; 8], x: F<S>, y: F<S>) -> ([F<S>; 4], [F<S>; 2]) {
    let [k1, k2, k3, k4, k5, k6, p1, p2] = coefficients.map(F::<S>::splat);
    let one = F::<S>::splat(1.0);
    let r2 = x.fma(x, y * y);
    let up = r2.fma(r2.fma(r2.fma(k3, k2), k1), one);
    let down = r2.fma(r2.fma(r2.fma(k6, k5), k4), one);
    let inverse = one.over(down);
    let d = up * inverse;
    let slope_up = r2.fma(r2.fma(k3 * 3.0, k2 + k2), k1);
    let slope_down = r2.fma(r2.fma(k6 * 3.0, k5 + k5), k4);
    // ∂d/∂(r²), doubled for r² = x² + y².
    let dd = d.fnma(slope_down, slope_up) * inverse * 2.0;
    let (dx, dy) = (x * dd, y * dd);
    let xy = x * y;
    let (xx, yy) = (x * x, y * y);
    let px = x.fma(d, (p1 + p1).fma(xy, p2 * (r2 + xx + xx)));
    let py = y.fma(d, (p2 + p2).fma(xy, p1 * (r2 + yy + yy)));
    let slopes = [
        d + x.fma(dx, (p1 + p1).fma(y, p2 * x * 6.0)),
        x.fma(dy, (p2 + p2).fma(y, (p1 + p1) * x)),
        y.fma(dx, (p2 + p2).fma(y, (p1 + p1) * x)),
        d + y.fma(dy, (p2 + p2).fma(x, p1 * y * 6.0)),
    ];
    (slopes, [px, py])
}

/// Unit direction from the camera to each mean, in the frame the mean lives in, and one over the distance.
#[inline(always)]
pub(crate) fn direction<S: Simd>(view: &View, b: &Blended<S>) -> ([F<S>; 3], F<S>) {
    let mut d = [b.head; 3];
    for c in 0..3 {
        let (room, head) = (view.room.center[c], view.head.center[c]);
        d[c] = b.mean[c] - b.head.fma(F::splat(head - room), F::splat(room));
    }
    let length2 = d[0].fma(d[0], d[1].fma(d[1], d[2] * d[2])).max(F::splat(1e-20));
    let inverse = F::splat(1.0).over(length2.sqrt());
    ([d[0] * inverse, d[1] * inverse, d[2] * inverse], inverse)
}

/// The colour seen along `d` (spherical harmonics of degree 1, 3DGS' signs).
#[inline(always)]
pub(crate) fn shade<S: Simd>(color: [F<S>; 3], sh: &[Row], d: [F<S>; 3]) -> [F<S>; 3] {
    let (y, z, x) = (-d[1] * SH_C1, d[2] * SH_C1, -d[0] * SH_C1);
    let mut out = color;
    for c in 0..3 {
        out[c] = y.fma(F::load(&sh[c]), z.fma(F::load(&sh[3 + c]), x.fma(F::load(&sh[6 + c]), color[c])));
    }
    out
}

/// Columns of a record: what rasteriser and binning know of a Gaussian in a picture.
pub(crate) mod record {
    pub(crate) const U: usize = 0;
    pub(crate) const V: usize = 1;
    /// −½ log2 e times the conic's first entry, −log2 e times its second, −½ log2 e times its third.
    pub(crate) const CONIC: usize = 2;
    /// log2 of the compensated opacity.
    pub(crate) const LOG2_OPACITY: usize = 5;
    pub(crate) const RGB: usize = 6;
    pub(crate) const DEPTH: usize = 9;
    /// First and last column of blocks inside the picture that the level 1/255 reaches, packed: first + [`PACK`] · last.
    pub(crate) const COLUMNS: usize = 10;
    /// The same of rows.
    pub(crate) const ROWS: usize = 11;
    /// More than the blocks along the longest side there may be, see [`crate::view::MOST_SIDE`].
    pub(crate) const PACK: f32 = 4096.0;
    /// x of the ellipse's chord per y; y of its rightmost point; square of the chord's half length at 0, its loss per y².
    pub(crate) const SLOPE: usize = 12;
    pub(crate) const Y_RIGHT: usize = 13;
    pub(crate) const CHORD: usize = 14;
}

/// Projects group `g` into 16 records; a bit for each Gaussian that may touch the picture.
#[inline(always)]
pub(crate) fn project_group<S: Simd>(
    model: &Gaussians,
    view: &View,
    active: &[Active],
    g: usize,
    records: &mut [Row],
) -> u16 {
    let b = blend_group::<S>(model, active, g);
    let geo = geometry(view, &b);
    let one = F::<S>::splat(1.0);
    let log2_opacity = log2((geo.opacity * geo.ratio.sqrt()).max(F::splat(1e-30))).min(F::splat(LOG2_MOST));
    // P = ln(255 o′); the level of 1/255 is where the squared Mahalanobis distance is 2 P.
    let level = (log2_opacity.fma(F::splat(std::f32::consts::LN_2), F::splat(LN_255))) * 2.0;
    let low = F::splat(LOW_PASS);
    let (a, c, off) = (geo.covariance[0] + low, geo.covariance[2] + low, geo.covariance[1]);
    let half = [(level * a).max(F::splat(0.0)).sqrt(), (level * c).max(F::splat(0.0)).sqrt()];
    let [u, v] = geo.pixel;
    let (zero, half_block) = (F::splat(0.0), F::splat(0.5));
    let visible = geo
        .inside
        .and(zero.lt(level))
        .and(zero.lt(u + half[0]))
        .and(zero.lt(v + half[1]))
        .and((u - half[0]).lt(F::splat(view.width as f32)))
        .and((v - half[1]).lt(F::splat(view.height as f32)));
    // Blocks of 4×4 pixels with a pixel's centre inside the ellipse's box, and how many blocks there are.
    let quarter = F::splat(0.25);
    let first = |middle: F<S>, half: F<S>| {
        let p = (middle - half - F::splat(3.5)) * quarter;
        (-(-p).floor()).max(zero)
    };
    let last = |middle: F<S>, half: F<S>, size: usize| {
        let p = (middle + half - F::splat(0.5)) * quarter;
        p.floor().min(F::splat(size.div_ceil(4) as f32 - 1.0))
    };
    let (x0, x1) = (first(u, half[0]), last(u, half[0], view.width));
    let (y0, y1) = (first(v, half[1]), last(v, half[1], view.height));
    let bits = visible.and((x0 - x1).lt(half_block)).and((y0 - y1).lt(half_block)).bits();
    if bits == 0 {
        return 0;
    }
    let sh = &rows(&model.base)[g * channel::COUNT + channel::SH1..(g + 1) * channel::COUNT];
    let rgb = shade(b.color, sh, direction(view, &b).0);
    let inverse = one.over(geo.det);
    let c_inverse = one.over(c);
    let slope = off * c_inverse;
    let across = geo.det * c_inverse;
    let mut columns = [
        u,
        v,
        (c * inverse * -HALF_LOG2_E),
        (off * inverse * LOG2_E),
        (a * inverse * -HALF_LOG2_E),
        log2_opacity,
        rgb[0],
        rgb[1],
        rgb[2],
        geo.t[2],
        x1.fma(F::splat(record::PACK), x0),
        y1.fma(F::splat(record::PACK), y0),
        slope,
        (off * (level.over(a)).max(zero).sqrt()),
        (level * across),
        (across * c_inverse),
    ];
    transpose(&mut columns);
    for (row, column) in records[..LANES].iter_mut().zip(columns) {
        column.store(row);
    }
    bits
}
