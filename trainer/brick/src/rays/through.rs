//! The way there: samples where something is, taken a few at a time until a ray is over.

use super::{Look, Pass};
use crate::evaluate::{Deformation, Samples};
use crate::march::{Found, March, SixteenMarches};
use crate::model::Part;
use crate::occupancy::Occupancy;
use crate::simd::{Simd, Task};
use crate::sixteen::POINTS;

/// Samples that a ray takes at most before it is asked whether it is over.
const MOST_AT_A_TIME: usize = 8;

/// One part of [`Rays::forward`].
pub(super) struct Through<'a> {
    pub(super) pass: &'a mut Pass,
    pub(super) marches: &'a mut [March],
    pub(super) part: &'a Part,
    pub(super) deformation: Option<&'a Deformation<'a>>,
    pub(super) step: f32,
    pub(super) look: Look,
    pub(super) left: &'a mut [f32],
    pub(super) faint: &'a mut [f32],
    pub(super) color: &'a mut [[f32; 3]],
}

impl Task for Through<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        let Self { pass, marches, part, deformation, step, look, left, faint, color } = self;
        let occupancy: &Occupancy = &part.occupancy;
        while !pass.alive.is_empty() {
            let from = pass.samples.len();
            let Pass { samples, along, alive, .. } = &mut *pass;
            let wave = (look.batch / alive.len()).clamp(1, MOST_AT_A_TIME);
            if look.everywhere {
                take_everywhere(samples, along, alive, marches, left, look.opaque, wave);
            } else {
                take_occupied::<S>(occupancy, samples, along, alive, marches, left, look.opaque, wave);
            }
            pass.samples.forward(&part.field, deformation, from);
            if look.everywhere {
                pass.silence(from, occupancy);
            }
            pass.weigh_samples::<S>(from, step, look.opaque, left);
            pass.color_samples::<S>(&part.field, from, look.faint.map(|limit| (limit, &mut *faint)), color);
        }
    }
}

/// Up to `wave` samples of each ray that goes on, where something is; `alive` keeps those that may have more.
#[allow(clippy::too_many_arguments, reason = "one call site; a struct of borrows would say no more")]
#[inline(always)]
fn take_occupied<S: Simd>(
    occupancy: &Occupancy,
    samples: &mut Samples,
    along: &mut Vec<f32>,
    alive: &mut Vec<u32>,
    marches: &mut [March],
    left: &[f32],
    opaque: f32,
    wave: usize,
) {
    let (mut sixteen, mut found) = (SixteenMarches::default(), Found::default());
    let (mut at, mut kept) = (0, 0);
    while at < alive.len() {
        let mut rays = [0u32; POINTS];
        let mut count = 0;
        while count < POINTS && at < alive.len() {
            let ray = alive[at];
            at += 1;
            if left[ray as usize] >= opaque {
                sixteen.put(count, &marches[ray as usize]);
                rays[count] = ray;
                count += 1;
            }
        }
        let mut going = ((1u32 << count) - 1) as u16;
        for _ in 0..wave {
            occupancy.next_of_sixteen::<S>(&mut sixteen, going, &mut found);
            going = found.rays;
            for i in (0..count).filter(|i| going >> i & 1 == 1) {
                samples.point.push([found.points[0][i], found.points[1][i], found.points[2][i]]);
                samples.ray.push(rays[i]);
                along.push(found.t[i]);
            }
        }
        for i in (0..count).filter(|i| going >> i & 1 == 1) {
            sixteen.take(i, &mut marches[rays[i] as usize]);
            alive[kept] = rays[i];
            kept += 1;
        }
    }
    alive.truncate(kept);
}

/// As [`take_occupied`], whatever is there.
fn take_everywhere(
    samples: &mut Samples,
    along: &mut Vec<f32>,
    alive: &mut Vec<u32>,
    marches: &mut [March],
    left: &[f32],
    opaque: f32,
    wave: usize,
) {
    alive.retain(|&ray| {
        if left[ray as usize] < opaque {
            return false;
        }
        for _ in 0..wave {
            let Some((p, t)) = marches[ray as usize].next_anywhere() else { return false };
            samples.point.push(p);
            samples.ray.push(ray);
            along.push(t);
        }
        true
    });
}
