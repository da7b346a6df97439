//! Batches of rays, drawn on the fly. Every draw depends on the seed and the step only, so that a resumed fit sees what
//! an uninterrupted one would have seen.

use glam::{DVec2, Vec3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::data::{TrainData, TrainFrame};
use crate::space::NetSpace;

/// Rays on the host, one entry (or row of entries) per ray.
#[derive(Clone, Debug, Default)]
pub struct RayBatch {
    /// Where the rays start, net units.
    pub origins: Vec<Vec3>,
    /// Unit directions.
    pub directions: Vec<Vec3>,
    /// Index of the training frame.
    pub frames: Vec<i32>,
    /// RGB, 0–1: 3 per ray.
    pub colors: Vec<f32>,
    /// Region masks, 0 or 1: N per ray.
    pub masks: Vec<f32>,
    /// Whether the frame has masks: N per ray.
    pub masks_given: Vec<f32>,
    /// Attributes: K per ray.
    pub attributes: Vec<f32>,
    /// Whether the frame has attributes and the attribute is active: K per ray.
    pub attributes_given: Vec<f32>,
}

impl RayBatch {
    /// Number of rays.
    pub fn len(&self) -> usize {
        self.origins.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.origins.is_empty()
    }
}

/// The random numbers of one purpose at one step.
pub fn rng_for(seed: u64, step: u64, purpose: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(step.wrapping_mul(8).wrapping_add(purpose));
    rng
}

/// Draws `rays` rays for `step`; `region_share` of them from pixels inside regions of frames that have masks.
pub fn draw(data: &TrainData, space: &NetSpace, rays: usize, region_share: f64, seed: u64, step: u64) -> RayBatch {
    let rng = &mut rng_for(seed, step, 0);
    let focused = (rays as f64 * region_share) as usize;
    let mut batch = RayBatch::default();
    let mut misses = 0;
    while batch.len() < rays {
        let index = rng.random_range(0..data.frames.len());
        let frame = &data.frames[index];
        let pixel = if batch.len() < focused && !frame.region_pixels.is_empty() {
            frame.region_pixels[rng.random_range(0..frame.region_pixels.len())]
        } else {
            match &frame.valid {
                Some(valid) => valid[rng.random_range(0..valid.len())],
                None => rng.random_range(0..frame.pixels.len() as u32 / 3),
            }
        };
        if !push(&mut batch, data, space, index, frame, pixel as usize) {
            misses += 1;
            // Beyond the fold of the lens there are no rays; a lens that is folded everywhere is refused on loading.
            if misses > 1000 * rays {
                break;
            }
        }
    }
    batch
}

fn push(
    batch: &mut RayBatch,
    data: &TrainData,
    space: &NetSpace,
    index: usize,
    frame: &TrainFrame,
    pixel: usize,
) -> bool {
    let width = frame.camera.intrinsics.width as usize;
    let position = DVec2::new((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5);
    let Some(direction) = frame.camera.ray_direction(position) else { return false };
    batch.origins.push(space.origin(&frame.camera).as_vec3());
    batch.directions.push(direction.as_vec3());
    batch.frames.push(index as i32);
    batch.colors.extend(frame.pixels[pixel * 3..pixel * 3 + 3].iter().map(|&b| f32::from(b) / 255.0));
    let label = frame.labels.as_ref().map(|l| usize::from(l[pixel]));
    for n in 0..data.table.regions.len() {
        batch.masks.push(f32::from(u8::from(label == Some(n + 1))));
        batch.masks_given.push(f32::from(u8::from(label.is_some())));
    }
    for (k, spec) in data.table.attributes.iter().enumerate() {
        let value = frame.attributes.as_ref().map(|a| a[k]);
        batch.attributes.push(value.unwrap_or(-1.0));
        batch.attributes_given.push(f32::from(u8::from(value.is_some() && spec.active)));
    }
    true
}
