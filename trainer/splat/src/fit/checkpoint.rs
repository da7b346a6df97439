//! A fit as arrays, to go on from.

use risorius_formats::Isometry;

use super::{Fitter, PerImage, Progress, Settings};
use crate::model::{Gaussians, Layout};
use crate::update::Moments;

impl Fitter {
    /// Every array that a checkpoint holds, by name; [`Self::restore`] takes them back. Moments included.
    pub fn arrays(&self) -> Vec<(&'static str, &[f32])> {
        let (m, i) = (&self.model, &self.images);
        vec![
            ("base", &m.base),
            ("deltas", &m.deltas),
            ("gates", &m.gates),
            ("membership", &m.membership),
            ("head_weight", &m.head_weight),
            ("base.first", &self.base_moments.first),
            ("base.second", &self.base_moments.second),
            ("deltas.first", &self.delta_moments.first),
            ("deltas.second", &self.delta_moments.second),
            ("membership.first", &self.membership_moments.first),
            ("membership.second", &self.membership_moments.second),
            ("movement", &self.movement),
            ("alphas", &i.alphas),
            ("log_betas", &i.log_betas),
            ("codes", &i.codes),
            ("head_motions", &i.head_motions),
            ("log_gains", &i.log_gains),
            ("image.moments", &i.moments),
            ("image.steps", &i.steps),
        ]
    }

    /// A fit that goes on from the arrays of a checkpoint; says what is wrong with them.
    pub fn restore(
        layout: Layout,
        settings: Settings,
        progress: Progress,
        head_poses: Vec<Isometry>,
        arrays: &mut dyn FnMut(&str) -> Result<Vec<f32>, String>,
    ) -> Result<Self, String> {
        let mut take = |name: &str| {
            let values = arrays(name)?;
            match values.iter().find(|v| !v.is_finite()) {
                Some(bad) => Err(format!("`{name}` holds {bad}")),
                None => Ok(values),
            }
        };
        let base = take("base")?;
        let deltas = take("deltas")?;
        let model =
            Gaussians::from_arrays(layout, base, deltas, take("gates")?, take("membership")?, take("head_weight")?)?;
        let expected = PerImage::zero(model.layout.images, model.layout.region_of.len());
        let images = PerImage {
            alphas: take("alphas")?,
            log_betas: take("log_betas")?,
            codes: take("codes")?,
            head_motions: take("head_motions")?,
            log_gains: take("log_gains")?,
            moments: take("image.moments")?,
            steps: take("image.steps")?,
        };
        let mut out = Self::assemble(model, images, settings, progress, head_poses);
        out.base_moments = Moments { first: take("base.first")?, second: take("base.second")? };
        out.delta_moments = Moments { first: take("deltas.first")?, second: take("deltas.second")? };
        out.membership_moments = Moments { first: take("membership.first")?, second: take("membership.second")? };
        out.movement = take("movement")?;
        let fresh = Self::assemble(
            out.model.clone(),
            expected,
            out.settings.clone(),
            out.progress.clone(),
            out.head_poses.clone(),
        );
        for ((name, read), (_, own)) in out.arrays().into_iter().zip(fresh.arrays()) {
            if read.len() != own.len() {
                return Err(format!("`{name}` holds {} numbers, expected {}", read.len(), own.len()));
            }
        }
        Ok(out)
    }
}
