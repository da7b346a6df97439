//! A camera and a head pose as the kernels see them: f32, with the limits of the lens.

use glam::DVec2;
use risorius_formats::{Camera, Isometry};

use crate::scene::camera_from_head;

/// Pixels along the longest side that a picture may have: binning packs a range of blocks into one number.
pub const MOST_SIDE: usize = 16_384;
/// Nearest depth that is drawn, metres.
pub(crate) const NEAR_M: f32 = 0.01;
/// How far beyond the picture the projection's slope is still followed, in half fields of view (3DGS: 1.3).
const BEYOND: f64 = 1.3;

/// A rigid transform into the camera, and where the camera stands in the frame it comes from.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Pose {
    /// Rotation, rows.
    pub rotation: [f32; 9],
    /// Translation, metres.
    pub translation: [f32; 3],
    /// The camera's position in the source frame, metres.
    pub center: [f32; 3],
}

impl Pose {
    fn of(pose: &Isometry) -> Self {
        let r = pose.rotation;
        let (x, y, z) = (r.row(0), r.row(1), r.row(2));
        Self {
            rotation: [x.x, x.y, x.z, y.x, y.y, y.z, z.x, z.y, z.z].map(|v| v as f32),
            translation: pose.translation.to_array().map(|v| v as f32),
            center: pose.camera_center().to_array().map(|v| v as f32),
        }
    }
}

/// Camera space to pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Lens {
    /// Focal lengths, pixels.
    pub focal: [f32; 2],
    /// Principal point, pixels.
    pub middle: [f32; 2],
    /// Skew, pixels.
    pub skew: f32,
    /// Least and greatest x/z, then y/z, at which the projection's slope is evaluated.
    pub slope_limits: [f32; 4],
    /// k1 k2 k3, k4 k5 k6, p1 p2; `None` for a pinhole.
    pub distortion: Option<[f32; 8]>,
    /// Largest (x/z)² + (y/z)² that is drawn: before the lens model folds.
    pub largest_r2: f32,
}

/// A camera with a head before it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct View {
    /// Pixels along a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Camera space to pixels.
    pub lens: Lens,
    /// `camera_from_room`.
    pub room: Pose,
    /// `camera_from_head`.
    pub head: Pose,
}

impl View {
    /// What `camera` sees of a room and of a head at `room_from_head`. Its picture has at most [`MOST_SIDE`] pixels along a
    /// side: callers refuse what has more.
    pub(crate) fn new(camera: &Camera, room_from_head: &Isometry) -> Self {
        let i = &camera.intrinsics;
        assert!(i.width.max(i.height) as usize <= MOST_SIDE, "a picture of {}×{} pixels", i.width, i.height);
        let (w, h) = (f64::from(i.width), f64::from(i.height));
        let limits = |from: f64, to: f64, middle: f64, focal: f64| {
            let (low, high) = ((from - middle) / focal, (to - middle) / focal);
            let (center, half) = ((low + high) * 0.5, (high - low).abs() * 0.5 * BEYOND);
            [(center - half) as f32, (center + half) as f32]
        };
        let ([x0, x1], [y0, y1]) = (limits(0.0, w, i.cx, i.fx), limits(0.0, h, i.cy, i.fy));
        let d = &i.distortion;
        let distortion = (!d.is_none()).then(|| {
            let ([k1, k2, k3], [k4, k5, k6], [p1, p2]) = (d.radial, d.radial_denominator, d.tangential);
            [k1, k2, k3, k4, k5, k6, p1, p2].map(|v| v as f32)
        });
        let largest_r2 = if distortion.is_some() { largest_r2(camera) } else { f64::MAX.min(1e30) };
        Self {
            width: i.width as usize,
            height: i.height as usize,
            lens: Lens {
                focal: [i.fx as f32, i.fy as f32],
                middle: [i.cx as f32, i.cy as f32],
                skew: i.skew as f32,
                slope_limits: [x0, x1, y0, y1],
                distortion,
                largest_r2: largest_r2 as f32,
            },
            room: Pose::of(&camera.camera_from_world),
            head: Pose::of(&camera_from_head(camera, room_from_head)),
        }
    }

    /// Tiles along a row.
    pub(crate) fn columns(&self) -> usize {
        self.width.div_ceil(crate::TILE)
    }

    /// Tiles.
    pub(crate) fn tiles(&self) -> usize {
        self.columns() * self.height.div_ceil(crate::TILE)
    }
}

/// The squared radius up to which a distorted lens is followed: a little beyond the corners, and not beyond the fold.
fn largest_r2(camera: &Camera) -> f64 {
    let i = &camera.intrinsics;
    let (w, h) = (f64::from(i.width), f64::from(i.height));
    let corners = [DVec2::ZERO, DVec2::new(w, 0.0), DVec2::new(0.0, h), DVec2::new(w, h)];
    let farthest =
        corners.iter().map(|&c| i.unproject(c).map_or(f64::INFINITY, DVec2::length)).fold(0.0, f64::max).min(3.0);
    // The radial curve must rise by at least a fifth of its slope in the middle.
    let step = farthest.max(0.1) * 1.2 / 64.0;
    let at = |r: f64| i.distortion.distort(DVec2::new(r, 0.0)).length();
    let mut r = 0.0;
    while r < farthest * 1.2 && at(r + step) - at(r) > 0.2 * step {
        r += step;
    }
    r * r
}
