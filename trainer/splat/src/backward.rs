//! From the nine sums of an entry back to the parameters of a group of Gaussians.
//!
//! The chain of [`crate::project`] in reverse; matrices are those of the usual derivation (3D Gaussian splatting, EWA):
//! `G₂ = ½ K S K` from the second moments S, the compensated opacity's part `½ S₀ (Σ₀⁻¹ − K)`, then through
//! `Σ₀ = p pᵀ`, `p = J N M`, `M = R diag(s)`.

use crate::bin::Line;
use crate::model::channel;
use crate::project::{Blended, Geometry, LEAST_RATIO, LOW_PASS, MOST_OPACITY, SH_C1, direction};
use crate::simd::{F, Row, Simd, transpose};
use crate::view::View;

/// Gradients of a group.
#[derive(Clone, Copy)]
pub(crate) struct Gradients<S: Simd> {
    /// Of every base channel, see [`channel`].
    pub base: [F<S>; channel::COUNT],
    /// Of the camera coordinates.
    pub t: [F<S>; 3],
    /// Of a rotation of the camera (camera axes, about its centre), through the covariance alone.
    pub turn: [F<S>; 3],
    /// Of the pixel position, px⁻¹: what densification goes by.
    pub pixel: [F<S>; 2],
}

/// Adds up the lines of each lane's pairs.
#[inline(always)]
pub(crate) fn gather<S: Simd>(first: &[u32], count: &[u32], position: &[u32], sums: &[Line]) -> [F<S>; 16] {
    let mut lanes = [F::<S>::splat(0.0); 16];
    for (lane, out) in lanes.iter_mut().enumerate() {
        let from = first[lane] as usize;
        let mut total = F::<S>::splat(0.0);
        // A slot that is not in the picture keeps an old first pair, but has none.
        for &at in position.get(from..from + count[lane] as usize).unwrap_or_default() {
            total += F::load(&sums[at as usize].0);
        }
        *out = total;
    }
    transpose(&mut lanes);
    lanes
}

/// Gradients of the base channels of a group.
#[inline(always)]
pub(crate) fn backward<S: Simd>(
    view: &View,
    b: &Blended<S>,
    geo: &Geometry<S>,
    sh: &[Row],
    sums: &[F<S>; 16],
) -> Gradients<S> {
    let zero = F::<S>::splat(0.0);
    let half = F::splat(0.5);
    let one = F::splat(1.0);
    let dot = |a: &[F<S>; 3], b: &[F<S>; 3]| a[0].fma(b[0], a[1].fma(b[1], a[2] * b[2]));
    let low = F::splat(LOW_PASS);
    let [a0, off, c0] = geo.covariance;
    let inverse = one.over(geo.det);
    let conic = [(c0 + low) * inverse, -off * inverse, (a0 + low) * inverse];
    let d_u = conic[0].fma(sums[1], conic[1] * sums[2]);
    let d_v = conic[1].fma(sums[1], conic[2] * sums[2]);
    // K S K / 2
    let ks = [
        conic[0].fma(sums[3], conic[1] * sums[4]),
        conic[0].fma(sums[4], conic[1] * sums[5]),
        conic[1].fma(sums[3], conic[2] * sums[4]),
        conic[1].fma(sums[4], conic[2] * sums[5]),
    ];
    let mut g2 = [
        ks[0].fma(conic[0], ks[1] * conic[1]) * half,
        ks[0].fma(conic[1], ks[1] * conic[2]) * half,
        ks[2].fma(conic[1], ks[3] * conic[2]) * half,
    ];
    // Where the low-pass' share was cut at its least, the compensation has no slope.
    let counts = F::splat(LEAST_RATIO * 1.000_01).lt(geo.ratio);
    // Where the opacity was cut at its most, it has none either.
    let free = (geo.opacity * geo.ratio.sqrt()).lt(F::splat(MOST_OPACITY));
    let opaque = free.select(sums[0], zero);
    let share = counts.select(opaque * half, zero);
    let inverse0 = one.over(geo.det0.max(F::splat(1e-30)));
    g2[0] = share.fma(counts.select(c0 * inverse0, zero) - conic[0], g2[0]);
    g2[1] = share.fma(counts.select(-off * inverse0, zero) - conic[1], g2[1]);
    g2[2] = share.fma(counts.select(a0 * inverse0, zero) - conic[2], g2[2]);
    // Through p pᵀ.
    let two = F::splat(2.0);
    let mut g_p = [[zero; 3]; 2];
    for k in 0..3 {
        g_p[0][k] = g2[0].fma(geo.p[0][k], g2[1] * geo.p[1][k]) * two;
        g_p[1][k] = g2[1].fma(geo.p[0][k], g2[2] * geo.p[1][k]) * two;
    }
    let (mut g_t_rows, mut g_m) = ([[zero; 3]; 2], [zero; 9]);
    for i in 0..2 {
        for c in 0..3 {
            let m = [geo.m[3 * c], geo.m[3 * c + 1], geo.m[3 * c + 2]];
            g_t_rows[i][c] = dot(&g_p[i], &m);
        }
    }
    for c in 0..3 {
        for k in 0..3 {
            g_m[3 * c + k] = geo.t_rows[0][c].fma(g_p[0][k], geo.t_rows[1][c] * g_p[1][k]);
        }
    }
    let mut base = [zero; channel::COUNT];
    scale_and_rotation(geo, &g_m, &mut base);
    // Through the slope of the projection.
    let j = &geo.lens;
    let mut g_n = [[zero; 3]; 2];
    for c in 0..3 {
        g_n[0][c] = j[0].fma(g_t_rows[0][c], j[2] * g_t_rows[1][c]);
        g_n[1][c] = j[1].fma(g_t_rows[0][c], j[3] * g_t_rows[1][c]);
    }
    let w2 = [geo.w[6], geo.w[7], geo.w[8]];
    let zi = geo.z_inverse;
    let (x, y) = (geo.t[0] * zi, geo.t[1] * zi);
    let through =
        [geo.free[0].select(-dot(&g_n[0], &w2) * zi, zero), geo.free[1].select(-dot(&g_n[1], &w2) * zi, zero)];
    let d_x = j[0].fma(d_u, j[2].fma(d_v, through[0]));
    let d_y = j[1].fma(d_u, j[3].fma(d_v, through[1]));
    let along = dot(&g_n[0], &geo.n[0]) + dot(&g_n[1], &geo.n[1]);
    let t = [d_x * zi, d_y * zi, -(d_x.fma(x, d_y.fma(y, along)) * zi)];
    for c in 0..3 {
        base[c] = geo.w[c].fma(t[0], geo.w[3 + c].fma(t[1], geo.w[6 + c] * t[2]));
    }
    // Colour and the direction it is seen from.
    let (d, distance_inverse) = direction(view, b);
    let rgb = [sums[6], sums[7], sums[8]];
    let (sy, sz, sx) = (-d[1] * SH_C1, d[2] * SH_C1, -d[0] * SH_C1);
    let mut g_d = [zero; 3];
    for c in 0..3 {
        base[channel::COLOR + c] = rgb[c];
        base[channel::SH1 + c] = rgb[c] * sy;
        base[channel::SH1 + 3 + c] = rgb[c] * sz;
        base[channel::SH1 + 6 + c] = rgb[c] * sx;
        g_d[1] = rgb[c].fnma(F::load(&sh[c]), g_d[1]);
        g_d[2] = rgb[c].fma(F::load(&sh[3 + c]), g_d[2]);
        g_d[0] = rgb[c].fnma(F::load(&sh[6 + c]), g_d[0]);
    }
    let along = dot(&g_d, &d);
    for c in 0..3 {
        base[c] = (d[c].fnma(along, g_d[c]) * distance_inverse).fma(F::splat(SH_C1), base[c]);
    }
    base[channel::OPACITY] = opaque * (one - geo.opacity);
    Gradients { base, t, turn: turn(geo, &g_n), pixel: [d_u, d_v] }
}

