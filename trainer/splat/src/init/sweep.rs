//! Plane sweep: the depth of each pixel of a reference view, from its neighbours.
//!
//! For planes uniform in 1/z, each neighbour is warped onto the reference: with h = K' R K⁻¹ (u, v, 1)ᵀ + K' t / z, its
//! pixel is (h₀/h₂, h₁/h₂). Cost: |ΔY| truncated, summed over 7×7 pixels; the mean of the two best neighbours counts
//! (occlusion); a parabola through the cheapest plane and its neighbours gives the fraction.
//!
//! Every operation is exact or rounded in one way, so the result is the same for all instruction sets and threads.

use glam::{DMat3, DVec3};
use risorius_formats::Isometry;

use super::view::View;

/// Half the side of the window, pixels.
const RADIUS: usize = 3;
/// Side of the window.
const SIDE: usize = 2 * RADIUS + 1;
/// Steps of cost per grey level.
const STEPS: f32 = 4.0;
/// The largest difference that counts, grey levels times [`STEPS`].
const TRUNCATED: f32 = 160.0;
/// Pixels that the inner loop takes at once.
const WIDE: usize = 16;

/// What makes a float's last place 1, so that adding it rounds to whole numbers: a conversion that saturates would keep
/// the compiler from using vectors.
const ROUNDING: f32 = 12_582_912.0;

/// The whole number of `x` + [`ROUNDING`], from 0 to 2²².
#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled for the instruction set of its caller")]
fn whole(rounded: f32) -> i32 {
    (rounded.to_bits() & 0x003f_ffff) as i32
}

/// Depths to try, as inverse depths in 1/m.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Planes {
    /// Of the nearest plane.
    pub(crate) nearest: f64,
    /// Of the farthest plane.
    pub(crate) farthest: f64,
    /// How many, at least 3.
    pub(crate) count: usize,
}

impl Planes {
    /// Difference of inverse depth between planes.
    pub(crate) fn step(&self) -> f64 {
        (self.nearest - self.farthest) / (self.count - 1) as f64
    }

    fn at(&self, place: f64) -> f64 {
        self.nearest - self.step() * place
    }
}

/// A view and its pose, `camera_from_world` in whichever frame is still.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Posed<'a> {
    /// The picture.
    pub(crate) view: &'a View,
    /// Its pose.
    pub(crate) pose: &'a Isometry,
}

/// Inverse depth per pixel of `reference`, 1/m; 0 where there is none.
pub(crate) fn inverse_depths(reference: Posed<'_>, neighbours: &[Posed<'_>], planes: &Planes) -> Vec<f32> {
    #[cfg(target_arch = "x86_64")]
    {
        if is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512vl")
            && is_x86_feature_detected!("avx512dq")
        {
            // SAFETY: the machine has these instructions.
            #[allow(unsafe_code, reason = "a function for wider vectors, behind a check of the machine")]
            return unsafe { sweep_avx512(reference, neighbours, planes) };
        }
        if is_x86_feature_detected!("avx2") {
            // SAFETY: the machine has these instructions.
            #[allow(unsafe_code, reason = "a function for wider vectors, behind a check of the machine")]
            return unsafe { sweep_avx2(reference, neighbours, planes) };
        }
    }
    sweep(reference, neighbours, planes)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512vl,avx512dq")]
fn sweep_avx512(reference: Posed<'_>, neighbours: &[Posed<'_>], planes: &Planes) -> Vec<f32> {
    sweep(reference, neighbours, planes)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn sweep_avx2(reference: Posed<'_>, neighbours: &[Posed<'_>], planes: &Planes) -> Vec<f32> {
    sweep(reference, neighbours, planes)
}

/// What maps pixels of the reference to a neighbour.
struct Warp<'a> {
    view: &'a View,
    /// K' R K⁻¹, column by column.
    by_pixel: [[f32; 3]; 3],
    /// K' t.
    by_inverse_depth: [f32; 3],
}

impl<'a> Warp<'a> {
    fn new(reference: Posed<'_>, neighbour: Posed<'a>) -> Self {
        let lens = |v: &View| {
            DMat3::from_cols(
                DVec3::new(v.focal.x, 0.0, 0.0),
                DVec3::new(0.0, v.focal.y, 0.0),
                DVec3::new(v.center.x, v.center.y, 1.0),
            )
        };
        let to = neighbour.pose.compose(&reference.pose.inverse());
        let m = lens(neighbour.view) * to.rotation * lens(reference.view).inverse();
        let t = lens(neighbour.view) * to.translation;
        let narrow = |v: DVec3| v.to_array().map(|v| v as f32);
        Self {
            view: neighbour.view,
            by_pixel: [narrow(m.x_axis), narrow(m.y_axis), narrow(m.z_axis)],
            by_inverse_depth: narrow(t),
        }
    }

