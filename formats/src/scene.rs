//! Where the scene is and how it is scaled for fitting.

use glam::DVec3;
use serde::{Deserialize, Serialize};

/// `scene_point = (world_point − center) · scale`; near and far are distances along a ray in scene units.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SceneBounds {
    /// The scene's origin in world units.
    pub center_in_world: DVec3,
    /// Scene units per world unit.
    pub scale: f64,
    /// Nearest distance worth sampling, scene units.
    pub near: f64,
    /// Farthest distance worth sampling, scene units.
    pub far: f64,
}

/// Scales and distances below this, or above its inverse, come from damage, whatever the unit.
const SMALLEST: f64 = 1e-12;

impl SceneBounds {
    /// A point of the world in scene units.
    pub fn scene_from_world(&self, point_in_world: DVec3) -> DVec3 {
        (point_in_world - self.center_in_world) * self.scale
    }

    /// Whether 0 < near < far and all numbers are of a size that 32-bit floats and their inverses hold.
    pub fn is_valid(&self) -> bool {
        let sizes = SMALLEST..=1.0 / SMALLEST;
        self.center_in_world.abs().max_element() <= 1.0 / SMALLEST
            && !self.center_in_world.is_nan()
            && [self.scale, self.near, self.far].iter().all(|v| sizes.contains(v))
            && self.far > self.near
    }
}
