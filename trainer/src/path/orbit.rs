//! A camera told by angles around the head.

use glam::DVec3;
use risorius_formats::{Camera, Intrinsics};
use serde::{Deserialize, Serialize};

use super::swing;

/// Where a camera stands relative to the avatar's own: turned around the head, zoomed, and shifted in its image.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Orbit {
    /// Sideways around the head, degrees; positive shows more of the head's left in the picture's right.
    pub yaw_deg: f64,
    /// Up and down around the head, degrees.
    pub pitch_deg: f64,
    /// Factor on the focal length.
    pub zoom: f64,
    /// How far the picture is shifted to the right, in picture widths.
    pub shift_x: f64,
    /// How far the picture is shifted down, in picture heights.
    pub shift_y: f64,
}

impl Default for Orbit {
    fn default() -> Self {
        Self { yaw_deg: 0.0, pitch_deg: 0.0, zoom: 1.0, shift_x: 0.0, shift_y: 0.0 }
    }
}

impl Orbit {
    /// The numbers in the order yaw, pitch, zoom, shift x, shift y.
    pub fn to_array(self) -> [f64; 5] {
        [self.yaw_deg, self.pitch_deg, self.zoom, self.shift_x, self.shift_y]
    }

    /// The reverse of [`Self::to_array`].
    pub fn from_array([yaw_deg, pitch_deg, zoom, shift_x, shift_y]: [f64; 5]) -> Self {
        Self { yaw_deg, pitch_deg, zoom, shift_x, shift_y }
    }

    /// The nearest one that makes sense: half a turn, 80° up and down, zoom 0.2–10, shift of one picture.
    #[must_use]
    pub fn bounded(self) -> Self {
        let within = |v: f64, low: f64, high: f64, or: f64| if v.is_finite() { v.clamp(low, high) } else { or };
        Self {
            yaw_deg: within(self.yaw_deg, -180.0, 180.0, 0.0),
            pitch_deg: within(self.pitch_deg, -80.0, 80.0, 0.0),
            zoom: within(self.zoom, 0.2, 10.0, 1.0),
            shift_x: within(self.shift_x, -1.0, 1.0, 0.0),
            shift_y: within(self.shift_y, -1.0, 1.0, 0.0),
        }
    }

    /// The camera, starting from `reference`. Zooming keeps the head's middle where it is in the picture.
    pub fn camera(&self, reference: &Camera, center_in_world: DVec3) -> Camera {
        let swung = swing(reference, center_in_world, self.yaw_deg.to_radians(), self.pitch_deg.to_radians());
        let middle = reference.project(center_in_world);
        let i = &swung.intrinsics;
        let (width, height) = (f64::from(i.width), f64::from(i.height));
        let intrinsics = Intrinsics {
            fx: i.fx * self.zoom,
            fy: i.fy * self.zoom,
            cx: middle.x + (i.cx - middle.x) * self.zoom + self.shift_x * width,
            cy: middle.y + (i.cy - middle.y) * self.zoom + self.shift_y * height,
            ..*i
        };
        Camera { intrinsics, camera_from_world: swung.camera_from_world }
    }
}

#[cfg(test)]
mod tests {
    use glam::DMat3;
    use risorius_formats::Isometry;

    use super::*;

    #[test]
    fn the_head_stays_in_place_when_zoomed_and_moves_when_shifted() {
        let reference = Camera {
            intrinsics: Intrinsics { cx: 30.0, ..Intrinsics::pinhole(64, 48, 80.0) },
            camera_from_world: Isometry::new(DMat3::from_rotation_y(0.3), DVec3::new(0.1, -0.2, 2.0)),
        };
        let center = DVec3::new(0.05, 0.1, 0.0);
        let at = |orbit: Orbit| orbit.camera(&reference, center).project(center);
        let home = at(Orbit::default());
        assert!((home - reference.project(center)).length() < 1e-9);
        let turned = Orbit { yaw_deg: 20.0, pitch_deg: -10.0, zoom: 3.0, ..Orbit::default() };
        assert!((at(turned) - home).length() < 1e-9);
        let shifted = at(Orbit { shift_x: 0.25, shift_y: -0.5, ..turned });
        assert!((shifted - home - glam::DVec2::new(16.0, -24.0)).length() < 1e-9);
        let wild = Orbit { yaw_deg: f64::NAN, zoom: 1e9, ..Orbit::default() }.bounded();
        assert_eq!((wild.yaw_deg, wild.zoom), (0.0, 10.0));
    }
}
