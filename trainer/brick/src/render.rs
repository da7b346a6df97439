//! Pictures of a fitted avatar.

mod faint;

use std::collections::BTreeMap;
use std::sync::{Mutex, OnceLock};

use rayon::prelude::*;

pub use self::faint::NOTHING;
use self::faint::Without;
use crate::bake::{Baked, Crossed};
use crate::evaluate::Deformation;
use crate::expression::{CHANNELS, MASKS, REST};
use crate::lattice::BRICK;
use crate::march::March;
use crate::model::{Brick, activation, deformation};
use crate::rays::{Look, Rays};
use crate::sixteen::POINTS;
use crate::skips::Skips;

/// Rays that travel together.
const CHUNK: usize = 256;
/// Samples that go through the network together.
const BATCH: usize = 256;
/// A ray that lets less than this through is over. No colour exceeds 1, so what is left out changes a pixel by less.
const OPAQUE: f32 = 1.0 / 640.0;
/// Samples that are less than this of a ray together show no colour; with [`OPAQUE`], below 1/512.
const FAINT: f32 = 1.0 / 2600.0;
const _: () = assert!(OPAQUE + FAINT < 1.0 / 512.0, "what skips may change");

/// What a ray shows.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Shown {
    /// Colour without what lies behind everything, 0–1.
    pub color: [f32; 3],
    /// How much of what lies behind everything shows.
    pub left: f32,
    /// The head alone: its colour times its opacity, then its opacity, 0–1.
    pub head: [f32; 4],
    /// Masks of the regions.
    pub masks: [f32; MASKS],
    /// Mean distance of the head along the ray, world units; 0 where it is not met.
    pub depth: f32,
    /// A bit for each region whose AUs can change what the ray shows.
    pub touched: u8,
}

/// The avatar in one expression.
#[derive(Debug)]
pub struct Face<'a> {
    model: &'a Brick,
    activations: Vec<f32>,
    blend: Vec<f32>,
    gates: Vec<f32>,
    latent: Vec<f32>,
    /// B without the AUs of a set of regions (a bit each), once it was asked for: it stays while the camera moves, and
    /// while only those AUs do.
    without: Box<[OnceLock<Vec<f32>>; 1 << REST]>,
    /// Memory of rays that are through.
    scratch: Mutex<Vec<Rays>>,
    /// What is left out.
    pub skips: Skips,
}

/// A picture of a [`Face`] that can be brought up to date after an edit.
#[derive(Clone, Debug)]
pub struct FacePicture {
    origin: [f32; 3],
    directions: Vec<[f32; 3]>,
    /// What each ray shows.
    pub shown: Vec<Shown>,
    /// What rays show without the AUs of a set of regions (a bit each), as far as it was asked for.
    without: Box<Without>,
}

impl<'a> Face<'a> {
    /// The expression of attributes, −1..1.
    pub fn new(model: &'a Brick, attributes: &[f32]) -> Self {
        let gates = model.expression.gates();
        let code = model.code(model.neutral_image);
        let activations: Vec<f32> = attributes.iter().map(|&a| activation(a)).chain(code.iter().copied()).collect();
        let mut latent = Vec::new();
        model.latent_blend(code, &mut latent);
        let blend = vec![0.0; model.expression.lattice.slots * BRICK * CHANNELS];
        let (without, scratch, skips) = (Box::default(), Mutex::default(), Skips::default());
        let mut face = Self { model, activations, blend, gates, latent, without, scratch, skips };
        face.blend_again(|_| true);
        face
    }

    /// Changes the expression; gives a bit for each region that changes with it.
    pub fn edit(&mut self, attributes: &[f32]) -> u8 {
        let mut changed = 0u8;
        for (k, (&a, old)) in attributes.iter().zip(&mut self.activations).enumerate() {
            let new = activation(a);
            if new.to_bits() != old.to_bits() {
                *old = new;
                changed |= 1 << self.model.expression.region_of[k];
            }
        }
        if changed != 0 {
            let stale = self.model.expression.slots_in(changed);
            self.blend_again(|slot| stale[slot]);
            outdated(&mut *self.without, changed).for_each(|blend| {
                blend.take();
            });
        }
        changed
    }

