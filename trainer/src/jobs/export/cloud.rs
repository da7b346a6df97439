//! The Gaussians of an avatar at one expression, a row each, as splat files hold them.
//!
//! Axes are those of the fit: x right, y down, z forward in the avatar's own view (RDF, as 3D Gaussian splatting's files),
//! origin in the head's middle, metres. AU deltas are added as `trainer render` adds them: gates applied, latent code 0.

use glam::DVec3;
use risorius_formats::Camera;
use risorius_splat::model::{EMPTY, LANES, channel};
use risorius_splat::{Gaussians, reference};

use crate::error::{Result, TrainerError};
use crate::expression::Expression;
use crate::saved::SavedModel;
use crate::splat::SplatField;

/// Constants of the spherical harmonics of degrees 0 and 1.
pub(super) const SH_C0: f32 = 0.282_094_8;
const SH_C1: f32 = 0.488_602_52;
/// A quaternion whose squared length is not above this belongs to no Gaussian (as in the renderer).
const LEAST_LENGTH2: f32 = 1e-8;
/// Which Gaussians are the head's where only the head is written.
const HEAD: f32 = 0.5;

/// One Gaussian.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Row {
    /// Metres.
    pub mean: [f32; 3],
    /// Logarithms of the standard deviations along its axes, metres.
    pub log_scale: [f32; 3],
    /// Unit quaternion w, x, y, z with w ≥ 0.
    pub quaternion: [f32; 4],
    /// Opacity before the logistic function.
    pub logit: f32,
    /// Red, green, blue, 0–1, not clamped.
    pub color: [f32; 3],
    /// Spherical harmonics of degree 1: y, z, x, each red, green, blue.
    pub sh1: [[f32; 3]; 3],
    /// How much of the head's motion it follows, 0–1.
    pub head: f32,
}

impl Row {
    /// Opacity, 0–1.
    pub(super) fn opacity(&self) -> f32 {
        1.0 / (1.0 + (-self.logit).exp())
    }

    /// The colour that is seen from `eye` (metres, the Gaussians' axes).
    pub(super) fn color_from(&self, eye: DVec3) -> [f32; 3] {
        let d = (DVec3::from(self.mean.map(f64::from)) - eye).normalize_or_zero();
        let along = [-d.y as f32, d.z as f32, -d.x as f32];
        std::array::from_fn(|c| self.color[c] + SH_C1 * (0..3).map(|b| along[b] * self.sh1[b][c]).sum::<f32>())
    }

    /// The coefficient of degree 0 in 3D Gaussian splatting's sense.
    pub(super) fn dc(&self) -> [f32; 3] {
        self.color.map(|c| (c - 0.5) / SH_C0)
    }
}

/// The Gaussian field of an avatar, or an error that says what else can be written.
pub(super) fn gaussians_of(avatar: &crate::Avatar) -> Result<&SplatField> {
    avatar.field.gaussians().ok_or_else(|| TrainerError::Setting {
        message: "the avatar is one of the paper's networks (`--field confies`) and holds no Gaussians".to_owned(),
        hint: "write a mesh (`--out X.glb`), or fit the dataset with `--field splat`".to_owned(),
    })
}

/// The slots that hold a Gaussian, in the model's order.
pub(super) fn slots(model: &Gaussians) -> Vec<usize> {
    let exists = |&slot: &usize| {
        let length2: f32 = (0..4).map(|c| number(model, slot, channel::QUATERNION + c).powi(2)).sum();
        number(model, slot, channel::OPACITY) > EMPTY * 0.5 && length2 > LEAST_LENGTH2
    };
    (0..model.groups() * LANES).filter(exists).collect()
}

/// The Gaussians of an expression; with `head_only`, those that follow the head.
pub(super) fn rows(field: &SplatField, expression: &Expression, head_only: bool) -> Vec<Row> {
    let model = &field.model;
    let activations: Vec<f64> = field.activations(expression).into_iter().map(f64::from).collect();
    let wanted = slots(model).into_iter().filter(|&slot| !head_only || model.head_weight[slot] >= HEAD);
    wanted.map(|slot| row(model, slot, &activations)).collect()
}

/// The Gaussian of a slot with its deltas added; none are without activations.
pub(super) fn row(model: &Gaussians, slot: usize, activations: &[f64]) -> Row {
    let channels = |first: usize| -> [f32; 3] { std::array::from_fn(|c| number(model, slot, first + c)) };
    let [x, y, z, red, green, blue] = reference::blended(model, slot, activations).map(|v| v as f32);
    Row {
        mean: [x, y, z],
        log_scale: channels(channel::LOG_SCALE),
        quaternion: unit(std::array::from_fn(|c| number(model, slot, channel::QUATERNION + c))),
        logit: number(model, slot, channel::OPACITY),
        color: [red, green, blue],
        sh1: std::array::from_fn(|b| channels(channel::SH1 + 3 * b)),
        head: model.head_weight[slot],
    }
}

fn number(model: &Gaussians, slot: usize, c: usize) -> f32 {
    model.base[(slot / LANES * channel::COUNT + c) * LANES + slot % LANES]
}

fn unit(q: [f32; 4]) -> [f32; 4] {
    let length = q.iter().map(|v| v * v).sum::<f32>().sqrt();
    let sign = if q[0] < 0.0 { -1.0 } else { 1.0 };
    q.map(|v| v / length * sign)
}

/// Where the avatar's own camera stands, metres, in the Gaussians' axes.
pub(super) fn own_eye(field: &SplatField, saved: &SavedModel) -> DVec3 {
    field.space().camera(&Camera::from(&saved.default_camera)).center()
}
