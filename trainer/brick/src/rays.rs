//! A chunk of rays on its way through the head and the background: forward in waves that end when a ray is opaque,
//! backward through the samples that counted.
//!
//! Within a ray, samples stand in the order of their depth; rays of a chunk are mixed. So both ways are single passes
//! over the samples with one running state per ray.

mod pass;
mod through;

use self::pass::Behind;
pub(crate) use self::pass::{Pass, Prior};
use self::through::Through;
use crate::evaluate::{Deformation, DeformationGrad, Lot};
use crate::expression::MASKS;
use crate::field::{Field, FieldGrad, Transposed};
use crate::march::March;
use crate::model::{BackgroundFrame, Brick, Part};
use crate::simd::{self, Simd, Task};

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
    /// A bit for each region whose AUs can change some sample of the ray; told for pictures only.
    pub(crate) touched: Vec<u8>,
    marches: Vec<March>,
    /// Weight of each ray's samples that stayed without colour.
    faint: Vec<f32>,
    behind: Vec<Behind>,
}

/// Gradients of what rays show, one per ray.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Upstream<'a> {
    /// Of the colour.
    pub(crate) color: &'a [[f32; 3]],
    /// Of the transmittance behind everything.
    pub(crate) left: &'a [f32],
    /// Of the masks.
    pub(crate) masks: Option<&'a [[f32; MASKS]]>,
    /// Of the depth's two sums.
    pub(crate) depth: Option<&'a [[f32; 2]]>,
    /// What the priors are multiplied by; 1 without.
    pub(crate) regular: Option<&'a [f32]>,
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
    /// How much of a ray may stay without its colour, where that is not worked out for faint samples; `None` colours all, as
    /// the way back needs.
    pub(crate) faint: Option<f32>,
    /// Whether rays are to know which regions' AUs can change them.
    pub(crate) tells_acts: bool,
    /// Whether samples are also taken where nothing is, for measuring what their absence saves. They show nothing.
    pub(crate) everywhere: bool,
}

impl Look {
    /// The background is looked at behind a head that lets more than this through.
    fn background_from(&self) -> f32 {
        if self.opaque > 0.0 { BACKGROUND_FROM } else { -1.0 }
    }
}

impl Rays {
    /// The priors' value for each ray: thin density and spread weights of head and background.
    pub(crate) fn regular(&self, look: Look, prior: [Prior; 2]) -> Vec<f32> {
        let mut out = vec![0.0; self.color.len()];
        self.head.add_regular(2.0 / look.divisions as f32, prior[0], &mut out);
        self.background.add_regular(2.0 / look.planes as f32, prior[1], &mut out);
        out
    }

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
        self.faint.clear();
        self.faint.resize(n, 0.0);
        self.head.begin(directions);
        self.head.samples.tells_acts = look.tells_acts;
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
        let Self { head, color, left, masks, depth, touched, marches, faint, .. } = self;
        marches.clear();
        for (ray, &direction) in (0u32..).zip(directions) {
            let march = model.head_march(origin, direction, motion, look.divisions, jitter());
            if march.t() < march.exit {
                head.alive.push(ray);
            }
            marches.push(march);
        }
        let (part, step) = (&model.head, 2.0 / look.divisions as f32);
        simd::run(Through {
            pass: head,
            marches,
            part,
            deformation: Some(deformation),
            step,
            look,
            left,
            faint,
            color,
        });
        let half = model.layout.head_box.half;
        for i in 0..head.samples.len() {
            if head.alpha[i] < 0.0 {
                continue;
            }
            let (ray, w) = (head.samples.ray[i] as usize, head.weight(i));
            depth[ray] = [depth[ray][0] + w * head.along[i] * half, depth[ray][1] + w];
            if head.samples.in_region(i) {
                for (sum, m) in masks[ray].iter_mut().zip(head.samples.masks[i]) {
                    *sum += w * m;
                }
                touched[ray] |= head.samples.acts(i);
            }
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
        let Self { background, color, left, marches, faint, .. } = self;
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
        simd::run(Through { pass: background, marches, part, deformation: None, step, look, left, faint, color });
    }

    /// The way back of what `upstream` says of each ray.
    #[allow(clippy::too_many_arguments, reason = "two call sites; a struct of borrows would say no more")]
    pub(crate) fn backward(
        &mut self,
        model: &Brick,
        deformation: &Deformation<'_>,
        transposed: [Option<&Transposed>; 2],
        look: Look,
        upstream: Upstream<'_>,
        prior: [Prior; 2],
        lot: Lot,
        grads: [&mut FieldGrad; 2],
        deformation_grad: &mut DeformationGrad<'_>,
    ) {
        self.behind.clear();
        self.behind.extend(
            self.left.iter().zip(upstream.left).map(|(left, d)| Behind { suffix: left * d, ..Behind::default() }),
        );
        let [head_grad, background_grad] = grads;
        let half = model.layout.head_box.half;
        simd::run(Decomposite { rays: self, look, half, upstream, prior });
        let Self { head, background, .. } = self;
        let n = head.samples.len();
        head.samples.d_masks.clear();
        head.samples.d_masks.resize(n, [0.0; MASKS]);
        if let Some(d_masks) = upstream.masks {
            for i in 0..n {
                // The weights are constants here: masks must not bend the shape (stop-gradient on density).
                let w = head.weight(i);
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
    /// World units of a box unit.
    half: f32,
    upstream: Upstream<'a>,
    prior: [Prior; 2],
}

impl Task for Decomposite<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        let Self { rays: Rays { head, background, behind, .. }, look, half, upstream, prior } = self;
        // Depth is the head's alone.
        let of_background = Upstream { depth: None, ..upstream };
        background.decomposite(2.0 / look.planes as f32, 0.0, of_background, behind, prior[1]);
        head.decomposite(2.0 / look.divisions as f32, half, upstream, behind, prior[0]);
    }
}

/// Behind a head that lets less than this through, the background is not looked at.
const BACKGROUND_FROM: f32 = 1.0 / 640.0;

#[cfg(test)]
#[path = "rays_tests.rs"]
mod tests;