    fn blend_again(&mut self, stale: impl Fn(usize) -> bool + Sync) {
        let Self { model, activations, blend, gates, .. } = self;
        blend.par_chunks_exact_mut(BRICK * CHANNELS).enumerate().filter(|(slot, _)| stale(*slot)).for_each(
            |(slot, out)| {
                model.expression.blend_slot(gates, activations, slot, out);
            },
        );
    }

    /// What rays from `origin` along `directions` (unit, world) show, in parallel.
    pub fn render(&self, origin: [f32; 3], directions: &[[f32; 3]]) -> Vec<Shown> {
        self.picture(origin, directions.to_vec()).shown
    }

    /// The same, to be brought up to date later.
    pub fn picture(&self, origin: [f32; 3], directions: Vec<[f32; 3]>) -> FacePicture {
        let mut picture = FacePicture { origin, directions: Vec::new(), shown: Vec::new(), without: Box::default() };
        self.take_again(&mut picture, origin, directions);
        picture
    }

    /// The same in the memory of another picture.
    pub fn take_again(&self, picture: &mut FacePicture, origin: [f32; 3], directions: Vec<[f32; 3]>) {
        (picture.origin, picture.directions) = (origin, directions);
        picture.without.iter_mut().for_each(BTreeMap::clear);
        picture.shown.resize(picture.directions.len(), Shown::default());
        self.render_with(&self.blend, origin, &picture.directions, &mut picture.shown);
        self.hush(picture, None);
    }

    /// Brings a picture up to date after [`Self::edit`] named the regions that `changed`; gives the rays that had to be
    /// sent. All others would show the same to the bit.
    pub fn redraw(&self, picture: &mut FacePicture, changed: u8) -> Vec<usize> {
        let stale = |shown: &Shown| shown.touched & changed != 0 || !self.skips.unchanged;
        let stale: Vec<usize> = (0..picture.shown.len()).filter(|&i| stale(&picture.shown[i])).collect();
        outdated(&mut *picture.without, changed).for_each(BTreeMap::clear);
        let wanted: Vec<[f32; 3]> = stale.iter().map(|&i| picture.directions[i]).collect();
        let mut shown = vec![Shown::default(); wanted.len()];
        self.render_with(&self.blend, picture.origin, &wanted, &mut shown);
        stale.iter().zip(shown).for_each(|(&i, shown)| picture.shown[i] = shown);
        self.hush(picture, Some(&stale));
        stale
    }

    /// What rays show by another B, as they come.
    fn render_with(&self, blend: &[f32], origin: [f32; 3], directions: &[[f32; 3]], out: &mut [Shown]) {
        out.par_chunks_mut(CHUNK).zip(directions.par_chunks(CHUNK)).for_each_init(
            || Borrowed::new(&self.scratch),
            |rays, (out, directions)| {
                self.send(&mut rays.rays, blend, origin, directions, |i, shown| out[i] = shown);
            },
        );
    }

    fn deformation(&self) -> Deformation<'_> {
        deformation(self.model, &self.blend, &self.gates, Some(&self.latent))
    }

    fn send(
        &self,
        rays: &mut Rays,
        blend: &[f32],
        origin: [f32; 3],
        directions: &[[f32; 3]],
        mut show: impl FnMut(usize, Shown),
    ) {
        let model = self.model;
        let deformation = deformation(model, blend, &self.gates, Some(&self.latent));
        let look = Look {
            divisions: model.divisions,
            planes: model.planes,
            opaque: if self.skips.hidden { OPAQUE } else { 0.0 },
            batch: BATCH,
            faint: self.skips.faint.then_some(FAINT),
            tells_acts: true,
            everywhere: !self.skips.empty_space,
        };
        rays.forward(model, &deformation, None, origin, directions, || 0.5, look);
        for r in 0..directions.len() {
            let ([sum, weight], [red, green, blue]) = (rays.depth[r], rays.head_color[r]);
            let shown = Shown {
                color: rays.color[r],
                left: rays.left[r],
                head: [red, green, blue, weight],
                masks: rays.masks[r],
                depth: if weight > 0.5 { sum / weight } else { 0.0 },
                touched: rays.touched[r],
            };
            show(r, shown);
        }
    }
}

