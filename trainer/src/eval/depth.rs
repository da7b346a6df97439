//! Error of depth against a true depth map (16-bit PNG, thousandths of a world unit along the camera's axis).

use std::path::Path;

use glam::DVec2;
use risorius_formats::Camera;
use serde::Serialize;

use crate::error::{Result, TrainerError};
use crate::field::Render;

/// How far depth is off on the head, thousandths of a world unit: millimetres where the world is in metres.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct DepthError {
    /// Median of the absolute error.
    pub median_mm: f64,
    /// Mean of the absolute error.
    pub mean_mm: f64,
    /// Mean of the error: positive where the avatar lies behind the truth.
    pub bias_mm: f64,
    /// Pixels that were compared.
    pub pixels: usize,
}

/// Errors beyond this count as another surface (an ear against the wall behind it) and are left out of the means.
const OTHER_SURFACE: f64 = 100.0;

/// Reads a 16-bit depth map.
pub fn read(path: &Path) -> Result<image::ImageBuffer<image::Luma<u16>, Vec<u16>>> {
    let fail = |message: String| TrainerError::Image { path: path.to_owned(), message };
    match image::open(path).map_err(|e| fail(e.to_string()))? {
        image::DynamicImage::ImageLuma16(map) => Ok(map),
        _ => Err(fail("is not a 16-bit grey image".to_owned())),
    }
}

/// Compares a render's depth (along rays) with the truth (along the axis) of the same view; `None` where sizes differ or
/// too little of the head is seen.
pub fn compare(
    render: &Render,
    camera: &Camera,
    truth: &image::ImageBuffer<image::Luma<u16>, Vec<u16>>,
) -> Option<DepthError> {
    let (width, height) = render.rgb.dimensions();
    let (true_width, true_height) = truth.dimensions();
    if width == 0 || height == 0 || camera.intrinsics.width != width {
        return None;
    }
    let forward = camera.camera_from_world.rotation.row(2);
    let mut errors = Vec::new();
    for (i, &depth) in render.depth.iter().enumerate().filter(|(_, d)| **d > 0.0) {
        let (x, y) = (i as u32 % width, i as u32 / width);
        let pixel = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
        let known = truth.get_pixel(x * true_width / width, y * true_height / height).0[0];
        if let (Some(direction), true) = (camera.ray_direction(pixel), known > 0) {
            let error = f64::from(depth) * 1e3 * direction.normalize().dot(forward) - f64::from(known);
            if error.abs() <= OTHER_SURFACE {
                errors.push(error);
            }
        }
    }
    if errors.len() < 16 {
        return None;
    }
    let count = errors.len() as f64;
    let bias_mm = errors.iter().sum::<f64>() / count;
    let mut sizes: Vec<f64> = errors.iter().map(|e| e.abs()).collect();
    sizes.sort_by(f64::total_cmp);
    Some(DepthError {
        median_mm: sizes[sizes.len() / 2],
        mean_mm: sizes.iter().sum::<f64>() / count,
        bias_mm,
        pixels: errors.len(),
    })
}

#[cfg(test)]
mod tests {
    use risorius_formats::{Intrinsics, Isometry};

    use super::*;
    use crate::field::Outputs;

    #[test]
    fn depth_along_rays_is_compared_along_the_axis() {
        let camera = Camera { intrinsics: Intrinsics::pinhole(20, 20, 15.0), camera_from_world: Isometry::IDENTITY };
        let mut render = Render::empty(&camera, 0, Outputs { depth: true, ..Outputs::default() });
        for (i, depth) in render.depth.iter_mut().enumerate() {
            let pixel = DVec2::new((i % 20) as f64 + 0.5, (i / 20) as f64 + 0.5);
            // A wall at 0.5, seen 2 mm too far.
            *depth = (0.502 / camera.ray_direction(pixel).unwrap().normalize().z) as f32;
        }
        let truth = image::ImageBuffer::from_pixel(20, 20, image::Luma([500u16]));
        let error = compare(&render, &camera, &truth).unwrap();
        assert!((error.median_mm - 2.0).abs() < 1e-3 && (error.bias_mm - 2.0).abs() < 1e-3, "{error:?}");
        assert_eq!(error.pixels, 400);
    }
}
