//! What the page asks for becomes pixels.

use std::collections::BTreeMap;

use glam::DMat3;
use risorius_formats::{ActionUnit, Camera, Intrinsics, Reporter};
use serde::{Deserialize, Serialize};

use super::live::Now;
use super::overlay;
use crate::avatar::Avatar;
use crate::error::Result;
use crate::field::{Look, Outputs, Render};
use crate::jobs::transfer::Range;
use crate::path::{Orbit, turned};
use crate::studio::Studio;

/// What is laid over the picture.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Overlay {
    /// Nothing.
    #[default]
    None,
    /// The region masks, one colour each.
    Masks,
    /// Depth instead of colour, near is bright.
    Depth,
}

/// One picture that is wanted.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FrameRequest {
    /// Where it is seen from.
    pub orbit: Orbit,
    /// Intensities 0–5; AUs left out are neutral.
    pub aus: BTreeMap<ActionUnit, f32>,
    /// Size as a share of the fitted images' size, 0.1–2.
    pub scale: f64,
    /// What is laid over it.
    pub overlay: Overlay,
    /// Which studio takes it. Each keeps its last picture, and draws only what differs from it: pictures that alternate,
    /// such as before and after, need one each.
    pub slot: usize,
    /// Whether to answer with JPEG instead of raw RGB: smaller, for slow lines.
    pub jpeg: bool,
    /// Whether the live face's AUs take the place of these.
    pub live: bool,
    /// Whether its head's turns are followed as well, against where it was when this began.
    pub live_head: bool,
    /// How the head is turned before the camera.
    #[serde(skip)]
    turn: Option<DMat3>,
}

/// An expression below this is not yet the driver's strongest, intensity.
const LEAST_STRONG: f32 = 1.5;
/// Studios that a page may use: after, before, and one for each while things move.
const SLOTS: usize = 4;

/// The avatar and its studios.
pub struct Scene<'a> {
    avatar: &'a Avatar,
    studios: Vec<Studio<'a>>,
    size: (u32, u32),
    /// Where the live head was when its turns began to be followed.
    ahead: Option<DMat3>,
}

impl<'a> Scene<'a> {
    /// A scene of `avatar`.
    pub fn new(avatar: &'a Avatar) -> Self {
        let size = (avatar.saved.default_camera.width, avatar.saved.default_camera.height);
        Self { avatar, studios: (0..SLOTS).map(|_| Studio::new(avatar, Look::default())).collect(), size, ahead: None }
    }

    /// Size of the fitted images, pixels.
    pub fn size(&self) -> (u32, u32) {
        self.size
    }

    /// Puts what the live face does into a request.
    pub fn drive(&mut self, request: &mut FrameRequest, now: &Now, range: Range) {
        request.aus.clone_from(&now.aus);
        if range == Range::Driver {
            for spec in &self.avatar.saved.table.attributes {
                let strongest = now.strongest.get(&spec.unit).copied().unwrap_or(0.0).max(LEAST_STRONG);
                request.aus.entry(spec.unit).and_modify(|v| *v *= spec.au_max / strongest);
            }
        }
        self.ahead = match (request.live_head, self.ahead, now.turn) {
            (false, ..) => None,
            (true, None, turn) => turn,
            (true, ahead, _) => ahead,
        };
        request.turn = self.ahead.zip(now.turn).map(|(ahead, turn)| turn * ahead.transpose());
    }

    /// Renders a picture and what is laid over it.
    pub fn frame(&mut self, request: &FrameRequest, reporter: &dyn Reporter) -> Result<image::RgbImage> {
        let scale = if request.scale.is_finite() { request.scale.clamp(0.1, 2.0) } else { 1.0 };
        let reference = Camera::from(&self.avatar.saved.default_camera);
        let orbit = request.orbit.bounded();
        let center = self.avatar.saved.center_in_world;
        let turn = request.turn.unwrap_or(DMat3::IDENTITY);
        let camera = scaled(&turned(&orbit.camera(&reference, center), center, turn), scale);
        let known = request.aus.iter().filter(|(_, v)| v.is_finite()).map(|(u, v)| (*u, v.clamp(0.0, 5.0))).collect();
        let expression = self.avatar.expression(&known);
        let studio = &mut self.studios[request.slot.min(SLOTS - 1)];
        studio.set_outputs(Outputs {
            masks: request.overlay == Overlay::Masks,
            depth: request.overlay == Overlay::Depth,
            head: false,
        });
        let render = studio.render(&camera, &expression, reporter)?;
        Ok(lay_over(render, request.overlay))
    }
}

fn lay_over(render: Render, what: Overlay) -> image::RgbImage {
    match what {
        Overlay::None => render.rgb,
        Overlay::Masks => overlay::masks(&render),
        Overlay::Depth => overlay::depth(&render),
    }
}

/// The same view with `scale` times the pixels on each side.
fn scaled(camera: &Camera, scale: f64) -> Camera {
    let i = &camera.intrinsics;
    let size = |n: u32| ((f64::from(n) * scale).round() as u32).max(8);
    let (width, height) = (size(i.width), size(i.height));
    let (x, y) = (f64::from(width) / f64::from(i.width), f64::from(height) / f64::from(i.height));
    let intrinsics =
        Intrinsics { width, height, fx: i.fx * x, fy: i.fy * y, cx: i.cx * x, cy: i.cy * y, skew: i.skew * x, ..*i };
    Camera { intrinsics, camera_from_world: camera.camera_from_world }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scaled_view_shows_the_same() {
        let camera = Camera {
            intrinsics: Intrinsics { cx: 130.0, cy: 245.0, ..Intrinsics::pinhole(268, 480, 576.0) },
            camera_from_world: risorius_formats::Isometry::IDENTITY,
        };
        let point = glam::DVec3::new(0.1, -0.05, 0.6);
        let (a, half) = (camera.project(point), scaled(&camera, 0.5));
        assert_eq!((half.intrinsics.width, half.intrinsics.height), (134, 240));
        assert!((half.project(point) * 2.0 - a).length() < 1e-9);
        let odd = scaled(&camera, 0.37);
        let share = |c: &Camera| {
            let p = c.project(point);
            [p.x / f64::from(c.intrinsics.width), p.y / f64::from(c.intrinsics.height)]
        };
        let (p, q) = (share(&camera), share(&odd));
        assert!((p[0] - q[0]).abs() < 1e-9 && (p[1] - q[1]).abs() < 1e-9);
    }

    #[test]
    fn requests_read_with_what_is_left_out() {
        let r: FrameRequest = serde_json::from_str(r#"{"orbit":{"yaw_deg":5},"aus":{"AU12":3},"scale":1}"#).unwrap();
        assert_eq!((r.orbit.yaw_deg, r.orbit.zoom, r.slot), (5.0, 1.0, 0));
        assert!(serde_json::from_str::<FrameRequest>(r#"{"sise":1}"#).is_err());
    }
}