/// Log scales and raw quaternion.
#[inline(always)]
fn scale_and_rotation<S: Simd>(geo: &Geometry<S>, g_m: &[F<S>; 9], base: &mut [F<S>; channel::COUNT]) {
    let mut g = [g_m[0]; 9];
    for k in 0..3 {
        base[channel::LOG_SCALE + k] = g_m[k].fma(geo.m[k], g_m[3 + k].fma(geo.m[3 + k], g_m[6 + k] * geo.m[6 + k]));
        for r in 0..3 {
            g[3 * r + k] = g_m[3 * r + k] * geo.scale[k];
        }
    }
    let [w, x, y, z] = geo.q;
    let [g00, g01, g02, g10, g11, g12, g20, g21, g22] = g;
    let two = F::<S>::splat(2.0);
    let v = [
        x.fma(g21 - g12, y.fma(g02 - g20, z * (g10 - g01))) * two,
        y.fma(g01 + g10, z.fma(g02 + g20, w.fma(g21 - g12, -(x + x) * (g11 + g22)))) * two,
        x.fma(g01 + g10, z.fma(g12 + g21, w.fma(g02 - g20, -(y + y) * (g00 + g22)))) * two,
        x.fma(g02 + g20, y.fma(g12 + g21, w.fma(g10 - g01, -(z + z) * (g00 + g11)))) * two,
    ];
    let along = w.fma(v[0], x.fma(v[1], y.fma(v[2], z * v[3])));
    for i in 0..4 {
        base[channel::QUATERNION + i] = geo.q[i].fnma(along, v[i]) * geo.q_length_inverse;
    }
}

/// What a turn of the camera does through the covariance: the axial part of G_W Wᵀ.
#[inline(always)]
fn turn<S: Simd>(geo: &Geometry<S>, g_n: &[[F<S>; 3]; 2]) -> [F<S>; 3] {
    let zero = F::<S>::splat(0.0);
    let (mut g_w, mut w) = ([[zero; 3]; 3], [[zero; 3]; 3]);
    for c in 0..3 {
        g_w[0][c] = g_n[0][c] * geo.z_inverse;
        g_w[1][c] = g_n[1][c] * geo.z_inverse;
        g_w[2][c] = -(geo.slope[0].fma(g_w[0][c], geo.slope[1] * g_w[1][c]));
        for r in 0..3 {
            w[r][c] = geo.w[3 * r + c];
        }
    }
    let dot = |a: &[F<S>; 3], b: &[F<S>; 3]| a[0].fma(b[0], a[1].fma(b[1], a[2] * b[2]));
    [
        dot(&g_w[2], &w[1]) - dot(&g_w[1], &w[2]),
        dot(&g_w[0], &w[2]) - dot(&g_w[2], &w[0]),
        dot(&g_w[1], &w[0]) - dot(&g_w[0], &w[1]),
    ]
}
