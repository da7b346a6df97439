//! The masked, aligned face: 112 × 112 px, what [`super::fhog`] reads.
//!
//! A similarity in the picture brings the stable points of the mesh to the canonical mesh seen from the front: outer eye
//! corners 50 px apart, the middle of the face oval at (56, 56). Outside the face oval it is black. It is sampled from the
//! landmark network's input, which is already averaged to the face's size. `tools/train-aus/fhog.py` makes the same.

use std::sync::LazyLock;

use crate::models::manifest::Layout;
use crate::run::crop::Affine;
use crate::run::mesh::{MESH_POINTS, STABLE};
use crate::weights::Weights;

/// Pixels of a side.
pub const SIDE: usize = 112;
/// Pixels of one colour.
pub const PLANE: usize = SIDE * SIDE;
/// Between the outer eye corners of the canonical mesh.
const EYES_PX: f32 = 50.0;

/// The face oval of the mesh, clockwise from the middle of the forehead.
const FACE_OVAL: [u16; 36] = [
    10, 338, 297, 332, 284, 251, 389, 356, 454, 323, 361, 288, 397, 365, 379, 378, 400, 377, 152, 148, 176, 149, 150,
    136, 172, 58, 132, 93, 234, 127, 162, 21, 54, 103, 67, 109,
];

/// The stable points of the canonical mesh in the aligned face, px.
static TARGET: LazyLock<[[f32; 2]; STABLE.len()]> = LazyLock::new(|| {
    let canonical = &Weights::get().canonical;
    let middle = [0, 1].map(|axis| {
        let oval = FACE_OVAL.map(|i| canonical[usize::from(i)][axis]);
        let (low, high) = oval.iter().fold((f32::MAX, f32::MIN), |(l, h), &v| (l.min(v), h.max(v)));
        0.5 * (low + high)
    });
    let place = |v: f32, axis: usize| (v - middle[axis]) * EYES_PX + SIDE as f32 / 2.0;
    STABLE.map(|i| [0, 1].map(|axis| place(canonical[usize::from(i)][axis], axis)))
});

/// The picture that a network reads: its numbers, and how levels 0–255 became numbers.
#[derive(Clone, Copy, Debug)]
pub struct NetworkInput<'a> {
    /// Three colours of each pixel in the order of `layout`: (level − mean) × scale.
    pub numbers: &'a [f32],
    /// Pixels.
    pub width: usize,
    /// Pixels.
    pub height: usize,
    /// Order of the numbers.
    pub layout: Layout,
    /// Level of the number 0.
    pub mean: f32,
    /// Numbers per level.
    pub scale: f32,
}

/// Levels 0–255 of the aligned face, red, green and blue one after the other, rows from the top.
#[derive(Clone, Debug, PartialEq)]
pub struct AlignedFace {
    /// 3 × 112 × 112.
    pub levels: Vec<f32>,
}

impl AlignedFace {
    /// Samples the face that has the mesh `points` (pixels of the input). `None` where the stable points coincide.
    pub fn sample(input: &NetworkInput, points: &[[f32; 2]; MESH_POINTS]) -> Option<Self> {
        let face_from_input = alignment(points)?;
        let input_from_face = inverse(&face_from_input);
        let oval = FACE_OVAL.map(|i| face_from_input.apply(points[usize::from(i)]));
        let mut levels = vec![0.0; 3 * PLANE];
        for row in 0..SIDE {
            for [from, to] in inside(&oval, row as f32 + 0.5) {
                for column in from..to {
                    let [x, y] = input_from_face.apply([column as f32 + 0.5, row as f32 + 0.5]);
                    if let Some(rgb) = input.bilinear(x - 0.5, y - 0.5) {
                        for (c, level) in rgb.into_iter().enumerate() {
                            levels[c * PLANE + row * SIDE + column] = level;
                        }
                    }
                }
            }
        }
        Some(Self { levels })
    }
}

