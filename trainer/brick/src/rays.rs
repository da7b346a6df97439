//! A chunk of rays on its way through the head and the background: forward in waves that end when a ray is opaque,
//! backward through the samples that counted.
//!
//! Within a ray, samples stand in the order of their depth; rays of a chunk are mixed. So both ways are single passes
//! over the samples with one running state per ray.

mod through;

use self::through::Through;
use crate::cull::SEEN;
use crate::evaluate::{Deformation, DeformationGrad, Lot, Samples};
use crate::expression::MASKS;
use crate::field::{Field, FieldGrad, Transposed, monomials};
use crate::march::March;
use crate::math;
use crate::model::{BackgroundFrame, Brick, Part};
use crate::occupancy::{Occupancy, part_at};
use crate::simd::{self, Simd, Task};

/// What one part of the scene has along each ray.
#[derive(Clone, Debug, Default)]
pub(crate) struct Pass {
    pub(crate) samples: Samples,
    /// Opacity of each sample; negative where the ray had already ended.
    alpha: Vec<f32>,
    /// Transmittance in front of each sample.
    before: Vec<f32>,
    /// Colour of each sample.
    color: Vec<[f32; 3]>,
    /// How far along its ray each sample lies, box units.
    along: Vec<f32>,
    alive: Vec<u32>,
}

/// Sums over the samples behind the current one, per ray.
#[derive(Clone, Copy, Debug, Default)]
struct Behind {
    /// ⟨gradient, what they show⟩
    suffix: f32,
    /// Σ weight, Σ weight · distance of all samples of the ray.
    total: [f32; 2],
    /// The same of those passed on the way back.
    passed: [f32; 2],
}

/// What is asked of the density besides explaining the pixels.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Prior {
    /// Weight of ln(1 + 2σ²): thin density goes, what is opaque stays.
    pub(crate) haze: f32,
    /// Weight of the spread of each ray's weights (Σ w_i w_j |t_i − t_j| + ⅓ Σ w_i² step).
    pub(crate) spread: f32,
}

/// What became of a chunk of rays.
#[derive(Clone, Debug, Default)]
pub(crate) struct Rays {
    pub(crate) head: Pass,
    pub(crate) background: Pass,
    /// Colour so far, without what lies behind everything.
    pub(crate) color: Vec<[f32; 3]>,
    /// Colour of the head alone.
    pub(crate) head_color: Vec<[f32; 3]>,
    /// Transmittance behind everything so far.
    pub(crate) left: Vec<f32>,
    /// Region masks.
    pub(crate) masks: Vec<[f32; MASKS]>,
    /// Σ weight · distance along the ray, and Σ weight, of the head.
    pub(crate) depth: Vec<[f32; 2]>,
    /// A bit for each region that has a mask at some sample of the ray.
    pub(crate) touched: Vec<u8>,
    marches: Vec<March>,
    behind: Vec<Behind>,
}

/// How a chunk is looked at.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Look {
    /// Samples along the head box's edge.
    pub(crate) divisions: usize,
    /// Planes of the background.
    pub(crate) planes: usize,
    /// A ray whose transmittance falls below this is over; 0 follows rays to their ends.
    pub(crate) opaque: f32,
    /// Samples that go through the network together at least, while there are rays for it: when few rays are left, each
    /// takes several at a time, and may waste some behind the surface it ends at.
    pub(crate) batch: usize,
    /// Whether samples are also taken where nothing is, for measuring what their absence saves. They show nothing.
    pub(crate) everywhere: bool,
}

impl Look {
    /// The background is looked at behind a head that lets more than this through.
    fn background_from(&self) -> f32 {
        if self.opaque > 0.0 { BACKGROUND_FROM } else { -1.0 }
    }
}

impl Pass {
    fn begin(&mut self, directions: &[[f32; 3]]) {
        self.samples.clear();
        self.samples.directions.extend(directions.iter().map(|d| monomials(*d)));
        self.alpha.clear();
        self.before.clear();
        self.color.clear();
        self.along.clear();
        self.alive.clear();
    }

    /// Takes the density from samples where nothing is.
    fn silence(&mut self, from: usize, occupancy: &Occupancy) {
        for i in from..self.samples.len() {
            if !occupancy.holds(self.samples.point[i]) {
                self.samples.silence(i);
            }
        }
    }

    /// Composites the samples from `from` on.
    #[inline(always)]
    fn composite(&mut self, from: usize, step: f32, opaque: f32, left: &mut [f32], out: &mut [[f32; 3]]) {
        for i in from..self.samples.len() {
            let ray = self.samples.ray[i] as usize;
            let before = left[ray];
            self.before.push(before);
            if before < opaque {
                self.alpha.push(-1.0);
                self.color.push([0.0; 3]);
                continue;
            }
            let alpha = 1.0 - math::exp(-math::density(self.samples.density(i)) * step);
            let color = self.samples.color(i).map(math::sigmoid);
            let w = before * alpha;
            for c in 0..3 {
                out[ray][c] += w * color[c];
            }
            left[ray] = before * (1.0 - alpha);
            self.alpha.push(alpha);
            self.color.push(color);
        }
    }

