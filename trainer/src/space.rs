//! The space the networks see: scene units, zoomed so that the head has a set size.

use glam::DVec3;
use risorius_formats::nerfies::Extras;
use risorius_formats::{Camera, SceneBounds};
use serde::{Deserialize, Serialize};

/// `net = (world − center) · scale`; near and far in the same units, along the ray.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct NetSpace {
    /// The origin in world units.
    pub center_in_world: DVec3,
    /// Net units per world unit.
    pub scale: f64,
    /// Where sampling starts.
    pub near: f64,
    /// Where it ends.
    pub far: f64,
}

impl NetSpace {
    /// The scene's own space, or with `head_radius` > 0 and a known head the space in which the head has that radius.
    pub fn new(bounds: &SceneBounds, extras: Option<&Extras>, head_radius: f64) -> Self {
        let zoom = match extras {
            Some(e) if head_radius > 0.0 && e.head_radius > 0.0 => head_radius / (e.head_radius * bounds.scale),
            _ => 1.0,
        };
        let center_in_world = match extras {
            Some(e) if head_radius > 0.0 => e.head_center,
            _ => bounds.center_in_world,
        };
        Self { center_in_world, scale: bounds.scale * zoom, near: bounds.near * zoom, far: bounds.far * zoom }
    }

    /// Where a camera stands.
    pub fn origin(&self, camera: &Camera) -> DVec3 {
        (camera.center() - self.center_in_world) * self.scale
    }
}
