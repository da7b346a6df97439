//! A fitted avatar, and how it is rendered: deterministic samples, in chunks of rays, without gradients.

use std::collections::BTreeMap;
use std::path::Path;

use burn::module::Module as _;
use burn::tensor::activation::sigmoid;
use burn::tensor::{Device, Int, Tensor, TensorData};
use glam::{DVec2, Vec3};
use image::RgbImage;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use risorius_brick::Brick;
use risorius_formats::{ActionUnit, AttributeSpec, Camera, Reporter};

use crate::brick::plate::Plate;
use crate::brick::store;
use crate::config::MaskRendering;
use crate::error::{Result, TrainerError};
use crate::fit::{host, points, rows};
use crate::hull::Outline;
use crate::model::{ConfiesModel, Level, RayCodes, Uncertain, Windows};
use crate::sampling;
use crate::saved::{SavedConfies, SavedField, SavedModel};
use crate::space::NetSpace;
use crate::studio::{Look, Studio};
use crate::volume;

/// Rays per chunk: bounds memory, large enough to keep the cores busy.
const CHUNK_RAYS: usize = 2048;
/// What is painted where nothing was fitted.
const BACKDROP: [u8; 3] = [128, 128, 128];

/// One rendered picture.
#[derive(Clone, Debug)]
pub struct Render {
    /// The picture.
    pub rgb: RgbImage,
    /// Region mask probabilities, 0–1: N planes of `width · height`.
    pub masks: Vec<Vec<f32>>,
    /// Expected depth along the ray, world units; 0 where nothing was fitted.
    pub depth: Vec<f32>,
    /// The head alone, where the look asks for it: colour times opacity, then opacity, 0–1. See [`crate::cutout`].
    pub head: Vec<[f32; 4]>,
}

/// A fitted avatar.
pub struct Avatar {
    /// What is known about it.
    pub saved: SavedModel,
    field: Fitted,
}

enum Fitted {
    Confies { saved: Box<SavedConfies>, model: Box<ConfiesModel>, device: Device },
    Brick { model: Box<Brick>, plate: Option<Plate> },
}

/// A place between two training frames.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Between {
    /// Index of the one.
    pub left: usize,
    /// Index of the other.
    pub right: usize,
    /// 0 at the left, 1 at the right.
    pub t: f32,
}

/// A ray of a picture: where its pixel stands and where it goes.
pub(crate) type Wanted = (usize, Vec3);

impl Avatar {
    /// Opens the avatar of a run.
    pub fn open(run: impl AsRef<Path>, device: &Device) -> Result<Self> {
        let run = run.as_ref();
        let saved = SavedModel::read(run)?;
        let field = match &saved.field {
            SavedField::Confies(confies) => {
                let model = Box::new(saved.load_confies(confies, run, device)?.no_grad());
                Fitted::Confies { saved: Box::new(confies.clone()), model, device: device.clone() }
            }
            SavedField::Brick(brick) => {
                let (model, plate) = store::avatar::read(&run.join("model.safetensors"), brick)?;
                Fitted::Brick { model: Box::new(model), plate }
            }
        };
        Ok(Self { saved, field })
    }

    /// The neutral face.
    pub fn neutral_attributes(&self) -> Vec<f32> {
        self.saved.table.attributes.iter().map(AttributeSpec::neutral_attribute).collect()
    }

    /// Attributes of an expression given as AU intensities 0–5; AUs left out are neutral, AUs the avatar does not know
    /// are returned by name.
    pub fn attributes_from_intensities(&self, intensities: &BTreeMap<ActionUnit, f32>) -> (Vec<f32>, Vec<ActionUnit>) {
        let mut attributes = self.neutral_attributes();
        let mut unknown = Vec::new();
        for (&unit, &value) in intensities {
            match self.saved.table.index_of(unit) {
                Some(k) if self.saved.table.attributes[k].active => {
                    attributes[k] = self.attribute_from_intensity(&self.saved.table.attributes[k], value);
                }
                _ if value.abs() < 1e-6 => {}
                _ => unknown.push(unit),
            }
        }
        (attributes, unknown)
    }

    /// How many times a view can be reduced before its pixels grow coarser than those that were fitted.
    pub fn spare_resolution(&self, camera: &Camera) -> u32 {
        ((camera.intrinsics.fx / self.saved.default_camera.fx + 0.1) as u32).clamp(1, 16)
    }

    /// The attribute of an intensity 0–5 by `spec`'s range, as this avatar knows it.
    pub fn attribute_from_intensity(&self, spec: &AttributeSpec, intensity: f32) -> f32 {
        match &self.saved.field {
            SavedField::Brick(brick) if brick.uncapped => spec.uncapped_attribute_from_intensity(intensity),
            _ => spec.attribute_from_intensity(intensity),
        }
    }

    /// The brick field, if it is one.
    pub fn brick_model(&self) -> Option<&Brick> {
        self.brick().map(|(model, _)| model)
    }