    /// Turns gradients of the rays' colours into those of the samples; `rays` begin with what lies behind everything.
    #[inline(always)]
    fn decomposite(&mut self, step: f32, d_color: &[[f32; 3]], rays: &mut [Behind], prior: Prior) {
        let n = self.samples.len();
        self.samples.d_density.resize(n, 0.0);
        self.samples.d_color.resize(n, [0.0; 3]);
        for ray in rays.iter_mut() {
            ray.total = [0.0; 2];
            ray.passed = [0.0; 2];
        }
        for i in 0..n {
            let w = self.before[i] * self.alpha[i].max(0.0);
            let total = &mut rays[self.samples.ray[i] as usize].total;
            *total = [total[0] + w, total[1] + w * self.along[i]];
        }
        for i in (0..n).rev() {
            let alpha = self.alpha[i];
            if alpha < 0.0 {
                self.samples.d_density[i] = 0.0;
                self.samples.d_color[i] = [0.0; 3];
                continue;
            }
            let ray = self.samples.ray[i] as usize;
            let (d, color, before) = (d_color[ray], self.color[i], self.before[i]);
            let ray = &mut rays[ray];
            let (w, t) = (before * alpha, self.along[i]);
            let front = [ray.total[0] - ray.passed[0] - w, ray.total[1] - ray.passed[1] - w * t];
            let apart = t * front[0] - front[1] + ray.passed[1] - t * ray.passed[0];
            let g = math::dot(d, color) + prior.spread * (2.0 * apart + 2.0 / 3.0 * w * step);
            let sigma = math::density(self.samples.density(i));
            let d_sigma = step * (before * (1.0 - alpha) * g - ray.suffix);
            let thin = prior.haze * 4.0 * sigma / (1.0 + 2.0 * sigma * sigma);
            self.samples.d_density[i] = (d_sigma + thin) * sigma;
            self.samples.d_color[i] = std::array::from_fn(|c| w * d[c] * color[c] * (1.0 - color[c]));
            ray.suffix += w * g;
            ray.passed = [ray.passed[0] + w, ray.passed[1] + w * t];
        }
    }

    /// The largest weight of any ray, per part of a cell.
    pub(crate) fn weigh(&self, weights: &mut [f32]) {
        for (i, &p) in self.samples.point.iter().enumerate() {
            let w = self.before[i] * self.alpha[i];
            if w < SEEN {
                // Decides nothing, and most samples are such: each would cost a miss of the cache.
                continue;
            }
            let slot = &mut weights[part_at(p)];
            if w > *slot {
                *slot = w;
            }
        }
    }
}

impl Rays {
    /// Samples taken in the head and in the background.
    pub(crate) fn sample_counts(&self) -> [usize; 2] {
        [self.head.samples.len(), self.background.samples.len()]
    }

    /// Sends rays from `origin` (world) through the scene; `jitter` moves each ray's samples by up to a step.
    #[allow(clippy::too_many_arguments, reason = "one call site each in fitting and rendering")]
    pub(crate) fn forward(
        &mut self,
        model: &Brick,
        deformation: &Deformation<'_>,
        motion: Option<&[f32]>,
        origin: [f32; 3],
        directions: &[[f32; 3]],
        mut jitter: impl FnMut() -> f32,
        look: Look,
    ) {
        let n = directions.len();
        self.color.clear();
        self.color.resize(n, [0.0; 3]);
        self.left.clear();
        self.left.resize(n, 1.0);
        self.masks.clear();
        self.masks.resize(n, [0.0; MASKS]);
        self.depth.clear();
        self.depth.resize(n, [0.0; 2]);
        self.touched.clear();
        self.touched.resize(n, 0);
        self.head.begin(directions);
        self.background.begin(directions);
        self.send_through_head(model, deformation, motion, origin, directions, &mut jitter, look);
        self.head_color.clone_from(&self.color);
        if let (Some(part), Some(frame)) = (&model.background, &model.layout.background) {
            self.send_through_background(part, frame, origin, directions, &mut jitter, look);
        }
    }