/// Of what is kept without the AUs of each set of regions: what AUs of the regions in `changed` have a part in.
fn outdated<T>(without: &mut [T], changed: u8) -> impl Iterator<Item = &mut T> {
    (0u8..).zip(without).filter(move |(set, _)| changed & !set != 0).map(|(_, kept)| kept)
}

/// Rays' memory on loan: new memory costs a page fault for each 4 KiB.
struct Borrowed<'a> {
    pool: &'a Mutex<Vec<Rays>>,
    rays: Rays,
}

impl<'a> Borrowed<'a> {
    fn new(pool: &'a Mutex<Vec<Rays>>) -> Self {
        let rays = pool.lock().ok().and_then(|mut pool| pool.pop()).unwrap_or_default();
        Self { pool, rays }
    }
}

impl Drop for Borrowed<'_> {
    fn drop(&mut self) {
        if let Ok(mut pool) = self.pool.lock() {
            pool.push(std::mem::take(&mut self.rays));
        }
    }
}

/// Vertices of the baked head along each edge, and of the baked background.
const BAKED_HEAD: usize = 256;
const BAKED_BACKGROUND: [usize; 3] = [512, 384, 64];
/// An edit bakes again what it changes by more than this: features, and displacements in box units.
const EDIT_TOLERANCE: [f32; 2] = [1e-3, 1e-4];

/// The avatar baked for one expression: pictures from anywhere at many times the speed, with an error that is to be
/// measured against [`Face`].
#[derive(Debug)]
pub struct BakedFace<'a> {
    face: Face<'a>,
    head: Baked,
    background: Option<Baked>,
    eye: [f32; 3],
    /// Bricks that edits changed since the last picture was brought up to date.
    stale: Vec<bool>,
}

/// A picture of a baked face that can be brought up to date after an edit.
#[derive(Clone, Debug)]
pub struct BakedPicture {
    origin: [f32; 3],
    directions: Vec<[f32; 3]>,
    /// What each ray shows; without masks.
    pub shown: Vec<Shown>,
    crossed: Vec<Crossed>,
}

impl<'a> BakedFace<'a> {
    /// Bakes the expression of attributes, −1..1, as seen from `eye` (world).
    pub fn new(model: &'a Brick, attributes: &[f32], eye: [f32; 3]) -> Self {
        let face = Face::new(model, attributes);
        let head = Baked::new(&model.head, Some(&face.deformation()), [BAKED_HEAD; 3], |p| model.seen_in_head(eye, p));
        let frames = model.background.as_ref().zip(model.layout.background.as_ref());
        let background = frames.map(|(part, frame)| Baked::new(part, None, BAKED_BACKGROUND, |p| frame.seen(p)));
        Self { face, head, background, eye, stale: Vec::new() }
    }

    /// Baked vertices of head and background.
    pub fn vertices(&self) -> [usize; 2] {
        [self.head.len(), self.background.as_ref().map_or(0, Baked::len)]
    }

    /// Changes the expression; bakes anew what changes with it.
    pub fn edit(&mut self, attributes: &[f32]) {
        let before = self.face.blend.clone();
        if self.face.edit(attributes) == 0 {
            return;
        }
        let model = self.face.model;
        let changed: Vec<bool> = before
            .as_chunks::<CHANNELS>()
            .0
            .iter()
            .zip(self.face.blend.as_chunks::<CHANNELS>().0)
            .map(|(a, b)| {
                let apart = |c: usize| (a[c] - b[c]).abs();
                [0, 1, 2, 3, 7].iter().any(|&c| apart(c) > EDIT_TOLERANCE[0])
                    || (4..7).any(|c| apart(c) > EDIT_TOLERANCE[1])
            })
            .collect();
        let lattice = &model.expression.lattice;
        let stale = |p: [f32; 3]| lattice.corners(p).index.iter().any(|&i| changed[i as usize]);
        let eye = self.eye;
        let deformation = self.face.deformation();
        let now = self.head.bake(&model.head.field, Some(&deformation), |p| model.seen_in_head(eye, p), stale);
        self.stale.resize(now.len(), false);
        self.stale.iter_mut().zip(now).for_each(|(old, new)| *old |= new);
    }

