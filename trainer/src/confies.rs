//! The paper's networks as a field: deterministic samples, in chunks of rays, without gradients.

use std::path::Path;

use burn::module::Module as _;
use burn::tensor::activation::sigmoid;
use burn::tensor::{Device, Int, Tensor, TensorData};
use glam::{DVec2, DVec3, Vec3};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use risorius_formats::{AuScale, Camera, Reporter};
use risorius_splat::Skips;

use crate::config::MaskRendering;
use crate::error::{Result, TrainerError};
use crate::expression::Expression;
use crate::field::{Between, Field, FieldRenderer, Outputs, Render};
use crate::fit::{host, points, rows};
use crate::hull::Outline;
use crate::model::{ConfiesModel, Level, RayCodes, Uncertain, Windows};
use crate::sampling;
use crate::saved::{SavedConfies, SavedModel};
use crate::volume;

/// Rays per chunk: bounds memory, large enough to keep the cores busy.
const CHUNK_RAYS: usize = 2048;
/// Pixels along a side of the tiles that rays are taken in.
const TILE: usize = 16;

/// A ray of a picture: where its pixel stands and where it goes.
type PixelRay = (usize, Vec3);

/// A fitted model of the paper.
pub struct ConfiesField {
    saved: SavedConfies,
    model: ConfiesModel,
    device: Device,
    scales: Vec<AuScale>,
    regions: usize,
    neutral_frame: usize,
    hull_in_world: Option<Vec<DVec3>>,
}

impl ConfiesField {
    /// Reads the weights of a run.
    pub fn open(saved: &SavedModel, confies: &SavedConfies, run: &Path, device: &Device) -> Result<Self> {
        Ok(Self {
            model: saved.load_confies(confies, run, device)?.no_grad(),
            saved: confies.clone(),
            device: device.clone(),
            scales: saved.table.attributes.iter().map(AuScale::new).collect(),
            regions: saved.table.regions.len(),
            neutral_frame: saved.neutral_frame,
            hull_in_world: saved.head_hull_in_world.clone(),
        })
    }

    /// The pixels of `camera` that show the avatar, with their rays, tile by tile.
    fn rays(&self, camera: &Camera) -> Vec<PixelRay> {
        let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
        let outline = self.hull_in_world.as_ref().map(|hull| Outline::of(hull, camera));
        let columns = width.div_ceil(TILE);
        let mut pixels = Vec::with_capacity(width * height);
        for tile in 0..columns * height.div_ceil(TILE) {
            let (left, top) = (tile % columns * TILE, tile / columns * TILE);
            for y in top..(top + TILE).min(height) {
                pixels.extend((left..(left + TILE).min(width)).map(|x| y * width + x));
            }
        }
        // A vector of known length, which threads fill side by side.
        let rays: Vec<Option<PixelRay>> = pixels
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

    /// How far from a camera the head ends, in the networks' units: where it was fitted alone, its hull does, else all
    /// that was fitted.
    fn behind_head(&self, camera: &Camera) -> f32 {
        let space = &self.saved.space;
        let hull = self.hull_in_world.iter().flatten();
        let farthest = hull.map(|corner| (*corner - camera.center()).length() * space.scale).reduce(f64::max);
        farthest.unwrap_or(space.far) as f32
    }

    fn omega(&self, frame: usize) -> Tensor<2> {
        self.model.latent_codes(Tensor::<1, Int>::from_data(TensorData::new(vec![frame as i32], [1]), &self.device))
    }

    fn codes(&self, expression: &Expression) -> Codes {
        let attributes: Vec<f32> = self.scales.iter().zip(&expression.0).map(|(s, i)| s.attribute(*i).0).collect();
        let count = attributes.len();
        Codes { omega: self.omega(self.neutral_frame), alpha: rows(attributes, count, &self.device) }
    }

    fn codes_between(&self, at: Between) -> Codes {
        let omega = self.omega(at.left) * (1.0 - at.t) + self.omega(at.right) * at.t;
        let none = || Tensor::zeros([1, self.model.attribute_count()], &self.device);
        let alpha = self.model.attributes_of(omega.clone()).unwrap_or_else(none);
        Codes { omega, alpha }
    }

    fn picture(&self, camera: &Camera, codes: &Codes, outputs: Outputs, reporter: &dyn Reporter) -> Result<Render> {
        let mut picture = Render::empty(camera, self.regions, outputs);
        let behind = self.behind_head(camera);
        let origin = self.saved.space.origin(camera).as_vec3();
        for chunk in self.rays(camera).chunks(CHUNK_RAYS) {
            if reporter.cancelled() {
                return Err(TrainerError::Interrupted { done: "part of a picture".to_owned() });
            }
            let directions: Vec<Vec3> = chunk.iter().map(|(_, d)| *d).collect();
            let values = self.render_rays(origin, &directions, codes, behind);
            for ((pixel, _), v) in chunk.iter().zip(values.chunks_exact(8 + self.regions)) {
                for (byte, value) in picture.rgb.as_mut()[pixel * 3..pixel * 3 + 3].iter_mut().zip(v) {
                    *byte = (value.clamp(0.0, 1.0) * 255.0).round() as u8;
                }
                if let Some(depth) = picture.depth.get_mut(*pixel) {
                    *depth = (f64::from(v[3]) / self.saved.space.scale) as f32;
                }
                if let Some(head) = picture.head.get_mut(*pixel) {
                    head.copy_from_slice(&v[4..8]);
                }
                for (n, mask) in picture.masks.iter_mut().enumerate() {
                    mask[*pixel] = v[8 + n];
                }
            }
        }
        Ok(picture)
    }

    /// RGB, depth, the head alone (RGB times opacity, opacity) and region masks (0–1) of each ray: `8 + N` numbers.
    fn render_rays(&self, origin: Vec3, directions: &[Vec3], codes: &Codes, behind: f32) -> Vec<f32> {
        let SavedConfies { coarse_samples, fine_samples, spacing, space, model: config, .. } = &self.saved;
        let device = &self.device;
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
        let of_head = weights.clone() * z.lower_equal_elem(behind).float();
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
        largest.unwrap_or_else(|| Tensor::zeros([rays, 1], &self.device))
    }
}

/// What is the same for all rays of a picture: ω `[1, latent]` and α `[1, K]`.
struct Codes {
    omega: Tensor<2>,
    alpha: Tensor<2>,
}

impl Field for ConfiesField {
    fn renderer(&self, _skips: Skips) -> Box<dyn FieldRenderer + '_> {
        Box::new(ConfiesRenderer { field: self })
    }

    fn is_dear(&self) -> bool {
        true
    }

    fn is_steered(&self) -> bool {
        self.saved.model.kind.has_attributes()
    }

    fn render_between(
        &self,
        camera: &Camera,
        between: Between,
        outputs: Outputs,
        reporter: &dyn Reporter,
    ) -> Result<Option<Render>> {
        self.picture(camera, &self.codes_between(between), outputs, reporter).map(Some)
    }
}

/// Every picture is drawn whole.
struct ConfiesRenderer<'a> {
    field: &'a ConfiesField,
}

impl FieldRenderer for ConfiesRenderer<'_> {
    fn render(
        &mut self,
        camera: &Camera,
        expression: &Expression,
        outputs: Outputs,
        reporter: &dyn Reporter,
    ) -> Result<Render> {
        self.field.picture(camera, &self.field.codes(expression), outputs, reporter)
    }
}
