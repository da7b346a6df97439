//! A chunk of rays on its way through the head and the background: forward in waves that end when a ray is opaque,
//! backward through the samples that counted.
//!
//! Within a ray, samples stand in the order of their depth; rays of a chunk are mixed. So both ways are single passes
//! over the samples with one running state per ray.

use crate::evaluate::{Deformation, DeformationGrad, Samples};
use crate::expression::MASKS;
use crate::field::{Field, FieldGrad, Transposed, monomials};
use crate::math;
use crate::model::{BackgroundFrame, Brick, Part};
use crate::occupancy::{March, Occupancy, cell_at};
use crate::simd::{self, Simd, Task};

/// Samples a ray takes per wave.
const WAVE: usize = 8;

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
    /// The same of those behind.
    behind: [f32; 2],
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
    /// Transmittance behind everything so far.
    pub(crate) left: Vec<f32>,
    /// Region masks.
    pub(crate) masks: Vec<[f32; MASKS]>,
    /// Σ weight · distance along the ray, and Σ weight, of the head.
    pub(crate) depth: Vec<[f32; 2]>,
    marches: Vec<March>,
    planes: Vec<Plane>,
    behind: Vec<Behind>,
}

#[derive(Clone, Copy, Debug)]
struct Plane {
    origin: [f32; 3],
    direction: [f32; 3],
    next: f32,
}

/// How a chunk is looked at.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Look {
    /// Samples along the head box's edge.
    pub(crate) divisions: usize,
    /// Planes of the background.
    pub(crate) planes: usize,
    /// A ray whose transmittance falls below this is over.
    pub(crate) opaque: f32,
    /// Whether the background is looked at.
    pub(crate) background: bool,
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
            ray.behind = [0.0; 2];
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
            let front = [ray.total[0] - ray.behind[0] - w, ray.total[1] - ray.behind[1] - w * t];
            let apart = t * front[0] - front[1] + ray.behind[1] - t * ray.behind[0];
            let g = math::dot(d, color) + prior.spread * (2.0 * apart + 2.0 / 3.0 * w * step);
            let sigma = math::density(self.samples.density(i));
            let d_sigma = step * (before * (1.0 - alpha) * g - ray.suffix);
            let thin = prior.haze * 4.0 * sigma / (1.0 + 2.0 * sigma * sigma);
            self.samples.d_density[i] = (d_sigma + thin) * sigma;
            self.samples.d_color[i] = std::array::from_fn(|c| w * d[c] * color[c] * (1.0 - color[c]));
            ray.suffix += w * g;
            ray.behind = [ray.behind[0] + w, ray.behind[1] + w * t];
        }
    }

    /// The largest weight of any ray, per cell.
    pub(crate) fn weigh(&self, weights: &mut [f32]) {
        for (i, &p) in self.samples.point.iter().enumerate() {
            let w = self.before[i] * self.alpha[i];
            let slot = &mut weights[cell_at(p)];
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
        self.head.begin(directions);
        self.background.begin(directions);
        simd::run(HeadMarch { rays: self, model, deformation, motion, origin, directions, jitter: &mut jitter, look });
        if let (Some(part), Some(frame), true) = (&model.background, &model.layout.background, look.background) {
            simd::run(BackgroundMarch { rays: self, part, frame, origin, directions, jitter: &mut jitter, look });
        }
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
            background.samples.backward(field, transposed, None, background_grad, None);
        }
        if let (Some(field), Some(transposed)) = (fields[0], transposed[0]) {
            head.samples.backward(field, transposed, Some(deformation), head_grad, Some(deformation_grad));
        }
    }
}

/// The head's part of [`Rays::forward`].
struct HeadMarch<'a, J> {
    rays: &'a mut Rays,
    model: &'a Brick,
    deformation: &'a Deformation<'a>,
    motion: Option<&'a [f32]>,
    origin: [f32; 3],
    directions: &'a [[f32; 3]],
    jitter: &'a mut J,
    look: Look,
}