    #[allow(clippy::too_many_arguments, reason = "one call site")]
    fn send_through_head(
        &mut self,
        model: &Brick,
        deformation: &Deformation<'_>,
        motion: Option<&[f32]>,
        origin: [f32; 3],
        directions: &[[f32; 3]],
        jitter: &mut impl FnMut() -> f32,
        look: Look,
    ) {
        let Self { head, color, left, masks, depth, touched, marches, .. } = self;
        marches.clear();
        for (ray, &direction) in (0u32..).zip(directions) {
            let march = model.head_march(origin, direction, motion, look.divisions, jitter());
            if march.t() < march.exit {
                head.alive.push(ray);
            }
            marches.push(march);
        }
        let (part, step) = (&model.head, 2.0 / look.divisions as f32);
        simd::run(Through { pass: head, marches, part, deformation: Some(deformation), step, look, left, color });
        let half = model.layout.head_box.half;
        for i in 0..head.samples.len() {
            if head.alpha[i] < 0.0 {
                continue;
            }
            let (ray, found) = (head.samples.ray[i] as usize, head.samples.masks[i]);
            let w = head.before[i] * head.alpha[i];
            for (n, (sum, m)) in masks[ray].iter_mut().zip(found).enumerate() {
                *sum += w * m;
                touched[ray] |= u8::from(m > 0.0) << n;
            }
            depth[ray] = [depth[ray][0] + w * head.along[i] * half, depth[ray][1] + w];
        }
    }

    fn send_through_background(
        &mut self,
        part: &Part,
        frame: &BackgroundFrame,
        origin: [f32; 3],
        directions: &[[f32; 3]],
        jitter: &mut impl FnMut() -> f32,
        look: Look,
    ) {
        let Self { background, color, left, marches, .. } = self;
        let from_camera = frame.camera_from_world(origin);
        marches.clear();
        for (ray, &direction) in (0u32..).zip(directions) {
            let march = frame.march(from_camera, frame.turn(direction), look.planes, jitter());
            if march.is_some() && left[ray as usize] > look.background_from() {
                background.alive.push(ray);
            }
            marches.push(march.unwrap_or_else(|| March::new([0.0; 3], [0.0; 3], 0.0, 0.0, 1.0)));
        }
        let step = 2.0 / look.planes as f32;
        simd::run(Through { pass: background, marches, part, deformation: None, step, look, left, color });
    }

    /// The way back: `d_color` per ray, `d_masks` per ray; `behind` is the colour behind everything.
    #[allow(clippy::too_many_arguments, reason = "one call site")]
    pub(crate) fn backward(
        &mut self,
        model: &Brick,
        deformation: &Deformation<'_>,
        transposed: [Option<&Transposed>; 2],
        look: Look,
        d_color: &[[f32; 3]],
        d_masks: Option<&[[f32; MASKS]]>,
        behind: &[[f32; 3]],
        prior: [Prior; 2],
        lot: Lot,
        grads: [&mut FieldGrad; 2],
        deformation_grad: &mut DeformationGrad<'_>,
    ) {
        self.behind.clear();
        self.behind.extend(
            (0..d_color.len())
                .map(|r| Behind { suffix: self.left[r] * math::dot(d_color[r], behind[r]), ..Behind::default() }),
        );
        let [head_grad, background_grad] = grads;
        simd::run(Decomposite { rays: self, look, d_color, prior });
        let Self { head, background, .. } = self;
        let n = head.samples.len();
        head.samples.d_masks.clear();
        head.samples.d_masks.resize(n, [0.0; MASKS]);
        if let Some(d_masks) = d_masks {
            for i in 0..n {
                // The weights are constants here: masks must not bend the shape (stop-gradient on density).
                let w = head.before[i] * head.alpha[i].max(0.0);
                head.samples.d_masks[i] = d_masks[head.samples.ray[i] as usize].map(|d| w * d);
            }
        }
        let fields: [Option<&Field>; 2] = [Some(&model.head.field), model.background.as_ref().map(|p| &p.field)];
        if let (Some(field), Some(transposed)) = (fields[1], transposed[1]) {
            background.samples.backward(field, transposed, None, lot, background_grad, None);
        }
        if let (Some(field), Some(transposed)) = (fields[0], transposed[0]) {
            head.samples.backward(field, transposed, Some(deformation), lot, head_grad, Some(deformation_grad));
        }
    }
}

/// Turns gradients of pixels into those of both parts' samples.
struct Decomposite<'a> {
    rays: &'a mut Rays,
    look: Look,
    d_color: &'a [[f32; 3]],
    prior: [Prior; 2],
}

impl Task for Decomposite<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        let Self { rays: Rays { head, background, behind, .. }, look, d_color, prior } = self;
        background.decomposite(2.0 / look.planes as f32, d_color, behind, prior[1]);
        head.decomposite(2.0 / look.divisions as f32, d_color, behind, prior[0]);
    }
}

/// Behind a head that lets less than this through, the background is not looked at.
const BACKGROUND_FROM: f32 = 1.0 / 600.0;

#[cfg(test)]
#[path = "rays_tests.rs"]
mod tests;