    /// Costs of row `y` of the reference at an inverse depth.
    #[inline(always)]
    #[allow(clippy::inline_always, reason = "it must be compiled for the instruction set of its caller")]
    #[allow(clippy::needless_bitwise_bool, reason = "branches would keep the compiler from using vectors")]
    fn costs(&self, grey: &[f32], y: usize, inverse_depth: f32, costs: &mut [u16]) {
        let v = y as f32 + 0.5;
        let [mx, my, mz] = self.by_pixel;
        let start: [f32; 3] =
            std::array::from_fn(|k| my[k] * v + mz[k] + self.by_inverse_depth[k] * inverse_depth + mx[k] * 0.5);
        let width = self.view.width as i32;
        let (right, below) = (self.view.width as f32 - 1.0, self.view.height as f32 - 1.0);
        // A hair less, so that the last column is never the left one of a sample.
        let (last_x, last_y) = ((right - 0.001).max(0.0), (below - 0.001).max(0.0));
        let packed = &self.view.packed[..];
        for (chunk, (grey, costs)) in grey.chunks_exact(WIDE).zip(costs.chunks_exact_mut(WIDE)).enumerate() {
            let first = (chunk * WIDE) as f32;
            let (mut fx, mut fy) = ([0.0f32; WIDE], [0.0f32; WIDE]);
            let mut index = [0i32; WIDE];
            let mut inside = [0.0f32; WIDE];
            for i in 0..WIDE {
                let u = first + i as f32;
                let depth = start[2] + mx[2] * u;
                let inverse = 1.0 / depth;
                let x = (start[0] + mx[0] * u) * inverse - 0.5;
                let y = (start[1] + mx[1] * u) * inverse - 0.5;
                let out = (x < 0.0) | (y < 0.0) | (x > right) | (y > below) | (depth <= 0.0);
                inside[i] = if out { 0.0 } else { 1.0 };
                let (x, y) = (x.max(0.0).min(last_x), y.max(0.0).min(last_y));
                let (left, top) = (x - 0.5 + ROUNDING, y - 0.5 + ROUNDING);
                fx[i] = x - (left - ROUNDING);
                fy[i] = y - (top - ROUNDING);
                index[i] = whole(top).wrapping_mul(width).wrapping_add(whole(left));
            }
            let mut words = [0u32; WIDE];
            for i in 0..WIDE {
                words[i] = packed.get(index[i] as u32 as usize).copied().unwrap_or(0);
            }
            for i in 0..WIDE {
                let word = words[i] as i32;
                let part = |shift: i32| ((word >> shift) & 255) as f32;
                let above = part(0) + (part(8) - part(0)) * fx[i];
                let under = part(16) + (part(24) - part(16)) * fx[i];
                let difference = (above + (under - above) * fy[i] - grey[i]).abs() * STEPS;
                let known = (word != 0) & (inside[i] > 0.0);
                let cost = if known { difference.min(TRUNCATED) } else { TRUNCATED };
                // A pixel that the reference does not know costs nothing at any depth.
                let cost = if grey[i] > 0.0 { cost } else { 0.0 };
                costs[i] = whole(cost + ROUNDING) as u16;
            }
        }
    }
}

/// The window sums of one neighbour at one plane, row after row.
struct Window {
    /// The last `SIDE` rows of costs.
    rows: Vec<Vec<u16>>,
    /// Sums of these rows, with `RADIUS` zeros at each end.
    columns: Vec<u16>,
}

