//! A dataset as the brick field sees it: cameras as rays, pixels drawn where they teach most.

use glam::DVec2;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use risorius_brick::{Pixel, Views};

use super::plate::Plate;
use crate::data::TrainData;

/// The training frames with what is derived from them once.
#[derive(Debug)]
pub struct TrainViews<'a> {
    data: &'a TrainData,
    origins: Vec<[f32; 3]>,
    plate: Option<Plate>,
    region_share: f32,
    uncapped: bool,
}

impl<'a> TrainViews<'a> {
    /// `region_share` of the rays come from pixels inside regions.
    pub fn new(data: &'a TrainData, region_share: f32) -> Self {
        let origins = data.frames.iter().map(|f| f.camera.center().as_vec3().to_array()).collect();
        Self { data, origins, plate: Plate::of(data), region_share, uncapped: data.is_uncapped() }
    }

    /// What is behind the head, if the camera stands still.
    pub fn plate(&self) -> Option<&Plate> {
        self.plate.as_ref()
    }
}

impl Views for TrainViews<'_> {
    fn count(&self) -> usize {
        self.data.frames.len()
    }

    fn origin(&self, view: usize) -> [f32; 3] {
        self.origins[view]
    }

    fn attributes(&self, view: usize) -> Option<&[f32]> {
        let frame = &self.data.frames[view];
        if self.uncapped { frame.uncapped.as_deref() } else { frame.attributes.as_deref() }
    }

    fn draw(&self, view: usize, rng: &mut ChaCha8Rng, rays: usize, out: &mut Vec<Pixel>) {
        let frame = &self.data.frames[view];
        let width = frame.camera.intrinsics.width as usize;
        for _ in 0..rays {
            let in_region = !frame.region_pixels.is_empty() && rng.random::<f32>() < self.region_share;
            let pixel = if in_region {
                frame.region_pixels[rng.random_range(0..frame.region_pixels.len())] as usize
            } else {
                match &frame.valid {
                    Some(valid) => valid[rng.random_range(0..valid.len())] as usize,
                    None => rng.random_range(0..frame.pixels.len() / 3),
                }
            };
            let position = DVec2::new((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5);
            // Beyond the fold of a lens there is no ray.
            let Some(direction) = frame.camera.ray_direction(position) else { continue };
            let color = |bytes: &[u8]| std::array::from_fn(|c| f32::from(bytes[c]) / 255.0);
            out.push(Pixel {
                direction: direction.as_vec3().to_array(),
                color: color(&frame.pixels[pixel * 3..pixel * 3 + 3]),
                backdrop: self.plate.as_ref().map(|p| color(&p.rgb[pixel * 3..pixel * 3 + 3])),
                label: frame.labels.as_ref().map(|l| l[pixel]),
            });
        }
    }
}
