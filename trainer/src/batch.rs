//! Batches of rays, drawn on the fly (fact sheet §2.4). Every draw depends on the seed and the step only, so that a resumed fit sees what
//! an uninterrupted one would have seen.

use glam::{DVec2, Vec3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::config::{FitSettings, RayOrder};
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

/// How rays are drawn.
#[derive(Clone, Copy, Debug)]
pub struct Draw {
    /// Rays per step.
    pub rays: usize,
    /// Share of the rays drawn from pixels inside region masks of frames that have them.
    pub region_share: f64,
    /// Share of the rays drawn from annotated frames, where there are frames of both sorts.
    pub annotated_share: f64,
    /// Their order.
    pub order: RayOrder,
    /// The seed.
    pub seed: u64,
}

impl From<&FitSettings> for Draw {
    fn from(s: &FitSettings) -> Self {
        Self {
            rays: s.rays,
            region_share: s.region_share,
            annotated_share: s.annotated_share,
            order: s.ray_order,
            seed: s.seed,
        }
    }
}

/// Draws the rays of `step`. Those of annotated frames come first where the settings ask for a share of them.
pub fn draw(data: &TrainData, space: &NetSpace, how: &Draw, step: u64) -> RayBatch {
    let mut batch = RayBatch::default();
    let rng = &mut rng_for(how.seed, step, 0);
    let all = || (0..data.frames.len()).collect::<Vec<_>>();
    let (annotated, others): (Vec<usize>, Vec<usize>) =
        all().into_iter().partition(|&i| data.frames[i].attributes.is_some());
    // The released loader stops where one of its two streams is empty, as in every capture with AUs throughout.
    if how.annotated_share > 0.0 && !annotated.is_empty() && !others.is_empty() {
        let first = (how.rays as f64 * how.annotated_share) as usize;
        fill(&mut batch, data, space, how, &annotated, [first, 1], rng, step);
        fill(&mut batch, data, space, how, &others, [how.rays - first, 2], rng, step);
    } else {
        fill(&mut batch, data, space, how, &all(), [how.rays, 0], rng, step);
    }
    batch
}

/// Adds `count` rays of these frames.
#[expect(clippy::too_many_arguments, reason = "one stream of the draw; a struct would only rename it")]
fn fill(
    batch: &mut RayBatch,
    data: &TrainData,
    space: &NetSpace,
    how: &Draw,
    frames: &[usize],
    [count, stream]: [usize; 2],
    rng: &mut ChaCha8Rng,
    step: u64,
) {
    if count == 0 {
        return;
    }
    let begin = batch.len();
    let mut epochs = (how.order == RayOrder::Epochs).then(|| {
        Epochs::new(data, frames, how.seed.wrapping_mul(3).wrapping_add(stream as u64), (step - 1) * count as u64)
    });
    let focused = (count as f64 * how.region_share) as usize;
    let mut misses = 0;
    while batch.len() - begin < count {
        let (index, pixel) = match epochs.as_mut() {
            Some(epochs) if misses == 0 => epochs.next(data),
            _ => {
                let index = frames[rng.random_range(0..frames.len())];
                let frame = &data.frames[index];
                let inside = batch.len() - begin < focused && !frame.region_pixels().is_empty();
                let pixel = if inside {
                    frame.region_pixels()[rng.random_range(0..frame.region_pixels().len())]
                } else {
                    match frame.valid_pixels() {
                        Some(valid) => valid[rng.random_range(0..valid.len())],
                        None => rng.random_range(0..frame.pixels.len() as u32 / 3),
                    }
                };
                (index, pixel)
            }
        };
        if push(batch, data, space, index, &data.frames[index], pixel as usize) {
            misses = 0;
        } else {
            misses += 1;
            // Beyond the fold of the lens there are no rays, and another is drawn in place of one; a lens that is
            // folded everywhere is refused on loading.
            if misses > 1000 * count {
                break;
            }
        }
    }
}

/// All rays of some frames in one random order, again and again, without a list of them: a permutation that is computed
/// (four Feistel rounds over the smallest even power of two, walked until the number is one of ours).
struct Epochs<'a> {
    frames: &'a [usize],
    /// Rays of the frames before each, and of all.
    before: Vec<u64>,
    keys: [u64; 4],
    half_bits: u32,
    next: u64,
}

impl<'a> Epochs<'a> {
    fn new(data: &TrainData, frames: &'a [usize], seed: u64, next: u64) -> Self {
        let mut before = vec![0];
        for &i in frames {
            let frame = &data.frames[i];
            let rays = frame.valid_pixels().map_or(frame.pixels.len() / 3, <[u32]>::len) as u64;
            before.push(before[before.len() - 1] + rays);
        }
        let total = before[before.len() - 1].max(1);
        let bits = 64 - (total - 1).leading_zeros();
        let mut rng = rng_for(seed, 0, 7);
        Self { frames, before, keys: [(); 4].map(|()| rng.random()), half_bits: bits.div_ceil(2).max(1), next }
    }

    fn total(&self) -> u64 {
        self.before[self.before.len() - 1]
    }

    fn permuted(&self, place: u64) -> u64 {
        let mask = (1u64 << self.half_bits) - 1;
        let mut value = place;
        loop {
            let (mut left, mut right) = (value >> self.half_bits, value & mask);
            for key in self.keys {
                let mut mixed = (right ^ key).wrapping_mul(0x9E37_79B9_7F4A_7C15);
                mixed = (mixed ^ (mixed >> 29)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
                (left, right) = (right, left ^ ((mixed ^ (mixed >> 32)) & mask));
            }
            value = (left << self.half_bits) | right;
            if value < self.total() {
                return value;
            }
        }
    }

    /// The next ray: frame and pixel.
    fn next(&mut self, data: &TrainData) -> (usize, u32) {
        let ray = self.permuted(self.next % self.total());
        self.next += 1;
        let place = self.before.partition_point(|&b| b <= ray) - 1;
        let index = self.frames[place];
        let pixel = (ray - self.before[place]) as usize;
        (index, data.frames[index].valid_pixels().map_or(pixel as u32, |valid| valid[pixel]))
    }
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
        batch.attributes.push(value.map_or(-1.0, |a| a.0));
        batch.attributes_given.push(f32::from(u8::from(value.is_some() && spec.active)));
    }
    true
}
