//! Regular lattices of feature vectors over the box [−1, 1]³, dense or in bricks, looked up by trilinear interpolation.
//!
//! A brick is 8³ vertices that lie together in memory: a corner's seven neighbours mostly share its brick. A sparse
//! lattice holds the bricks it was told to; all others share brick 0, which stays zero.

use crate::simd::Simd;

/// Vertices along a brick's edge.
pub const EDGE: usize = 8;
/// Vertices in a brick.
pub const BRICK: usize = EDGE * EDGE * EDGE;

/// Where the vertices of a lattice lie and how they are stored.
#[derive(Clone, Debug, PartialEq)]
pub struct Lattice {
    /// Vertices along x, y, z; multiples of 8.
    pub vertices: [usize; 3],
    /// Slot of each brick; slot 0 is the empty one of a sparse lattice.
    pub slot: Vec<u32>,
    /// Slots in use, the empty one included.
    pub slots: usize,
    /// Whether there is an empty slot.
    pub sparse: bool,
}

/// From a vertex to its neighbours along y and z in the same brick.
const Y: u32 = EDGE as u32;
const Z: u32 = (EDGE * EDGE) as u32;

/// The eight corners around a point.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Corners {
    /// Index of each corner's vertex in memory; x changes fastest, then y, then z.
    pub(crate) index: [u32; 8],
    /// Where the point lies between them, 0..1.
    pub(crate) t: [f32; 3],
}

impl Corners {
    /// The interpolation weights.
    #[inline(always)]
    pub(crate) fn weights(&self) -> [f32; 8] {
        let [u, v, w] = self.t;
        let (a, b, c) = (1.0 - u, 1.0 - v, 1.0 - w);
        let (bc, vc, bw, vw) = (b * c, v * c, b * w, v * w);
        [a * bc, u * bc, a * vc, u * vc, a * bw, u * bw, a * vw, u * vw]
    }

    /// Derivative of Σ weight · value with respect to `t`, from one number per corner.
    #[inline(always)]
    pub(crate) fn slope(&self, e: &[f32; 8]) -> [f32; 3] {
        let [u, v, w] = self.t;
        let (a, b, c) = (1.0 - u, 1.0 - v, 1.0 - w);
        [
            (e[1] - e[0]) * b * c + (e[3] - e[2]) * v * c + (e[5] - e[4]) * b * w + (e[7] - e[6]) * v * w,
            (e[2] - e[0]) * a * c + (e[3] - e[1]) * u * c + (e[6] - e[4]) * a * w + (e[7] - e[5]) * u * w,
            (e[4] - e[0]) * a * b + (e[5] - e[1]) * u * b + (e[6] - e[2]) * a * v + (e[7] - e[3]) * u * v,
        ]
    }
}

impl Lattice {
    /// A lattice with every brick in its place.
    pub fn dense(vertices: [usize; 3]) -> Self {
        let bricks = vertices.map(|n| n / EDGE).iter().product::<usize>();
        Self { vertices, slot: (0..bricks as u32).collect(), slots: bricks, sparse: false }
    }

    /// A lattice without bricks.
    pub fn sparse(vertices: [usize; 3]) -> Self {
        let bricks = vertices.map(|n| n / EDGE).iter().product::<usize>();
        Self { vertices, slot: vec![0; bricks], slots: 1, sparse: true }
    }

    /// Bricks along x, y, z.
    pub fn bricks(&self) -> [usize; 3] {
        self.vertices.map(|n| n / EDGE)
    }

    /// Lattice steps per unit of the box along each axis.
    #[inline(always)]
    pub(crate) fn steps_per_unit(&self) -> [f32; 3] {
        self.vertices.map(|n| (n - 1) as f32 * 0.5)
    }

    /// Gives `brick` a slot; returns whether it had none.
    pub fn allocate(&mut self, brick: usize) -> bool {
        if !self.sparse || self.slot[brick] != 0 {
            return false;
        }
        self.slot[brick] = self.slots as u32;
        self.slots += 1;
        true
    }

    /// Position of vertex (x, y, z) in the box.
    pub fn position(&self, vertex: [usize; 3]) -> [f32; 3] {
        std::array::from_fn(|a| vertex[a] as f32 / (self.vertices[a] - 1) as f32 * 2.0 - 1.0)
    }