impl NetworkInput<'_> {
    /// Levels at (x, y), where whole numbers are the centres of pixels; `None` outside.
    #[inline]
    fn bilinear(&self, x: f32, y: f32) -> Option<[f32; 3]> {
        let (left, top) = (x.floor(), y.floor());
        if !(left >= 0.0 && top >= 0.0 && left + 1.0 < self.width as f32 && top + 1.0 < self.height as f32) {
            return None;
        }
        let (fx, fy) = (x - left, y - top);
        let at = top as usize * self.width + left as usize;
        let (step, colour) = if self.layout == Layout::Nhwc { (3, 1) } else { (1, self.width * self.height) };
        let mut rgb = [0.0; 3];
        for (c, level) in rgb.iter_mut().enumerate() {
            let number = |pixel: usize| self.numbers.get(step * pixel + c * colour).copied().unwrap_or(0.0);
            let above = number(at) * (1.0 - fx) + number(at + 1) * fx;
            let below = number(at + self.width) * (1.0 - fx) + number(at + self.width + 1) * fx;
            *level = (above * (1.0 - fy) + below * fy) / self.scale + self.mean;
        }
        Some(rgb)
    }
}

/// `face_from_input`: the similarity that brings the stable points nearest to their places.
fn alignment(points: &[[f32; 2]; MESH_POINTS]) -> Option<Affine> {
    let from = STABLE.map(|i| points[usize::from(i)]);
    let mean =
        |p: &[[f32; 2]; STABLE.len()]| [0, 1].map(|axis| p.iter().map(|p| p[axis]).sum::<f32>() / p.len() as f32);
    let (a, b) = (mean(&from), mean(&TARGET));
    let (mut real, mut imaginary, mut size) = (0.0, 0.0, 0.0);
    for (p, q) in from.iter().zip(TARGET.iter()) {
        let (p, q) = ([p[0] - a[0], p[1] - a[1]], [q[0] - b[0], q[1] - b[1]]);
        real += p[0] * q[0] + p[1] * q[1];
        imaginary += p[0] * q[1] - p[1] * q[0];
        size += p[0] * p[0] + p[1] * p[1];
    }
    let (real, imaginary) = (real / size, imaginary / size);
    let linear = [[real, -imaginary], [imaginary, real]];
    let shift = [0, 1].map(|i| b[i] - linear[i][0] * a[0] - linear[i][1] * a[1]);
    (real.is_finite() && imaginary.is_finite() && real.hypot(imaginary) > 1e-6).then_some(Affine { linear, shift })
}

/// The other way, of a similarity.
fn inverse(similarity: &Affine) -> Affine {
    let [[a, b], [c, d]] = similarity.linear;
    let determinant = a * d - b * c;
    let linear = [[d / determinant, -b / determinant], [-c / determinant, a / determinant]];
    let [x, y] = similarity.shift;
    Affine { linear, shift: linear.map(|row| -row[0] * x - row[1] * y) }
}

/// Runs of columns whose centres lie inside the polygon at the height `v` (even–odd rule).
pub(super) fn inside(polygon: &[[f32; 2]], v: f32) -> Vec<[usize; 2]> {
    let mut crossings: Vec<f32> = (0..polygon.len())
        .filter_map(|i| {
            let ([ax, ay], [bx, by]) = (polygon[i], polygon[(i + polygon.len() - 1) % polygon.len()]);
            ((ay > v) != (by > v)).then(|| (bx - ax) * (v - ay) / (by - ay) + ax)
        })
        .collect();
    crossings.sort_unstable_by(f32::total_cmp);
    // The column c is inside where crossings[0] ≤ c + 0.5 < crossings[1].
    let column = |x: f32| (x - 0.5).ceil().clamp(0.0, SIDE as f32) as usize;
    crossings.chunks_exact(2).map(|pair| [column(pair[0]), column(pair[1])]).collect()
}

#[cfg(test)]
#[path = "face_tests.rs"]
mod tests;
