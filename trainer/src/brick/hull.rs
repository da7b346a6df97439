//! Where in space an AU may act: the visual hull of each region's 2D masks.

use glam::DVec3;
use rayon::prelude::*;

use crate::data::{TrainData, TrainFrame};

/// Frames that are asked.
const FRAMES: usize = 64;
/// How far masks are widened, in radii of the face: the skin around a region moves with it.
const WIDEN_RADII: f64 = 0.08;
/// Share of the frames whose mask must hold a point. Jaws and brows move: few masks hold all of their ways.
const SHARE: f64 = 0.2;
/// How far behind the face's middle a region may reach, in radii.
const BEHIND_RADII: f64 = 0.8;

/// One frame's widened masks.
struct View<'a> {
    frame: &'a TrainFrame,
    masks: Vec<u8>,
    width: usize,
}

/// The regions' hulls.
pub struct RegionHull<'a> {
    views: Vec<View<'a>>,
    regions: usize,
    face: Option<(DVec3, f64)>,
    to_camera: DVec3,
}

impl<'a> RegionHull<'a> {
    /// Gathers and widens masks of frames spread over the dataset.
    pub fn new(data: &'a TrainData) -> Self {
        let with_masks: Vec<&TrainFrame> = data.frames.iter().filter(|f| f.labels.is_some()).collect();
        let every = with_masks.len().div_ceil(FRAMES).max(1);
        let face = data.extras().map(|e| (e.head_center, e.head_radius)).filter(|f| f.1 > 0.0);
        let center = face.map_or(data.dataset.scene.center_in_world, |f| f.0);
        let regions = data.table.regions.len();
        let views = with_masks
            .into_iter()
            .step_by(every)
            .collect::<Vec<_>>()
            .into_par_iter()
            .map(|frame| {
                let i = &frame.camera.intrinsics;
                let distance = (frame.camera.center() - center).length();
                let radius = face.map_or(0.0, |f| WIDEN_RADII * f.1 * i.fx / distance).clamp(1.0, 64.0);
                let (width, height) = (i.width as usize, i.height as usize);
                View {
                    frame,
                    masks: widen(frame.labels.as_deref().unwrap_or_default(), width, height, radius as usize),
                    width,
                }
            })
            .collect();
        let position = data.frames.iter().map(|f| f.camera.center()).sum::<DVec3>() / data.frames.len().max(1) as f64;
        Self { views, regions, face, to_camera: (position - center).normalize_or_zero() }
    }

    /// A bit for each region that holds the point; all bits where nothing is known of masks.
    pub fn regions_at(&self, point: [f32; 3]) -> u8 {
        let all = ((1u16 << self.regions) - 1) as u8;
        let p = glam::Vec3::from_array(point).as_dvec3();
        if let Some((center, radius)) = self.face
            && (p - center).dot(self.to_camera) < -BEHIND_RADII * radius
        {
            return 0;
        }
        if self.views.is_empty() {
            return all;
        }
        let mut counts = [0u32; 8];
        for view in &self.views {
            let camera = &view.frame.camera;
            if camera.camera_from_world.transform_point(p).z <= 0.0 {
                continue;
            }
            let pixel = camera.project(p);
            let (w, h) = (f64::from(camera.intrinsics.width), f64::from(camera.intrinsics.height));
            if pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < w && pixel.y < h {
                let bits = view.masks[pixel.y as usize * view.width + pixel.x as usize];
                counts.iter_mut().enumerate().for_each(|(n, c)| *c += u32::from(bits >> n & 1));
            }
        }
        let enough = (self.views.len() as f64 * SHARE).max(1.0);
        (0..self.regions).filter(|&n| f64::from(counts[n]) >= enough).fold(0, |bits, n| bits | 1 << n)
    }
}

/// A bit per region for each pixel within `radius` (square) of it.
fn widen(labels: &[u8], width: usize, height: usize, radius: usize) -> Vec<u8> {
    let bits: Vec<u8> = labels.iter().map(|&l| if l > 0 { 1 << (l - 1).min(7) } else { 0 }).collect();
    let spread = |source: &[u8], length: usize, stride: usize, lines: usize, line_stride: usize| {
        let mut out = vec![0u8; source.len()];
        for line in 0..lines {
            for i in 0..length {
                let value = source[line * line_stride + i * stride];
                if value != 0 {
                    for j in i.saturating_sub(radius)..(i + radius + 1).min(length) {
                        out[line * line_stride + j * stride] |= value;
                    }
                }
            }
        }
        out
    };
    let rows = spread(&bits, width, 1, height, width);
    spread(&rows, height, width, width, 1)
}

#[cfg(test)]
mod tests {
    use super::widen;

    #[test]
    fn masks_grow_by_the_radius_and_may_overlap() {
        let wide = widen(&[0, 1, 0, 0, 2, 0, 0, 0], 8, 1, 2);
        assert_eq!(wide, [1, 1, 3, 3, 2, 2, 2, 0]);
    }
}