impl<J: FnMut() -> f32> Task for HeadMarch<'_, J> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        let Self { rays, model, deformation, motion, origin, directions, jitter, look } = self;
        let Rays { head, color, left, masks, depth, marches, .. } = rays;
        let half = model.layout.head_box.half;
        marches.clear();
        for (ray, &direction) in directions.iter().enumerate() {
            let mut march = model.head_march(origin, direction, look.divisions, 0.0);
            if let Some(m) = motion {
                let turn = [m[0], m[1], m[2]];
                let turned = math::rotate(turn, march.origin);
                march.origin = std::array::from_fn(|a| turned[a] + m[3 + a]);
                march.direction = math::rotate(turn, march.direction);
                (march.t, march.exit) = crate::occupancy::crossing(march.origin, march.direction);
            }
            march.t += jitter() * march.step;
            if march.t < march.exit {
                head.alive.push(ray as u32);
            }
            marches.push(march);
        }
        let step = 2.0 / look.divisions as f32;
        let occupancy: &Occupancy = &model.head.occupancy;
        while !head.alive.is_empty() {
            let from = head.samples.len();
            let Samples { point, ray: rays, .. } = &mut head.samples;
            head.alive.retain(|&ray| {
                if left[ray as usize] < look.opaque {
                    return false;
                }
                occupancy.advance(&mut marches[ray as usize], WAVE, |p| {
                    point.push(p);
                    rays.push(ray);
                })
            });
            head.samples.forward(&model.head.field, Some(deformation), from);
            head.composite(from, step, look.opaque, left, color);
            for i in from..head.samples.len() {
                let ray = head.samples.ray[i] as usize;
                let w = head.before[i] * head.alpha[i];
                let (p, march) = (head.samples.point[i], &marches[ray]);
                let t = math::dot(
                    [p[0] - march.origin[0], p[1] - march.origin[1], p[2] - march.origin[2]],
                    march.direction,
                );
                head.along.push(t);
                if w > 0.0 {
                    for (sum, m) in masks[ray].iter_mut().zip(head.samples.masks[i]) {
                        *sum += w * m;
                    }
                    depth[ray][0] += w * t * half;
                    depth[ray][1] += w;
                }
            }
        }
    }
}

/// The background's part of [`Rays::forward`].
struct BackgroundMarch<'a, J> {
    rays: &'a mut Rays,
    part: &'a Part,
    frame: &'a BackgroundFrame,
    origin: [f32; 3],
    directions: &'a [[f32; 3]],
    jitter: &'a mut J,
    look: Look,
}

impl<J: FnMut() -> f32> Task for BackgroundMarch<'_, J> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        let Self { rays, part, frame, origin, directions, jitter, look } = self;
        let Rays { background, color, left, planes, .. } = rays;
        let from_camera = frame.camera_from_world(origin);
        let step = 2.0 / look.planes as f32;
        planes.clear();
        for (ray, &d) in directions.iter().enumerate() {
            let direction = frame.turn(d);
            planes.push(Plane { origin: from_camera, direction, next: jitter() });
            // Rays that look away from the frame meet none of its planes.
            if left[ray] > BACKGROUND_FROM && direction[2] > 0.05 {
                background.alive.push(ray as u32);
            }
        }
        while !background.alive.is_empty() {
            let from = background.samples.len();
            let Samples { point, ray: rays, .. } = &mut background.samples;
            background.alive.retain(|&ray| {
                if left[ray as usize] < look.opaque {
                    return false;
                }
                let plane = &mut planes[ray as usize];
                let mut found = 0;
                while plane.next < look.planes as f32 {
                    let p = frame.point(plane.origin, plane.direction, 1.0 - plane.next * step);
                    if part.occupancy.bits[cell_at(p)] {
                        if found == WAVE {
                            return true;
                        }
                        point.push(p);
                        rays.push(ray);
                        found += 1;
                    }
                    plane.next += 1.0;
                }
                false
            });
            background.samples.forward(&part.field, None, from);
            background.composite(from, step, look.opaque, left, color);
            // Nearness falls from +1: minus it grows along the ray.
            let Pass { samples, along, .. } = &mut *background;
            along.extend(samples.point[from..].iter().map(|p| -p[2]));
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
const BACKGROUND_FROM: f32 = 2e-3;

#[cfg(test)]
#[path = "rays_tests.rs"]
mod tests;