    /// A picture of rays from `origin` along `directions` (unit, world).
    pub fn picture(&mut self, origin: [f32; 3], directions: Vec<[f32; 3]>) -> BakedPicture {
        self.stale.fill(false);
        let (shown, crossed) = self.send_all(origin, &directions).into_iter().unzip();
        BakedPicture { origin, directions, shown, crossed }
    }

    /// Brings a picture up to date after edits; gives the rays that had to be sent.
    pub fn redraw(&mut self, picture: &mut BakedPicture) -> Vec<usize> {
        if !self.stale.contains(&true) {
            return Vec::new();
        }
        let BakedPicture { origin, directions, shown, crossed } = picture;
        let stale: Vec<usize> = (0..crossed.len()).filter(|&i| crossed[i].any(&self.stale)).collect();
        let wanted: Vec<[f32; 3]> = stale.iter().map(|&i| directions[i]).collect();
        for (&i, new) in stale.iter().zip(self.send_all(*origin, &wanted)) {
            (shown[i], crossed[i]) = new;
        }
        self.stale.fill(false);
        stale
    }

    /// What rays show, sixteen at a time.
    fn send_all(&self, origin: [f32; 3], directions: &[[f32; 3]]) -> Vec<(Shown, Crossed)> {
        let mut out = vec![(Shown::default(), Crossed::NONE); directions.len()];
        out.par_chunks_mut(CHUNK).zip(directions.par_chunks(CHUNK)).for_each(|(out, directions)| {
            for (out, directions) in out.chunks_mut(POINTS).zip(directions.chunks(POINTS)) {
                self.send(origin, directions, out);
            }
        });
        out
    }

    fn send(&self, origin: [f32; 3], directions: &[[f32; 3]], out: &mut [(Shown, Crossed)]) {
        let model = self.face.model;
        let march = |&d: &[f32; 3]| model.head_march(origin, d, None, model.divisions, 0.5);
        let marches: Vec<March> = directions.iter().map(march).collect();
        let head = self.head.send(&model.head, &marches, &[1.0; POINTS][..marches.len()], OPAQUE);
        for ((shown, crossed), through) in out.iter_mut().zip(&head) {
            let ([sum, weight], [red, green, blue]) = (through.depth, through.color);
            *shown = Shown {
                color: through.color,
                left: through.left,
                head: [red, green, blue, weight],
                depth: if weight > 0.5 { sum / weight * model.layout.head_box.half } else { 0.0 },
                ..Shown::default()
            };
            *crossed = through.crossed;
        }
        let (Some(part), Some(frame), Some(baked)) = (&model.background, &model.layout.background, &self.background)
        else {
            return;
        };
        let from_camera = frame.camera_from_world(origin);
        let (mut marches, mut left, mut rays) = (Vec::new(), Vec::new(), Vec::new());
        for (ray, (direction, (shown, _))) in directions.iter().zip(&*out).enumerate() {
            let march = frame.march(from_camera, frame.turn(*direction), model.planes, 0.5);
            if let Some(march) = march.filter(|_| shown.left > OPAQUE) {
                marches.push(march);
                left.push(shown.left);
                rays.push(ray);
            }
        }
        let behind = baked.send(part, &marches, &left, OPAQUE);
        for (&ray, through) in rays.iter().zip(&behind) {
            let (shown, _) = &mut out[ray];
            shown.left = through.left;
            (0..3).for_each(|c| shown.color[c] += through.color[c]);
        }
    }
}

#[cfg(test)]
#[path = "render_tests.rs"]
mod tests;
