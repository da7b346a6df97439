//! A fitted avatar: what is known about it, and its field.

use std::collections::BTreeMap;
use std::path::Path;

use burn::tensor::Device;
use risorius_formats::{ActionUnit, Camera, Reporter};

use crate::error::Result;
use crate::expression::{Expression, Unseen};
use crate::field::{Field, Look, Outputs, Render};
use crate::saved::SavedModel;
use crate::studio::Studio;

/// A fitted avatar.
pub struct Avatar {
    /// What is known about it.
    pub saved: SavedModel,
    /// What takes its pictures.
    pub field: Box<dyn Field>,
}

impl Avatar {
    /// Opens the avatar of a run.
    pub fn open(run: impl AsRef<Path>, device: &Device) -> Result<Self> {
        let run = run.as_ref();
        let saved = SavedModel::read(run)?;
        let field = saved.open_field(run, device)?;
        Ok(Self { saved, field })
    }

    /// The neutral face.
    pub fn neutral(&self) -> Expression {
        Expression::neutral(&self.saved.table)
    }

    /// The expression of AU intensities 0–5; AUs left out are neutral, those that never moved stay so, and those beyond the
    /// capture's range saturate.
    pub fn expression(&self, intensities: &BTreeMap<ActionUnit, f32>) -> Expression {
        Unseen::default().expression(&self.saved.table, intensities)
    }

    /// How many times a view can be reduced before its pixels grow coarser than those that were fitted; 1 where a field
    /// draws every pixel cheaply.
    pub fn spare_resolution(&self, camera: &Camera) -> u32 {
        if !self.field.is_dear() {
            return 1;
        }
        ((camera.intrinsics.fx / self.saved.default_camera.fx + 0.1) as u32).clamp(1, 16)
    }

    /// Renders `camera` with an expression: every pixel, and all that a render can hold.
    pub fn render(&self, camera: &Camera, expression: &Expression, reporter: &dyn Reporter) -> Result<Render> {
        let outputs = Outputs { depth: true, masks: true, head: true };
        Studio::new(self, Look { outputs, ..Look::default() }).render(camera, expression, reporter)
    }
}