    pub(crate) fn brick(&self) -> Option<(&Brick, Option<&Plate>)> {
        match &self.field {
            Fitted::Brick { model, plate } => Some((model, plate.as_ref())),
            Fitted::Confies { .. } => None,
        }
    }

    /// The pixels of `camera` that show the avatar, with their rays, tile by tile: neighbours meet the same bricks.
    pub(crate) fn wanted(&self, camera: &Camera) -> Vec<Wanted> {
        const TILE: usize = 16;
        let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
        let outline = self.saved.head_hull_in_world.as_ref().map(|hull| Outline::of(hull, camera));
        let columns = width.div_ceil(TILE);
        let mut pixels = Vec::with_capacity(width * height);
        for tile in 0..columns * height.div_ceil(TILE) {
            let (left, top) = (tile % columns * TILE, tile / columns * TILE);
            for y in top..(top + TILE).min(height) {
                pixels.extend((left..(left + TILE).min(width)).map(|x| y * width + x));
            }
        }
        // A vector of known length, which threads fill side by side.
        let rays: Vec<Option<Wanted>> = pixels
            .into_par_iter()
            .map(|pixel| {
                let p = DVec2::new((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5);
                if outline.as_ref().is_some_and(|o| !o.contains(p)) {
                    return None;
                }
                camera.ray_direction(p).map(|direction| (pixel, direction.as_vec3()))
            })
            .collect();
        rays.into_iter().flatten().collect()
    }

    /// Renders `camera` with the attributes (−1..1, K of them), every pixel.
    pub fn render(&self, camera: &Camera, attributes: &[f32], reporter: &dyn Reporter) -> Result<Render> {
        Studio::new(self, Look::default()).render(camera, attributes, reporter)
    }

    pub(crate) fn render_networks(
        &self,
        camera: &Camera,
        attributes: &[f32],
        cutout: bool,
        reporter: &dyn Reporter,
    ) -> Result<Option<Render>> {
        let Fitted::Confies { saved, model, device } = &self.field else { return Ok(None) };
        let mut picture = Render::empty(camera, self.saved.table.regions.len());
        let behind = self.behind_head(&saved.space, camera);
        let networks = Networks { saved, model, device, behind };
        let codes = networks.codes(self.saved.neutral_frame, attributes);
        if cutout {
            picture.head = vec![[0.0; 4]; picture.depth.len()];
        }
        networks.render(camera, &codes, &self.wanted(camera), &mut picture, reporter)?;
        Ok(Some(picture))
    }

    /// Renders `camera` with codes between those of two training frames and the attributes that the codes themselves
    /// give, as the paper's interpolation test does; `None` for the brick field, which has no codes to interpolate.
    pub fn render_between(&self, camera: &Camera, between: Between, reporter: &dyn Reporter) -> Result<Option<Render>> {
        let Fitted::Confies { saved, model, device } = &self.field else { return Ok(None) };
        let mut picture = Render::empty(camera, self.saved.table.regions.len());
        let behind = self.behind_head(&saved.space, camera);
        let networks = Networks { saved, model, device, behind };
        networks.render(camera, &networks.codes_between(between), &self.wanted(camera), &mut picture, reporter)?;
        Ok(Some(picture))
    }

    /// How far from a camera the head ends, in the networks' units: where it was fitted alone, its hull does, else all
    /// that was fitted.
    fn behind_head(&self, space: &NetSpace, camera: &Camera) -> f32 {
        let hull = self.saved.head_hull_in_world.iter().flatten();
        let farthest = hull.map(|corner| (*corner - camera.center()).length() * space.scale).reduce(f64::max);
        farthest.unwrap_or(space.far) as f32
    }

    /// Whether attributes steer it: of the models that CoNFies is compared with, some know codes only.
    pub fn is_steered(&self) -> bool {
        match &self.field {
            Fitted::Confies { saved, .. } => saved.model.kind.has_attributes(),
            Fitted::Brick { .. } => true,
        }
    }
}

impl Render {
    pub(crate) fn empty(camera: &Camera, regions: usize) -> Self {
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let count = width as usize * height as usize;
        Self {
            rgb: RgbImage::from_pixel(width, height, image::Rgb(BACKDROP)),
            masks: vec![vec![0.0; count]; regions],
            depth: vec![0.0; count],
            head: Vec::new(),
        }
    }
}

/// The paper's networks at work.
struct Networks<'a> {
    saved: &'a SavedConfies,
    model: &'a ConfiesModel,
    device: &'a Device,
    /// How far along a ray the head may reach.
    behind: f32,
}

/// What is the same for all rays of a picture: ω `[1, latent]` and α `[1, K]`.
struct Codes {
    omega: Tensor<2>,
    alpha: Tensor<2>,
}