    /// The corners around `p`; points outside the box take its border.
    #[inline(always)]
    pub(crate) fn corners(&self, p: [f32; 3]) -> Corners {
        let steps = self.steps_per_unit();
        let mut base = [0usize; 3];
        let mut t = [0.0; 3];
        for a in 0..3 {
            // max/min also turn a number that is none into the border, so that no index leaves the table.
            let q = ((p[a] + 1.0) * steps[a]).max(0.0).min((self.vertices[a] - 1) as f32 - 1e-3);
            base[a] = q as usize;
            t[a] = q - base[a] as f32;
        }
        let [nx, ny, _] = self.bricks();
        let [x, y, z] = base;
        let inside = [x % EDGE, y % EDGE, z % EDGE];
        let brick = (z / EDGE * ny + y / EDGE) * nx + x / EDGE;
        let local = inside[2] * EDGE * EDGE + inside[1] * EDGE + inside[0];
        if inside.iter().all(|&i| i < EDGE - 1) {
            let at = self.slot[brick] * BRICK as u32 + local as u32;
            return Corners {
                index: [at, at + 1, at + Y, at + Y + 1, at + Z, at + Z + 1, at + Z + Y, at + Z + Y + 1],
                t,
            };
        }
        let mut index = [0; 8];
        for (k, index) in index.iter_mut().enumerate() {
            let (x, y, z) = (x + (k & 1), y + (k >> 1 & 1), z + (k >> 2));
            let brick = (z / EDGE * ny + y / EDGE) * nx + x / EDGE;
            *index = self.slot[brick] * BRICK as u32 + ((z % EDGE * EDGE + y % EDGE) * EDGE + x % EDGE) as u32;
        }
        Corners { index, t }
    }
}

/// Σ weight · value over the corners: 4 channels at `offset` of rows of `stride` numbers.
///
/// # Safety
/// Every corner's row must lie inside `values`.
#[allow(unsafe_code, reason = "innermost loop; the caller's corners come from the lattice the table was made for")]
#[inline(always)]
pub(crate) unsafe fn gather<S: Simd>(
    values: &[f32],
    stride: usize,
    offset: usize,
    corners: &Corners,
    weights: &[f32; 8],
) -> S::Q {
    // SAFETY: the caller promises that every corner has its row.
    unsafe {
        let p = values.as_ptr().add(offset);
        let mut sum = S::q_splat(0.0);
        for (&i, &w) in corners.index.iter().zip(weights) {
            debug_assert!(i as usize * stride + offset + 4 <= values.len(), "corner outside its table");
            sum = S::q_fma(S::q_splat(w), S::q_load(p.add(i as usize * stride)), sum);
        }
        sum
    }
}

/// The largest of the corners' values, channel by channel: 4 channels of rows of 4 numbers.
///
/// # Safety
/// As [`gather`].
#[allow(unsafe_code, reason = "innermost loop; the caller's corners come from the lattice the table was made for")]
#[inline(always)]
pub(crate) unsafe fn largest<S: Simd>(values: &[f32], corners: &Corners) -> S::Q {
    // SAFETY: the caller promises that every corner has its row.
    unsafe {
        let mut most = S::q_splat(0.0);
        for &i in &corners.index {
            debug_assert!(i as usize * 4 + 4 <= values.len(), "corner outside its table");
            most = S::q_max(S::q_load(values.as_ptr().add(i as usize * 4)), most);
        }
        most
    }
}

/// Fetches the corners' rows into the cache, ahead of [`gather`] or [`scatter`]: sixteen points' misses at once instead of
/// one after the other.
#[allow(unsafe_code, reason = "innermost loop; fetching ahead is harmless wherever the pointer leads")]
#[inline(always)]
pub(crate) fn prefetch<S: Simd>(values: &[f32], stride: usize, index: &[u32; 8]) {
    /// Smaller tables stay in the cache by themselves.
    const LARGE: usize = 1 << 18;
    if values.len() < LARGE {
        return;
    }
    for &i in index {
        // SAFETY: nothing is read; the address is only computed.
        unsafe { S::prefetch(values.as_ptr().wrapping_add(i as usize * stride)) }
    }
}

/// value += weight · d at the corners.
///
/// # Safety
/// As [`gather`].
#[allow(unsafe_code, reason = "innermost loop; the caller's corners come from the lattice the table was made for")]
#[inline(always)]
pub(crate) unsafe fn scatter<S: Simd>(
    grads: &mut [f32],
    stride: usize,
    offset: usize,
    corners: &Corners,
    weights: &[f32; 8],
    d: S::Q,
) {
    // SAFETY: the caller promises that every corner has its row.
    unsafe {
        let len = grads.len();
        let p = grads.as_mut_ptr().add(offset);
        for (&i, &w) in corners.index.iter().zip(weights) {
            debug_assert!(i as usize * stride + offset + 4 <= len, "corner outside its table");
            let q = p.add(i as usize * stride);
            S::q_store(q, S::q_fma(S::q_splat(w), d, S::q_load(q)));
        }
    }
}

/// ⟨d, value⟩ at each corner: what the slope along the axes needs.
///
/// # Safety
/// As [`gather`].
#[allow(unsafe_code, reason = "innermost loop; the caller's corners come from the lattice the table was made for")]
#[inline(always)]
pub(crate) unsafe fn dots<S: Simd>(
    values: &[f32],
    stride: usize,
    offset: usize,
    corners: &Corners,
    d: S::Q,
) -> [f32; 8] {
    // SAFETY: the caller promises that every corner has its row.
    unsafe {
        let p = values.as_ptr().add(offset);
        let mut out = [0.0; 8];
        for (k, out) in out.iter_mut().enumerate() {
            *out = S::q_dot(d, S::q_load(p.add(corners.index[k] as usize * stride)));
        }
        out
    }
}