#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled for the instruction set of its caller")]
fn sweep(reference: Posed<'_>, neighbours: &[Posed<'_>], planes: &Planes) -> Vec<f32> {
    let view = reference.view;
    let (width, height) = (view.width, view.height);
    let padded = width.div_ceil(WIDE) * WIDE;
    let warps: Vec<Warp<'_>> = neighbours.iter().map(|&n| Warp::new(reference, n)).collect();
    if warps.is_empty() {
        return vec![0.0; width * height];
    }
    let mut grey = vec![0.0f32; padded * height];
    for (to, from) in grey.chunks_exact_mut(padded).zip(view.grey.chunks_exact(width)) {
        to.iter_mut().zip(from).for_each(|(t, &f)| *t = f32::from(f));
    }
    let mut windows: Vec<Window> = warps
        .iter()
        .map(|_| Window { rows: vec![vec![0; padded]; SIDE], columns: vec![0; padded + 2 * RADIUS] })
        .collect();
    let mut search = Search::new(padded * height);
    let (mut least, mut second) = (vec![0u16; padded], vec![0u16; padded]);
    for plane in 0..planes.count {
        let inverse_depth = planes.at(plane as f64) as f32;
        for window in &mut windows {
            window.rows.iter_mut().for_each(|r| r.fill(0));
            window.columns.fill(0);
        }
        for y in 0..height + RADIUS {
            least.fill(u16::MAX);
            second.fill(u16::MAX);
            for (warp, window) in warps.iter().zip(&mut windows) {
                let columns = &mut window.columns[RADIUS..RADIUS + padded];
                let row = &mut window.rows[y % SIDE][..];
                columns.iter_mut().zip(&*row).for_each(|(c, &old)| *c = c.wrapping_sub(old));
                if y < height {
                    warp.costs(&grey[y * padded..(y + 1) * padded], y, inverse_depth, row);
                    columns.iter_mut().zip(&*row).for_each(|(c, &new)| *c = c.wrapping_add(new));
                } else {
                    row.fill(0);
                }
                if y >= RADIUS {
                    two_least(&window.columns, &mut least, &mut second);
                }
            }
            if y >= RADIUS {
                let at = (y - RADIUS) * padded;
                search.take(at, plane as u16, &least, if warps.len() > 1 { &second } else { &least });
            }
        }
    }
    let mut inverse = vec![0.0f32; width * height];
    for y in 0..height {
        for x in 0..width {
            if view.grey[y * width + x] > 0 {
                inverse[y * width + x] = search.result(y * padded + x, planes);
            }
        }
    }
    inverse
}

/// Sums of `SIDE` neighbours in a row, kept where they are the least or second to it.
#[inline(always)]
#[allow(clippy::inline_always, reason = "it must be compiled for the instruction set of its caller")]
fn two_least(columns: &[u16], least: &mut [u16], second: &mut [u16]) {
    let n = least.len();
    let (a, b, c, d) = (&columns[..n], &columns[1..=n], &columns[2..n + 2], &columns[3..n + 3]);
    let (e, f, g) = (&columns[4..n + 4], &columns[5..n + 5], &columns[6..n + 6]);
    let second = &mut second[..n];
    for i in 0..n {
        let left = a[i].wrapping_add(b[i]).wrapping_add(c[i]);
        let cost = left.wrapping_add(d[i]).wrapping_add(e[i].wrapping_add(f[i]).wrapping_add(g[i]));
        let more = least[i].max(cost);
        least[i] = least[i].min(cost);
        second[i] = second[i].min(more);
    }
}

/// The cheapest plane of each pixel so far, with the costs of the planes before and behind it.
struct Search {
    best: Vec<u16>,
    plane: Vec<u16>,
    before: Vec<u16>,
    behind: Vec<u16>,
    last: Vec<u16>,
}

impl Search {
    fn new(pixels: usize) -> Self {
        let full = || vec![u16::MAX; pixels];
        Self { best: full(), plane: vec![0; pixels], before: full(), behind: full(), last: full() }
    }

    #[inline(always)]
    #[allow(clippy::inline_always, reason = "it must be compiled for the instruction set of its caller")]
    fn take(&mut self, at: usize, plane: u16, least: &[u16], second: &[u16]) {
        let n = least.len();
        let range = at..at + n;
        let (best, planes) = (&mut self.best[range.clone()], &mut self.plane[range.clone()]);
        let (before, behind) = (&mut self.before[range.clone()], &mut self.behind[range.clone()]);
        let last = &mut self.last[range];
        let second = &second[..n];
        for i in 0..n {
            // Sums are at most 2 × 49 × 160.
            let cost = least[i].wrapping_add(second[i]);
            let follows = planes[i].wrapping_add(1) == plane;
            behind[i] = if follows { cost } else { behind[i] };
            let better = cost < best[i];
            best[i] = if better { cost } else { best[i] };
            planes[i] = if better { plane } else { planes[i] };
            before[i] = if better { last[i] } else { before[i] };
            behind[i] = if better { u16::MAX } else { behind[i] };
            last[i] = cost;
        }
    }

    fn result(&self, i: usize, planes: &Planes) -> f32 {
        let plane = usize::from(self.plane[i]);
        // The first plane has no other side: what is nearest may be nearer.
        if plane == 0 {
            return 0.0;
        }
        let mut place = plane as f64;
        if plane + 1 < planes.count {
            let (a, b, c) = (f64::from(self.before[i]), f64::from(self.best[i]), f64::from(self.behind[i]));
            let curvature = a - 2.0 * b + c;
            if curvature > 0.0 {
                place += (0.5 * (a - c) / curvature).clamp(-0.5, 0.5);
            }
        }
        planes.at(place) as f32
    }
}