impl Networks<'_> {
    fn omega(&self, frame: usize) -> Tensor<2> {
        self.model.latent_codes(Tensor::<1, Int>::from_data(TensorData::new(vec![frame as i32], [1]), self.device))
    }

    fn codes(&self, frame: usize, attributes: &[f32]) -> Codes {
        Codes { omega: self.omega(frame), alpha: rows(attributes.to_vec(), attributes.len(), self.device) }
    }

    fn codes_between(&self, at: Between) -> Codes {
        let omega = self.omega(at.left) * (1.0 - at.t) + self.omega(at.right) * at.t;
        let none = || Tensor::zeros([1, self.model.attribute_count()], self.device);
        let alpha = self.model.attributes_of(omega.clone()).unwrap_or_else(none);
        Codes { omega, alpha }
    }

    fn render(
        &self,
        camera: &Camera,
        codes: &Codes,
        wanted: &[Wanted],
        picture: &mut Render,
        reporter: &dyn Reporter,
    ) -> Result<()> {
        let origin = self.saved.space.origin(camera).as_vec3();
        for chunk in wanted.chunks(CHUNK_RAYS) {
            if reporter.cancelled() {
                return Err(TrainerError::Interrupted { done: "part of a picture".to_owned() });
            }
            let directions: Vec<Vec3> = chunk.iter().map(|(_, d)| *d).collect();
            let values = self.render_rays(origin, &directions, codes);
            let stride = 8 + picture.masks.len();
            for ((pixel, _), v) in chunk.iter().zip(values.chunks_exact(stride)) {
                for (byte, value) in picture.rgb.as_mut()[pixel * 3..pixel * 3 + 3].iter_mut().zip(v) {
                    *byte = (value.clamp(0.0, 1.0) * 255.0).round() as u8;
                }
                picture.depth[*pixel] = (f64::from(v[3]) / self.saved.space.scale) as f32;
                if let Some(head) = picture.head.get_mut(*pixel) {
                    head.copy_from_slice(&v[4..8]);
                }
                for (n, mask) in picture.masks.iter_mut().enumerate() {
                    mask[*pixel] = v[8 + n];
                }
            }
        }
        Ok(())
    }

    /// RGB, depth, the head alone (RGB times opacity, opacity) and region masks (0–1) of each ray: `8 + N` numbers.
    fn render_rays(&self, origin: Vec3, directions: &[Vec3], codes: &Codes) -> Vec<f32> {
        let SavedConfies { coarse_samples, fine_samples, spacing, space, model: config, .. } = self.saved;
        let device = self.device;
        let r = directions.len();
        let all = |t: &Tensor<2>| {
            let width = t.dims()[1];
            t.clone().expand([r, width])
        };
        let codes = RayCodes {
            omega: all(&codes.omega),
            alpha: all(&codes.alpha),
            directions: rows(directions.iter().flat_map(Vec3::to_array).collect(), 3, device),
        };
        let origins = vec![origin; r];
        let windows = Windows::open(config);
        let evaluate = |level, depths: &[f32]| {
            let samples = depths.len() / r;
            let points = points(&origins, directions, depths, device);
            let out = self.model.evaluate(level, points, &codes, windows, &Uncertain::None);
            let weights = volume::weights(out.density.clone(), rows(volume::deltas(depths, samples), samples, device));
            (out, weights)
        };
        let mut ray = Vec::new();
        sampling::stratified(
            &mut ray,
            *coarse_samples,
            space.near as f32,
            space.far as f32,
            *spacing,
            None::<&mut ChaCha8Rng>,
        );
        let coarse = ray.repeat(r);
        let weights = host(evaluate(Level::Coarse, &coarse).1);
        let mut fine = Vec::with_capacity(r * (coarse_samples + fine_samples));
        for w in weights.chunks_exact(*coarse_samples) {
            sampling::union(&mut fine, &ray, w, *fine_samples, None::<&mut ChaCha8Rng>);
        }
        let (out, weights) = evaluate(Level::Fine, &fine);
        let samples = coarse_samples + fine_samples;
        let z = rows(fine, samples, device);
        let depth = (weights.clone() * z.clone()).sum_dim(1);
        let of_head = weights.clone() * z.lower_equal_elem(self.behind).float();
        let head = volume::composite(of_head.clone(), out.color.clone());
        let color = volume::composite(weights.clone(), out.color);
        let masks = out.mask_logits.map(|logits| match self.saved.mask_rendering {
            MaskRendering::Logits => sigmoid(volume::composite(weights, logits)),
            MaskRendering::Probabilities => volume::composite(weights, sigmoid(logits)),
        });
        let mut parts = vec![color, depth, head, of_head.sum_dim(1)];
        parts.extend((0..self.model.region_count()).map(|n| self.region_mask(masks.as_ref(), n, r)));
        host(Tensor::cat(parts, 1))
    }

    /// The mask of a region: its own, or the largest of its attributes' masks, or zeros where there are none.
    fn region_mask(&self, masks: Option<&Tensor<2>>, region: usize, rays: usize) -> Tensor<2> {
        let of = |(i, _): (usize, usize)| masks.map(|m| m.clone().narrow(1, i, 1));
        let own = self.model.mask_regions().into_iter().enumerate().filter(|(_, n)| *n == region);
        let largest = own.filter_map(of).reduce(Tensor::max_pair);
        largest.unwrap_or_else(|| Tensor::zeros([rays, 1], self.device))
    }
}
