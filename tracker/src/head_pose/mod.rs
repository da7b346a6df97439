//! The head's pose from its 68 points, by PnP with the person's own shape.
//!
//! Axes and units are OpenFace's: head space has x to the image's right, y down, z away from the camera for a face that
//! looks straight into it, millimetres, with the mean of the 68 resting points as its origin.

pub mod pnp;
pub mod shape;

use glam::{DVec2, DVec3};

/// The camera in which poses are measured: square pixels, principal point in the middle of the picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lens {
    /// Focal length, pixels.
    pub focal_px: f64,
    /// Principal point, pixels, the centre of the first pixel at (0.5, 0.5).
    pub center_px: DVec2,
}

/// Focal length of an unknown camera over the longer side of its picture.
pub const DEFAULT_FOCAL: f64 = 1.2;

impl Lens {
    /// The lens of a picture of `width`×`height` pixels.
    pub fn new(width: u32, height: u32, focal_px: Option<f64>) -> Self {
        let focal_px = focal_px.unwrap_or(DEFAULT_FOCAL * f64::from(width.max(height)));
        Self { focal_px, center_px: DVec2::new(f64::from(width), f64::from(height)) * 0.5 }
    }

    /// x/z and y/z of the ray through a pixel.
    pub fn normalised(&self, point_px: [f32; 2]) -> DVec2 {
        (DVec2::new(f64::from(point_px[0]), f64::from(point_px[1])) - self.center_px) / self.focal_px
    }

    /// The pixel of a point in camera space.
    pub fn project(&self, point: DVec3) -> DVec2 {
        point.truncate() / point.z * self.focal_px + self.center_px
    }
}

/// How much each of the 68 points tells about the head: the outline moves with the jaw and, seen by a network, with the
/// view; brows and lips with the expression; corners of the eyes and the nose with the skull.
pub const RIGIDITY: [f64; 68] = {
    let mut w = [0.0; 68];
    let mut i = 0;
    while i < 68 {
        w[i] = match i {
            3..=13 => 0.02,
            27..=36 | 39 | 42 | 45 => 1.0,
            0..=47 => 0.15,
            _ => 0.05,
        };
        i += 1;
    }
    w
};
